"""An import happens completely or not at all, after any interruption."""

from pathlib import Path

import numpy as np
import pytest

import hbr
from rig.catalog import Catalog
from rig.catalog.exchange import (
    Conflict,
    ImportBatch,
    import_objects,
    plan_import,
    read_folder,
)
from rig.catalog.places import LOST
from rig.catalog.verify import verify
from rig.core.errors import CatalogError, ObjectExists
from sim.clock import VirtualClock
from tests.programs import server
from tests.rig.catalog.catalog_samples import (
    finished,
    true_fill,
)
from tests.rig.catalog.exchange.exchange_samples import NOW, OpenCatalog, model, photograph, run_import, untouched


class TestAllOrNothing:
    @pytest.fixture
    def batch(self, tmp_path: Path) -> ImportBatch:
        for angle in range(0, 360, 60):
            photograph(tmp_path / "in" / f"mug__{angle}.png", angle)
        return read_folder(tmp_path / "in", now=NOW)

    @pytest.mark.parametrize("after", [0, 1, 2])
    def test_interrupted_import_leaves_nothing(
        self, batch: ImportBatch, open_catalog: OpenCatalog, monkeypatch: pytest.MonkeyPatch, after: int
    ) -> None:
        monkeypatch.setattr("rig.catalog.jobs.PORTION", 2)
        catalog = open_catalog("catalog")
        job = import_objects(catalog, plan_import(catalog, batch), jobs=1)
        for _ in range(after + 1):
            next(job)
        job.close()
        assert untouched(catalog)
        assert run_import(catalog, batch).views == 6

    @pytest.mark.parametrize("step", ["rig.catalog.exchange.insert.sync_folder", "rig.catalog.audit.append"])
    @pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
    def test_import_that_fails_in_its_transaction_leaves_nothing(
        self,
        batch: ImportBatch,
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
                run_import(catalog, batch)
        assert untouched(catalog)
        assert run_import(catalog, batch).views == 6
        assert finished(verify(catalog)).findings == ()

    def test_files_of_a_killed_import_are_moved_away(self, batch: ImportBatch, open_catalog: OpenCatalog) -> None:
        catalog = open_catalog("catalog")
        left = catalog.path / "images" / "000001-mug" / "000001" / "old.png"
        left.parent.mkdir(parents=True)
        left.write_bytes(b"left behind")
        run_import(catalog, batch)
        assert finished(verify(catalog)).findings == ()
        assert (catalog.path / LOST / left.relative_to(catalog.path)).read_bytes() == b"left behind"

    def test_import_notices_an_object_of_another_process_and_keeps_replaced_enrollments(
        self, batch: ImportBatch, open_catalog: OpenCatalog
    ) -> None:
        catalog = open_catalog("catalog")
        job = import_objects(catalog, plan_import(catalog, batch), jobs=1)
        next(job)
        true_fill(catalog, "mug", 1, 0)
        with pytest.raises(ObjectExists):
            finished(job)
        assert catalog.object("mug").summary.views == 1
        assert finished(verify(catalog)).findings == ()
        done = run_import(catalog, batch, Conflict.REPLACE)
        assert done.replaced == ("mug",)
        assert [e.status for e in catalog.object("mug").enrollments] == ["complete", "superseded"]
        assert catalog.object("mug").summary.views == 6

    def test_several_processes_import_the_same(
        self, batch: ImportBatch, open_catalog: OpenCatalog, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("rig.catalog.exchange.importing.processes", lambda wanted, _: wanted)
        monkeypatch.setattr("rig.catalog.jobs.PORTION", 2)
        context = server()
        monkeypatch.setattr("rig.core.processes.get_context", lambda _: context)  # starts sooner
        alone, together = open_catalog("alone"), open_catalog("together")
        run_import(alone, batch)
        finished(import_objects(together, plan_import(together, batch), jobs=2))
        assert model(alone) == model(together)
        assert np.array_equal(
            together.views().views.descriptors[0], hbr.describe(together.read_image(together.object("mug").views[0]))
        )

    def test_read_only_catalog_rejects_an_import(self, batch: ImportBatch, open_catalog: OpenCatalog) -> None:
        path = open_catalog("catalog").path
        with Catalog.open(path, clock=VirtualClock(), read_only=True) as catalog:
            with pytest.raises(CatalogError, match="reading only"):
                run_import(catalog, batch)
            assert untouched(catalog)
