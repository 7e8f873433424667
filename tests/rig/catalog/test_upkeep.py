"""Edit objects, read the log, and clean up a catalog."""

import os
import sqlite3
from contextlib import closing
from datetime import timedelta

import numpy as np
import pytest
from sqlalchemy import select

from rig.catalog import Action, Catalog, derived
from rig.catalog.facts import Derived
from rig.catalog.results import find_result
from rig.catalog.results import record as record_result
from rig.catalog.upkeep import YOUNG_S, collect_garbage
from rig.catalog.verify import verify
from rig.core.errors import CatalogError, ObjectExists, ObjectNotFound, UsageError
from rig.core.next_steps import Do
from rig.views.image_files import encode
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import PROVENANCE, files, fill, finished, image, new_result, plan, record


def names(catalog: Catalog) -> list[str]:
    return [item.name for item in catalog.objects()]


class TestEdit:
    def test_renamed_labelled_and_restored_object_keeps_its_views(self, catalog: Catalog, clock: VirtualClock) -> None:
        fill(catalog, "mug", 2, label="kitchen", note="chipped")
        fill(catalog, "tin", 1)
        catalog.rename("mug", " cup ")
        assert derived.views(catalog).object_names == ("cup", "tin")
        assert np.array_equal(catalog.read_image(catalog.object("cup").views[0].image), image(0))
        with pytest.raises(ObjectNotFound):
            catalog.delete("cup", "mug")
        with pytest.raises(ObjectExists):
            catalog.rename("cup", "tin")
        catalog.rename("cup", "cup")
        catalog.set_texts("cup", label="lab")
        catalog.set_texts("cup", note="")
        with pytest.raises(UsageError):
            catalog.set_texts("cup", note="\udcff")
        clock.sleep(5)
        catalog.delete("cup")
        assert (names(catalog), len(derived.views(catalog))) == (["tin"], 1)
        (deleted,) = catalog.objects(deleted=True)
        assert (deleted.name, deleted.label, deleted.note, deleted.deleted_utc) == ("cup", "lab", "", clock.utc())
        with pytest.raises(ObjectNotFound, match="'cup'"):
            catalog.object("cup")
        catalog.undelete("cup")
        assert names(catalog) == ["cup", "tin"]
        assert catalog.object("cup").summary.views == 2

    def test_enrollment_continues_under_the_new_name_unless_its_object_is_deleted(self, catalog: Catalog) -> None:
        enrollment = catalog.begin("mug", planned_azimuth_deg=plan(2), provenance=PROVENANCE)
        enrollment.add(record(0), image(0))
        catalog.delete("mug")
        with pytest.raises(CatalogError, match="deleted during") as error:
            enrollment.add(record(1), image(1))
        assert Do.UNDELETE(name="mug") in error.value.steps
        catalog.undelete("mug")
        catalog.rename("mug", "cup")
        enrollment.add(record(1), image(1))
        enrollment.finish()
        assert catalog.object("cup").summary.views == 2

    def test_name_of_a_deleted_object_is_free(self, catalog: Catalog, clock: VirtualClock) -> None:
        fill(catalog, "mug", 1)
        catalog.delete("mug")
        clock.sleep(1)
        fill(catalog, "mug", 2)
        with pytest.raises(ObjectExists):
            catalog.undelete("mug")
        catalog.delete("mug")
        assert len(catalog.objects(deleted=True)) == 2
        catalog.undelete("mug")  # the one that was deleted last
        assert catalog.object("mug").summary.views == 2


class TestLog:
    @pytest.mark.sqlite
    def test_log_has_action_user_and_time_and_rejects_changes(self, catalog: Catalog, clock: VirtualClock) -> None:
        begun = clock.utc()
        with pytest.raises(ObjectNotFound):
            catalog.delete("mug")
        assert catalog.log() == []
        fill(catalog, "mug", 1)
        clock.sleep(3600)
        catalog.rename("mug", "cup")
        catalog.delete("cup")
        catalog.note(Action.MOVED, to_deg=90.0)
        log = catalog.log()
        assert [entry.action for entry in log] == ["enrollment started", "enrolled", "renamed", "deleted", "moved"]
        assert {entry.time_utc - begun for entry in log} == {timedelta(0), timedelta(hours=1)}
        assert all(entry.user and entry.host and "hbr-rig" in entry.software for entry in log)
        assert (log[2].object_name, log[2].details) == ("cup", {"before": "mug"})
        assert log[4].details == {"to_deg": 90.0}
        assert [e.action for e in catalog.log(since=begun + timedelta(minutes=1))] == ["renamed", "deleted", "moved"]

        with closing(sqlite3.connect(catalog.path / "catalog.sqlite", isolation_level=None)) as connection:
            for change in ("DELETE FROM log", "UPDATE log SET user = 'nobody'"):
                with pytest.raises(sqlite3.IntegrityError, match="a fact is written once"):
                    connection.execute(change)
        assert len(catalog.log()) == 5


