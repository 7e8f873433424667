"""Bundles, merged catalogs and copies lose nothing."""

import sqlite3
import zipfile
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.catalog import Catalog
from rig.catalog.exchange.bundle import write_bundle
from rig.catalog.transfer import CatalogSource, Conflict
from rig.catalog.verify import verify
from rig.core.errors import CatalogDamaged, CatalogError, ExportFailed, ObjectExists
from rig.core.next_steps import Do
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import NOW, PROVENANCE, OpenCatalog, fill, finished, image
from tests.rig.catalog.exchange.exchange_samples import facts, import_bundle, model, pictures, run_import, untouched


def everything(catalog: Catalog) -> list[tuple[object, ...]]:
    return [facts(item) for item in CatalogSource(catalog).items()]


class TestBundles:
    def test_bundle_round_trip_keeps_all_facts(self, full: Catalog, open_catalog: OpenCatalog, tmp_path: Path) -> None:
        assert write_bundle(tmp_path / "a.rigcat.zip", CatalogSource(full)) == 3
        other = open_catalog("copy")
        done = import_bundle(other, tmp_path / "a.rigcat.zip")
        assert (done.objects, done.views) == (3, 9)
        assert finished(verify(other)).findings == ()
        assert everything(other) == everything(full)
        assert model(other) == model(full)
        assert pictures(other) == pictures(full)

    def test_bundle_that_no_import_would_accept_is_not_written(
        self, full: Catalog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("rig.catalog.exchange.bundle.MAX_DATABASE_BYTES", 1000)
        with pytest.raises(ExportFailed, match=r"no import would accept it: .* more than 1000"):
            write_bundle(tmp_path / "a.rigcat.zip", CatalogSource(full))
        assert not (tmp_path / "a.rigcat.zip").exists()

    def test_unfinished_or_abandoned_enrollment_is_not_exported(self, full: Catalog, tmp_path: Path) -> None:
        with pytest.raises(CatalogError, match="'cup' is unfinished"):
            write_bundle(tmp_path / "a.rigcat.zip", CatalogSource(full, ["tin", "cup"]))
        full.resume("cup", provenance=PROVENANCE).abandon()
        with pytest.raises(CatalogError, match="'cup' was abandoned") as error:
            write_bundle(tmp_path / "a.rigcat.zip", CatalogSource(full, ["cup"]))
        assert error.value.steps == (Do.ENROLL(name="cup"),)
        assert not (tmp_path / "a.rigcat.zip").exists()

    def test_bundle_contains_the_named_objects(self, full: Catalog, open_catalog: OpenCatalog, tmp_path: Path) -> None:
        write_bundle(tmp_path / "a.rigcat.zip", CatalogSource(full, ["tin", "Tässe =2+2"]))
        other = open_catalog("copy")
        import_bundle(other, tmp_path / "a.rigcat.zip")
        assert [one.name for one in other.objects()] == ["Tässe =2+2", "tin"]

    def test_bundle_is_readable_without_this_program(self, full: Catalog, tmp_path: Path) -> None:
        write_bundle(tmp_path / "a.rigcat.zip", CatalogSource(full))
        with zipfile.ZipFile(tmp_path / "a.rigcat.zip") as archive:
            archive.extractall(tmp_path / "unpacked")
        with closing(sqlite3.connect(tmp_path / "unpacked" / "catalog.sqlite")) as connection:
            rows = connection.execute(
                "SELECT log.object_name, views.image FROM log JOIN views ON views.enrollment_id = log.enrollment_id "
                "WHERE log.status = 'complete' AND views.view_index = 0 ORDER BY log.id"
            ).fetchall()
        assert [name for name, _ in rows] == ["mug-white", "Tässe =2+2", "tin"]
        stored = cv2.imread(str(tmp_path / "unpacked" / "images" / rows[0][1][:2] / rows[0][1]))
        assert stored is not None
        assert np.array_equal(stored, image(20))
        with Catalog.open(tmp_path / "unpacked", clock=VirtualClock(NOW), create=False, read_only=True) as unpacked:
            assert everything(unpacked) == everything(full)

    def test_check_of_a_bundle_changes_nothing(self, bundle: Path, open_catalog: OpenCatalog) -> None:
        catalog = open_catalog("catalog")
        assert import_bundle(catalog, bundle, dry_run=True).views == 2
        assert untouched(catalog)

    def test_export_overwrites_nothing_and_leaves_no_partial_files(self, full: Catalog, tmp_path: Path) -> None:
        (tmp_path / "a.rigcat.zip").write_bytes(b"mine")
        with pytest.raises(ExportFailed, match="exists already"):
            write_bundle(tmp_path / "a.rigcat.zip", CatalogSource(full))
        full.image_path(full.object("mug-white").views[3].image).write_bytes(b"x")
        with pytest.raises(CatalogDamaged, match="are missing or are not those") as error:
            write_bundle(tmp_path / "b.rigcat.zip", CatalogSource(full))
        assert "verify" in error.value.next_step
        assert sorted(path.name for path in tmp_path.iterdir()) == ["a.rigcat.zip", "full"]


class TestMerge:
    def test_catalogs_are_merged(self, full: Catalog, open_catalog: OpenCatalog) -> None:
        other = open_catalog("copy")
        fill(other, "tin", 2, 50)
        with pytest.raises(ObjectExists) as error:
            run_import(other, CatalogSource(full))
        assert error.value.evidence == {"objects": ["tin"]}
        done = run_import(other, CatalogSource(full), Conflict.SKIP)
        assert (done.objects, done.skipped) == (2, ("tin",))
        assert [item.name for item in other.objects()] == ["tin", "mug-white", "Tässe =2+2"]
        assert finished(verify(other)).findings == ()

    def test_replaced_object_keeps_its_label_and_its_earlier_enrollments(
        self, full: Catalog, open_catalog: OpenCatalog
    ) -> None:
        other = open_catalog("copy")
        fill(other, "mug-white", 2, 50, label="mine")
        other.begin("tin", planned_azimuth_deg=[0.0], provenance=PROVENANCE)
        done = run_import(other, CatalogSource(full), Conflict.REPLACE, label="theirs")
        assert done.replaced == ("mug-white", "tin")
        assert [one.label for one in other.objects()] == ["mine", "", "theirs"]
        statuses = [[str(one.status) for one in other.object(name).enrollments] for name in ("mug-white", "tin")]
        assert statuses == [["complete", "superseded"], ["complete", "in progress"]]
        assert finished(verify(other)).findings == ()
