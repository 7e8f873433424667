"""Edit objects, read the log, and clean up a catalog."""

import sqlite3
from datetime import timedelta

import numpy as np
import pytest

import hbr
from rig.catalog import Action, Catalog
from rig.catalog.edit import delete, deleted_objects, rename, set_texts, undelete
from rig.catalog.staging import staging
from rig.catalog.upkeep import collect_garbage, statistics
from rig.catalog.verify import verify
from rig.core.errors import CatalogError, ObjectExists, ObjectNotFound, UsageError
from rig.core.next_steps import Do
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import (
    PROVENANCE,
    described,
    files,
    fill,
    finished,
    image,
    plan,
    record,
    sql,
)


def names(catalog: Catalog) -> list[str]:
    return [item.name for item in catalog.objects()]


class TestEdit:
    def test_renamed_object_keeps_its_views(self, catalog: Catalog) -> None:
        fill(catalog, "mug", 2)
        fill(catalog, "tin", 2)
        rename(catalog, "mug", " cup ")
        assert catalog.views().views.object_names == ("cup", "tin")
        assert np.array_equal(catalog.read_image(catalog.object("cup").views[0]), image(0))
        with pytest.raises(ObjectNotFound):
            catalog.object("mug")
        with pytest.raises(ObjectExists):
            rename(catalog, "cup", "tin")
        rename(catalog, "cup", "cup")

    def test_enrollment_continues_under_the_new_name(self, catalog: Catalog) -> None:
        enrollment = catalog.begin("mug", planned_azimuth_deg=plan(2), provenance=PROVENANCE)
        enrollment.add(record(0), image(0))
        rename(catalog, "mug", "cup")
        enrollment.add(record(1), image(1))
        enrollment.finish()
        assert catalog.object("cup").summary.views == 2

    def test_label_and_note_are_changed_separately(self, catalog: Catalog) -> None:
        fill(catalog, "mug", 1, label="kitchen", note="chipped")
        set_texts(catalog, "mug", label="lab")
        set_texts(catalog, "mug", note="")
        summary = catalog.object("mug").summary
        assert (summary.label, summary.note) == ("lab", "")
        with pytest.raises(UsageError):
            set_texts(catalog, "mug", note="\udcff")

    def test_deleted_object_can_be_restored(self, catalog: Catalog, clock: VirtualClock) -> None:
        fill(catalog, "mug", 2)
        fill(catalog, "tin", 1)
        clock.sleep(5)
        with pytest.raises(ObjectNotFound):
            delete(catalog, "mug", "jar")
        assert names(catalog) == ["mug", "tin"]
        delete(catalog, "mug")
        assert names(catalog) == ["tin"]
        assert len(catalog.views().views) == 1
        (deleted,) = deleted_objects(catalog)
        assert (deleted.name, deleted.deleted_utc) == ("mug", clock.utc())
        with pytest.raises(ObjectNotFound, match="'mug'"):
            catalog.object("mug")
        undelete(catalog, "mug")
        assert names(catalog) == ["mug", "tin"]
        assert catalog.object("mug").summary.views == 2

    def test_name_of_a_deleted_object_is_free(self, catalog: Catalog, clock: VirtualClock) -> None:
        fill(catalog, "mug", 1)
        delete(catalog, "mug")
        clock.sleep(1)
        fill(catalog, "mug", 2)
        with pytest.raises(ObjectExists):
            undelete(catalog, "mug")
        delete(catalog, "mug")
        assert len(deleted_objects(catalog)) == 2
        undelete(catalog, "mug")  # the one that was deleted last
        assert catalog.object("mug").summary.views == 2

    def test_enrollment_of_a_deleted_object_is_rejected(self, catalog: Catalog) -> None:
        enrollment = catalog.begin("mug", planned_azimuth_deg=plan(2), provenance=PROVENANCE)
        enrollment.add(record(0), image(0))
        delete(catalog, "mug")
        with pytest.raises(CatalogError, match="deleted during") as error:
            enrollment.add(record(1), image(1))
        assert Do.UNDELETE(name="mug") in error.value.steps
        undelete(catalog, "mug")
        enrollment.add(record(1), image(1))

    def test_segmentation_and_empty_table_image_are_stored(self, catalog: Catalog) -> None:
        enrollment = catalog.begin("mug", planned_azimuth_deg=plan(1), provenance=PROVENANCE)
        enrollment.store_empty_table(image(99))
        box = {"box": [1, 2, 3, 4], "gains": [1.0, 1.1, 0.9]}
        enrollment.add(described(0, 0, (0, 0, 12, 12), ("cedd", "cedd-blurred"), segmentation=box), image(0))
        enrollment.finish()
        (view,) = catalog.object("mug").views
        assert (view.record.segmentation, view.record.region) == (box, (0, 0, 12, 12))
        assert view.session.empty_table_image is not None
        assert (catalog.path / view.session.empty_table_image).is_file()
        assert np.array_equal(catalog.views().views.descriptors[0], hbr.describe(image(0)[:, :12]))
        assert [kind.name for kind in statistics(catalog).descriptors] == ["cedd", "cedd-blurred"]