class TestGarbage:
    def test_only_deleted_objects_are_removed(self, catalog: Catalog) -> None:
        fill(catalog, "mug", 2, 0)
        fill(catalog, "tin", 3, 10)
        fill(catalog, "tin", 2, 20, replace=True)
        catalog.delete("mug")
        before = files(catalog)
        would = collect_garbage(catalog, dry_run=True)
        assert files(catalog) == before
        assert would == collect_garbage(catalog)
        assert (would.objects, would.enrollments, would.views, would.files) == (("mug",), 1, 2, 2)
        assert len(files(catalog)) == 5
        with pytest.raises(ObjectNotFound):
            catalog.undelete("mug")
        assert [e.status for e in catalog.object("tin").enrollments] == ["complete", "superseded"]
        collect_garbage(catalog, old=True)
        assert [e.status for e in catalog.object("tin").enrollments] == ["complete"]
        assert len(files(catalog)) == 2
        assert finished(verify(catalog)).findings == ()
        fill(catalog, "jar", 1)
        (jar,) = catalog.object("jar").enrollments
        assert jar.enrollment.id == 4  # no id is given twice
        assert collect_garbage(catalog, old=True).enrollments == 0

    def test_image_that_another_row_names_is_kept(self, catalog: Catalog) -> None:
        fill(catalog, "mug", 2, 0, empty_table=image(50))
        fill(catalog, "cup", 1, 1, empty_table=image(50))
        number = record_result(catalog, new_result(), image(0))
        catalog.delete("mug")
        assert collect_garbage(catalog).files == 0
        assert np.array_equal(catalog.read_image(str(find_result(catalog, number).image)), image(0))
        assert finished(verify(catalog)).findings == ()

    def test_what_was_computed_is_removed_with_its_object(self, catalog: Catalog) -> None:
        fill(catalog, "mug", 2)
        fill(catalog, "tin", 1, 10)
        catalog.delete("mug")
        collect_garbage(catalog)
        with catalog.reading() as state:
            left = {one.seal for one in state.used()}
            assert set(state.transaction.scalars(select(Derived.seal))) == left
        assert len(left) == 1

    def test_image_that_no_row_names_is_kept_for_a_day(self, catalog: Catalog, clock: VirtualClock) -> None:
        fill(catalog, "mug", 1)
        name = catalog.database.images.put(encode(image(7)))
        written_s = clock.utc().timestamp()
        os.utime(catalog.image_path(name), (written_s, written_s))
        clock.sleep(YOUNG_S - 1)
        assert collect_garbage(catalog).files == 0
        clock.sleep(2)
        assert collect_garbage(catalog, dry_run=True).files == 1
        catalog.database.images.put(encode(image(7)))  # stored again, it is young
        assert collect_garbage(catalog).files == 0
        os.utime(catalog.image_path(name), (written_s, written_s))
        assert collect_garbage(catalog).files == 1
        assert not catalog.image_path(name).exists()
        assert finished(verify(catalog)).findings == ()
        assert [entry.action for entry in catalog.log()][-1] == "collected garbage"

    @pytest.mark.sqlite
    @pytest.mark.parametrize("content", [b"", b"half of"])
    def test_file_that_a_killed_program_left_is_removed(self, catalog: Catalog, content: bytes) -> None:
        fill(catalog, "mug", 1)
        path = catalog.image_path(catalog.object("mug").views[0].image)
        part = path.with_name(f"{path.name}.0123456789abcdef.part")
        part.write_bytes(content)
        os.utime(part, (0, 0))
        assert collect_garbage(catalog).files == 1
        assert not part.exists()
