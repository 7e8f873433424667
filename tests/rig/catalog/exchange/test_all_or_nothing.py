"""An import happens completely or not at all, after any interruption, and only once."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import hbr
from rig.catalog import Catalog
from rig.catalog.derived import views
from rig.catalog.exchange.photographs import Photographs, read_folder
from rig.catalog.transfer import CatalogSource, Conflict, transfer
from rig.catalog.verify import verify
from rig.core.errors import CatalogDamaged, CatalogError, ImportRejected, ObjectExists
from sim.clock import VirtualClock
from tests.programs import server
from tests.rig.catalog.catalog_samples import NOW, OpenCatalog, fill, finished
from tests.rig.catalog.exchange.exchange_samples import model, photograph, run_import, untouched


@pytest.fixture
def photographs(tmp_path: Path) -> Callable[[], Photographs]:
    for name in ("mug", "tin"):
        for angle in range(0, 360, 60):
            photograph(tmp_path / "in" / f"{name}__{angle}.png", angle + len(name))
    return lambda: read_folder(tmp_path / "in", now=NOW)


class TestAllOrNothing:
    @pytest.mark.parametrize("after", [0, 1, 2])
    def test_interrupted_import_leaves_no_object(
        self, photographs: Callable[[], Photographs], open_catalog: OpenCatalog, after: int
    ) -> None:
        catalog = open_catalog("catalog")
        job = transfer(photographs(), catalog, jobs=1)
        for _ in range(after + 1):
            next(job)
        job.close()
        assert untouched(catalog, images=True)
        assert run_import(catalog, photographs()).views == 12
        assert finished(verify(catalog)).findings == ()

    @pytest.mark.parametrize("step", ["rig.catalog.images.Images.settle", "rig.catalog.log.append"])
    @pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
    def test_import_that_fails_at_its_end_leaves_no_object(
        self,
        photographs: Callable[[], Photographs],
        open_catalog: OpenCatalog,
        monkeypatch: pytest.MonkeyPatch,
        step: str,
        error: BaseException,
    ) -> None:
        def fail(*_: object, **__: object) -> None:
            raise error

        catalog = open_catalog("catalog")
        with monkeypatch.context() as patch:
            patch.setattr(step, fail)
            with pytest.raises((KeyboardInterrupt, CatalogError)):
                run_import(catalog, photographs())
        assert untouched(catalog, images=True)
        assert run_import(catalog, photographs()).views == 12
        assert finished(verify(catalog)).findings == ()

    def test_import_notices_an_object_of_another_process_and_keeps_replaced_enrollments(
        self, photographs: Callable[[], Photographs], open_catalog: OpenCatalog
    ) -> None:
        catalog = open_catalog("catalog")
        job = transfer(photographs(), catalog, jobs=1)
        next(job)
        fill(catalog, "mug", 1)
        with pytest.raises(ObjectExists):
            finished(job)
        assert catalog.object("mug").summary.views == 1
        assert finished(verify(catalog)).findings == ()
        done = run_import(catalog, photographs(), Conflict.REPLACE)
        assert done.replaced == ("mug",)
        assert [e.status for e in catalog.object("mug").enrollments] == ["complete", "superseded"]
        assert catalog.object("mug").summary.views == 6

    def test_several_processes_import_the_same(
        self, photographs: Callable[[], Photographs], open_catalog: OpenCatalog, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("rig.catalog.incoming.processes", lambda wanted, _: wanted)
        context = server()
        monkeypatch.setattr("rig.core.processes.get_context", lambda _: context)  # starts sooner
        alone, together = open_catalog("alone"), open_catalog("together")
        run_import(alone, photographs())
        run_import(together, photographs(), jobs=2)
        assert model(alone) == model(together)
        assert np.array_equal(
            views(together).descriptors[0], hbr.describe(together.read_image(together.object("mug").views[0].image))
        )

    def test_read_only_catalog_rejects_an_import(
        self, photographs: Callable[[], Photographs], open_catalog: OpenCatalog
    ) -> None:
        path = open_catalog("catalog").path
        with Catalog.open(path, clock=VirtualClock(), read_only=True) as catalog:
            with pytest.raises(CatalogError, match="reading only"):
                run_import(catalog, photographs())
            assert untouched(catalog, images=True)


class TestOnlyOnce:
    def test_enrollment_is_not_added_a_second_time(self, full: Catalog, open_catalog: OpenCatalog) -> None:
        catalog = open_catalog("catalog")
        run_import(catalog, CatalogSource(full))
        before = catalog.log()[-1].id
        catalog.rename("mug-white", "cup")
        done = run_import(catalog, CatalogSource(full))
        assert (done.objects, done.skipped) == (0, ("mug-white", "Tässe =2+2", "tin"))
        assert [line.action for line in catalog.log()[before:]] == ["renamed"]
        assert finished(verify(catalog)).findings == ()

    def test_photographs_are_not_added_a_second_time(
        self, photographs: Callable[[], Photographs], open_catalog: OpenCatalog, tmp_path: Path
    ) -> None:
        catalog = open_catalog("catalog")
        run_import(catalog, photographs())
        with pytest.raises(ObjectExists):
            run_import(catalog, photographs())
        done = run_import(catalog, photographs(), Conflict.REPLACE)
        assert (done.objects, done.replaced, done.skipped) == (0, (), ("mug", "tin"))
        photograph(tmp_path / "in" / "mug__10.png", 10)
        done = run_import(catalog, photographs(), Conflict.REPLACE)
        assert (done.replaced, done.skipped) == (("mug",), ("tin",))
        assert [one.status for one in catalog.object("mug").enrollments] == ["complete", "superseded"]
        (tmp_path / "in" / "mug__10.png").unlink()
        run_import(catalog, photographs(), Conflict.REPLACE)
        assert [one.status for one in catalog.object("mug").enrollments] == ["superseded", "complete"]
        assert catalog.object("mug").summary.views == 6
        catalog.delete("mug")
        run_import(catalog, photographs(), Conflict.REPLACE)
        assert finished(verify(catalog)).findings == ()

    def test_earlier_enrollment_comes_into_use_again(self, full: Catalog, open_catalog: OpenCatalog) -> None:
        catalog = open_catalog("catalog")
        run_import(catalog, CatalogSource(full))
        fill(catalog, "mug-white", 2, 50, replace=True)
        with pytest.raises(ObjectExists):
            run_import(catalog, CatalogSource(full, ["mug-white"]))
        assert run_import(catalog, CatalogSource(full, ["mug-white"]), once=True).objects == 0
        done = run_import(catalog, CatalogSource(full, ["mug-white"]), Conflict.REPLACE)
        assert done.replaced == ("mug-white",)
        assert [one.status for one in catalog.object("mug-white").enrollments] == ["superseded", "complete"]
        assert catalog.object("mug-white").summary.views == 4
        assert finished(verify(catalog)).findings == ()

    def test_deleted_object_is_added_again_unless_it_was_delivered(
        self, full: Catalog, open_catalog: OpenCatalog
    ) -> None:
        catalog = open_catalog("catalog")
        run_import(catalog, CatalogSource(full))
        catalog.delete("mug-white")
        assert run_import(catalog, CatalogSource(full), once=True).objects == 0
        assert run_import(catalog, CatalogSource(full)).objects == 1
        assert [item.name for item in catalog.objects()] == ["Tässe =2+2", "tin", "mug-white"]
        assert model(catalog)[0] == ("Tässe =2+2", "tin", "mug-white")
        assert finished(verify(catalog)).findings == ()

    def test_what_was_computed_goes_with_a_delivery(
        self, full: Catalog, open_catalog: OpenCatalog, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        catalog = open_catalog("catalog")
        run_import(catalog, CatalogSource(full), once=True)
        expected = model(full)
        monkeypatch.setattr("rig.catalog.describing.computed", None)
        assert model(catalog) == expected

    def test_damaged_image_of_a_catalog_is_not_transferred(self, full: Catalog, open_catalog: OpenCatalog) -> None:
        path = full.image_path(full.object("mug-white").views[0].image)
        path.write_bytes(path.read_bytes()[:-1] + b"x")
        catalog = open_catalog("catalog")
        with pytest.raises(CatalogDamaged, match="are missing or are not those"):
            run_import(catalog, CatalogSource(full))
        assert untouched(catalog, images=True)

    def test_damaged_empty_table_image_of_a_catalog_is_not_transferred(
        self, full: Catalog, open_catalog: OpenCatalog
    ) -> None:
        enrollment = full.object("tin").enrollments[0].enrollment
        table = enrollment.sessions[0].empty_table
        assert table is not None
        full.image_path(table).write_bytes(b"x")
        catalog = open_catalog("catalog")
        with pytest.raises(ImportRejected) as error:
            run_import(catalog, CatalogSource(full, own=False))
        assert error.value.evidence["rejected"] == [f"{table}: is not the stored image"]
        assert untouched(catalog)