class TestLog:
    @pytest.mark.sqlite
    def test_log_has_action_user_and_time_and_rejects_changes(self, catalog: Catalog, clock: VirtualClock) -> None:
        begun = clock.utc()
        with pytest.raises(ObjectNotFound):
            delete(catalog, "mug")
        assert catalog.log() == []
        fill(catalog, "mug", 1)
        clock.sleep(3600)
        rename(catalog, "mug", "cup")
        delete(catalog, "cup")
        catalog.note(Action.MOVED, to_deg=90.0)
        log = catalog.log()
        assert [entry.action for entry in log] == ["enrollment started", "enrolled", "renamed", "deleted", "moved"]
        assert {entry.time_utc - begun for entry in log} == {timedelta(0), timedelta(hours=1)}
        assert all(entry.user and entry.host and "hbr-rig" in entry.software for entry in log)
        assert (log[2].object_name, log[2].details) == ("cup", {"before": "mug"})
        assert log[4].details == {"to_deg": 90.0}
        assert [e.action for e in catalog.log(since=begun + timedelta(minutes=1))] == ["renamed", "deleted", "moved"]
        assert [e.action for e in catalog.log(object_name="mug")] == ["enrollment started", "enrolled"]

        for change in ("DELETE FROM audit", "UPDATE audit SET user = 'nobody'"):
            with pytest.raises(sqlite3.IntegrityError, match="only appended to"):
                sql(catalog, change)
        assert len(catalog.log()) == 5


class TestGarbage:
    def test_only_deleted_objects_are_removed(self, catalog: Catalog) -> None:
        fill(catalog, "mug", 2)
        fill(catalog, "tin", 3)
        fill(catalog, "tin", 2, replace=True)
        delete(catalog, "mug")
        before = files(catalog)
        would = collect_garbage(catalog, dry_run=True)
        assert files(catalog) == before
        assert would == collect_garbage(catalog)
        assert (would.objects, would.enrollments, would.views, would.files) == (("mug",), 1, 2, 2)
        assert len(files(catalog)) == 5
        with pytest.raises(ObjectNotFound):
            undelete(catalog, "mug")
        assert [e.status for e in catalog.object("tin").enrollments] == ["complete", "superseded"]
        collect_garbage(catalog, old=True)
        assert [e.status for e in catalog.object("tin").enrollments] == ["complete"]
        assert len(files(catalog)) == 2
        assert finished(verify(catalog, quick=True)).findings == ()
        fill(catalog, "jar", 1)
        assert all("000004" in name for name in files(catalog) if "jar" in name)  # no id is given twice

    def test_files_of_a_running_import_are_kept(self, catalog: Catalog) -> None:
        with staging(catalog.path) as folder:
            (folder / "x.png").write_bytes(b"x")
            assert collect_garbage(catalog).files == 0
            assert (folder / "x.png").exists()
        assert not (catalog.path / "incoming").exists()
        orphan = catalog.path / "incoming" / "killed"
        orphan.mkdir(parents=True)
        (orphan / "x.png").write_bytes(b"x")
        assert collect_garbage(catalog).files == 1
        assert not orphan.exists()

    def test_statistics_count_everything(self, catalog: Catalog) -> None:
        fill(catalog, "mug", 2, label="kitchen")
        fill(catalog, "tin", 3)
        fill(catalog, "tin", 1, replace=True)
        catalog.begin("jar", planned_azimuth_deg=plan(2), provenance=PROVENANCE)
        delete(catalog, "mug")
        found = statistics(catalog)
        assert (found.objects, found.deleted_objects, found.views) == (2, 1, 6)
        assert found.enrollments == {"complete": 2, "in progress": 1, "superseded": 1}
        assert found.labels == {"": 2}
        assert found.benches == {"bench-1": 6}
        assert found.image_bytes == sum((catalog.path / name).stat().st_size for name in files(catalog))
        assert 0 < found.deleted_image_bytes < found.old_image_bytes
        assert [(kind.name, kind.views, kind.current) for kind in found.descriptors] == [("cedd", 6, True)]
