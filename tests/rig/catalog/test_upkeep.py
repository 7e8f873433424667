"""Objects are renamed, deleted and taken back; a catalog is verified, mended, described anew and cleaned up."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hbr
from hbr.descriptors import descriptor, registry
from hbr.descriptors.plain_cedd import Cedd
from rig.catalog import Catalog
from rig.catalog.redescribe import redescribe
from rig.catalog.staging import staging
from rig.catalog.upkeep import collect_garbage, statistics
from rig.catalog.verify import Problem, Verification, verify
from rig.core.errors import CatalogError, DescriptorOutdated, ObjectExists, ObjectNotFound, UsageError
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import (
    PROVENANCE,
    described,
    fill,
    finished,
    image,
    plan,
    record,
    true_fill,
    without_waiting,
)


@pytest.fixture(autouse=True)
def _fast(monkeypatch: pytest.MonkeyPatch) -> None:
    without_waiting(monkeypatch)


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def catalog(tmp_path: Path, clock: VirtualClock) -> Iterator[Catalog]:
    with Catalog.open(tmp_path / "catalog", clock=clock) as catalog:
        yield catalog


def names(catalog: Catalog) -> list[str]:
    return [item.name for item in catalog.objects()]


def files(catalog: Catalog) -> set[str]:
    return {path.relative_to(catalog.path).as_posix() for path in catalog.path.rglob("*.png")}


def sql(catalog: Catalog, statement: str) -> None:
    """Do to the database what no rig does."""
    with closing(sqlite3.connect(catalog.path / "catalog.sqlite", isolation_level=None)) as connection:
        connection.execute(statement)


class TestOneByOne:
    def test_a_renamed_object_keeps_its_views(self, catalog: Catalog) -> None:
        fill(catalog, "mug", 2)
        fill(catalog, "tin", 2)
        catalog.rename("mug", " cup ")
        assert catalog.views().views.object_names == ("cup", "tin")
        assert np.array_equal(catalog.read_image(catalog.object("cup").views[0]), image(0))
        with pytest.raises(ObjectNotFound):
            catalog.object("mug")
        with pytest.raises(ObjectExists):
            catalog.rename("cup", "tin")
        catalog.rename("cup", "cup")

    def test_an_enrollment_goes_on_under_the_new_name(self, catalog: Catalog) -> None:
        enrollment = catalog.begin("mug", planned_azimuth_deg=plan(2), provenance=PROVENANCE)
        enrollment.add(record(0), image(0))
        catalog.rename("mug", "cup")
        enrollment.add(record(1), image(1))
        enrollment.finish()
        assert catalog.object("cup").summary.views == 2

    def test_label_and_note_are_changed_by_themselves(self, catalog: Catalog) -> None:
        fill(catalog, "mug", 1, label="kitchen", note="chipped")
        catalog.describe("mug", label="lab")
        catalog.describe("mug", note="")
        summary = catalog.object("mug").summary
        assert (summary.label, summary.note) == ("lab", "")
        with pytest.raises(UsageError):
            catalog.describe("mug", note="\udcff")

    def test_a_deletion_can_be_taken_back(self, catalog: Catalog, clock: VirtualClock) -> None:
        fill(catalog, "mug", 2)
        fill(catalog, "tin", 1)
        clock.sleep(5)
        catalog.delete("mug")
        assert names(catalog) == ["tin"]
        assert len(catalog.views().views) == 1
        (deleted,) = catalog.deleted()
        assert (deleted.name, deleted.deleted_utc) == ("mug", clock.utc())
        with pytest.raises(ObjectNotFound, match="'mug'"):
            catalog.object("mug")
        catalog.undelete("mug")
        assert names(catalog) == ["mug", "tin"]
        assert catalog.object("mug").summary.views == 2

    def test_of_several_all_or_none_are_deleted(self, catalog: Catalog) -> None:
        fill(catalog, "mug", 1)
        with pytest.raises(ObjectNotFound):
            catalog.delete("mug", "tin")
        assert names(catalog) == ["mug"]

    def test_the_name_of_a_deleted_object_is_free(self, catalog: Catalog, clock: VirtualClock) -> None:
        fill(catalog, "mug", 1)
        catalog.delete("mug")
        clock.sleep(1)
        fill(catalog, "mug", 2)
        with pytest.raises(ObjectExists):
            catalog.undelete("mug")
        catalog.delete("mug")
        assert len(catalog.deleted()) == 2
        catalog.undelete("mug")  # the one that was deleted last
        assert catalog.object("mug").summary.views == 2

    def test_nobody_goes_on_enrolling_what_was_deleted(self, catalog: Catalog) -> None:
        enrollment = catalog.begin("mug", planned_azimuth_deg=plan(2), provenance=PROVENANCE)
        enrollment.add(record(0), image(0))
        catalog.delete("mug")
        with pytest.raises(CatalogError, match="deleted while") as refused:
            enrollment.add(record(1), image(1))
        assert "undelete mug" in refused.value.next_step
        catalog.undelete("mug")
        enrollment.add(record(1), image(1))

    def test_a_view_keeps_its_front_end_and_an_enrollment_the_empty_table(self, catalog: Catalog) -> None:
        enrollment = catalog.begin("mug", planned_azimuth_deg=plan(1), provenance=PROVENANCE)
        enrollment.set_reference_image(image(99))
        edges = descriptor("cedd-blurred").describe(image(0))
        box = {"box": [1, 2, 3, 4], "gains": [1.0, 1.1, 0.9]}
        enrollment.add(described(0, 0, (0, 0, 12, 12), segmentation=box, further={"cedd-blurred": edges}), image(0))
        enrollment.finish()
        (view,) = catalog.object("mug").views
        assert (view.record.segmentation, view.record.region) == (box, (0, 0, 12, 12))
        assert view.sitting.reference_image is not None
        assert (catalog.path / view.sitting.reference_image).is_file()
        assert np.array_equal(catalog.views().views.descriptors[0], hbr.describe(image(0)[:, :12]))
        assert [kind.name for kind in statistics(catalog).descriptors] == ["cedd", "cedd-blurred"]


class TestLog:
    def test_it_tells_who_did_what_when(self, catalog: Catalog, clock: VirtualClock) -> None:
        begun = clock.utc()
        fill(catalog, "mug", 1)
        clock.sleep(3600)
        catalog.rename("mug", "cup")
        catalog.delete("cup")
        catalog.note("moved", to_deg=90.0)
        log = catalog.log()
        assert [entry.action for entry in log] == ["began to enroll", "enrolled", "renamed", "deleted", "moved"]
        assert {entry.time_utc - begun for entry in log} == {timedelta(0), timedelta(hours=1)}
        assert all(entry.user and entry.host and "hbr-rig" in entry.software for entry in log)
        assert (log[2].object_name, log[2].details) == ("cup", {"before": "mug"})
        assert log[4].details == {"to_deg": 90.0}
        assert [e.action for e in catalog.log(since=begun + timedelta(minutes=1))] == ["renamed", "deleted", "moved"]
        assert [e.action for e in catalog.log(object_name="mug")] == ["began to enroll", "enrolled"]

    @pytest.mark.parametrize("change", ["DELETE FROM audit", "UPDATE audit SET user = 'nobody'"])
    def test_it_is_only_appended_to(self, catalog: Catalog, change: str) -> None:
        fill(catalog, "mug", 1)
        with pytest.raises(sqlite3.IntegrityError, match="only appended to"):
            sql(catalog, change)
        assert len(catalog.log()) == 2

    def test_what_failed_is_not_in_it(self, catalog: Catalog) -> None:
        with pytest.raises(ObjectNotFound):
            catalog.delete("mug")
        assert catalog.log() == []


class TestGarbage:
    def test_what_was_deleted_goes_for_good_and_nothing_else(self, catalog: Catalog) -> None:
        fill(catalog, "mug", 2)
        fill(catalog, "tin", 3)
        fill(catalog, "tin", 2, replace=True)
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
        assert finished(verify(catalog, quick=True)).findings == ()
        fill(catalog, "jar", 1)
        assert all("000004" in name for name in files(catalog) if "jar" in name)  # no id is given twice

    def test_an_import_under_way_is_left_alone(self, catalog: Catalog) -> None:
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

    def test_statistics_add_up(self, catalog: Catalog) -> None:
        fill(catalog, "mug", 2, label="kitchen")
        fill(catalog, "tin", 3)
        fill(catalog, "tin", 1, replace=True)
        catalog.begin("jar", planned_azimuth_deg=plan(2), provenance=PROVENANCE)
        catalog.delete("mug")
        found = statistics(catalog)
        assert (found.objects, found.deleted_objects, found.views) == (2, 1, 6)
        assert found.enrollments == {"complete": 2, "in progress": 1, "superseded": 1}
        assert found.labels == {"": 2}
        assert found.benches == {"bench-1": 6}
        assert found.image_bytes == sum((catalog.path / name).stat().st_size for name in files(catalog))
        assert 0 < found.deleted_image_bytes < found.old_image_bytes
        assert [(kind.name, kind.views, kind.current) for kind in found.descriptors] == [("cedd", 6, True)]


def problems(found: Verification) -> list[str]:
    return [finding.problem for finding in found.findings]


class TestVerify:
    @pytest.fixture(autouse=True)
    def enrolled(self, catalog: Catalog) -> None:
        true_fill(catalog, "mug", 3, 0)
        true_fill(catalog, "tin", 3, 10, (2, 0, 12, 12))

    def images(self, catalog: Catalog, name: str) -> list[Path]:
        return [catalog.image_path(view) for view in catalog.object(name).views]

    def mended(self, catalog: Catalog) -> list[str]:
        """Repair, check that nothing is left to be found, and return what was done."""
        found = finished(verify(catalog, repair=True))
        assert found.unmended == ()
        assert finished(verify(catalog)).findings == ()
        for name, seed in (("mug", 0), ("tin", 10)):
            for view in catalog.object(name).views:
                assert np.array_equal(catalog.read_image(view), image(seed + view.record.index))
        return problems(found)

    def test_a_whole_catalog_has_no_problems(self, catalog: Catalog) -> None:
        found = finished(verify(catalog))
        assert (found.objects, found.views, found.findings) == (2, 6, ())

    def test_processes_find_the_same(self, catalog: Catalog, monkeypatch: pytest.MonkeyPatch) -> None:
        self.images(catalog, "mug")[1].unlink()
        monkeypatch.setattr("rig.catalog.jobs.PORTION", 1)
        alone, together = finished(verify(catalog, jobs=1)), finished(verify(catalog, jobs=2))
        assert alone == together
        assert problems(alone) == [Problem.MISSING_IMAGE]

    def test_an_image_that_is_gone_is_told_with_the_way_out(self, catalog: Catalog) -> None:
        self.images(catalog, "mug")[1].unlink()
        (finding,) = finished(verify(catalog, repair=True)).unmended
        assert (finding.problem, finding.object_name) == (Problem.MISSING_IMAGE, "mug")
        assert "backup" in finding.what
        assert "--replace" in finding.what

    def test_an_image_under_another_name_is_put_back(self, catalog: Catalog) -> None:
        first = self.images(catalog, "mug")[0]
        first.rename(first.with_name("copy of 0.png"))
        assert problems(finished(verify(catalog))) == [Problem.MISSING_IMAGE, Problem.ORPHANED_FILE]
        assert not first.exists()
        assert self.mended(catalog) == [Problem.MISSING_IMAGE, Problem.ORPHANED_FILE]
        assert (catalog.path / "lost+found").exists()

    def test_images_that_changed_places_change_back(self, catalog: Catalog) -> None:
        first, second, _ = self.images(catalog, "mug")
        a, b = first.read_bytes(), second.read_bytes()
        first.write_bytes(b)
        second.write_bytes(a)
        assert self.mended(catalog) == [Problem.CHANGED_IMAGE, Problem.CHANGED_IMAGE]

    @pytest.mark.parametrize("damage", [b"", b"\x89PNG\r\n\x1a\n", b"x" * 5000])
    def test_a_damaged_image_is_found(self, catalog: Catalog, damage: bytes) -> None:
        self.images(catalog, "tin")[2].write_bytes(damage)
        for quick in (True, False):
            assert problems(finished(verify(catalog, quick=quick))) == [Problem.CHANGED_IMAGE]

    def test_a_descriptor_of_something_else_is_computed_again(self, catalog: Catalog) -> None:
        sql(catalog, "UPDATE descriptors SET packed = zeroblob(54) WHERE view_id IN (2, 5)")
        found = finished(verify(catalog))
        assert problems(found) == [Problem.DESCRIPTOR_DIFFERS] * 2
        assert [finding.object_name for finding in found.findings] == ["mug", "tin"]
        assert len(self.mended(catalog)) == 2

    def test_a_view_without_a_descriptor_is_told_and_described_within_its_region(self, catalog: Catalog) -> None:
        before = catalog.views().views.descriptors
        sql(catalog, "DELETE FROM descriptors WHERE view_id = 4")
        assert problems(finished(verify(catalog))) == [Problem.NOT_DESCRIBED]
        sql(catalog, """UPDATE sittings SET conditions = '{"view": {"roi": [2, 0, 12, 12]}}' WHERE id = 2""")
        with pytest.raises(DescriptorOutdated, match="'tin'"):
            catalog.views()
        assert finished(redescribe(catalog)).described == 1
        assert np.array_equal(catalog.views().views.descriptors, before)

    def test_orphaned_rows_are_kept_in_the_log(self, catalog: Catalog) -> None:
        sql(catalog, "DELETE FROM enrollments WHERE id = 2")
        assert set(problems(finished(verify(catalog)))) == {Problem.ORPHANED_ROW}
        mended = finished(verify(catalog, repair=True))
        assert set(problems(mended)) == {Problem.ORPHANED_ROW, Problem.ORPHANED_FILE}
        assert mended.unmended == ()
        assert finished(verify(catalog)).findings == ()
        kept = [e.details["row"] for e in catalog.log() if e.action == "took out an orphan"]
        assert {row["azimuth_deg"] for row in kept if "azimuth_deg" in row} == {0.0, 5.0, 10.0}
        assert sorted((catalog.path / "lost+found").rglob("*.png"))

    def test_views_of_different_sizes_are_told(self, catalog: Catalog) -> None:
        enrollment = catalog.begin("jar", planned_azimuth_deg=plan(2), provenance=PROVENANCE)
        for index, picture in enumerate((image(0), image(1)[:, :10])):
            enrollment.add(record(index, descriptor=hbr.describe(picture)), picture)
        assert problems(finished(verify(catalog))) == [Problem.SIZES_DIFFER]

    def test_a_reference_image_is_looked_at_too(self, catalog: Catalog) -> None:
        enrollment = catalog.begin("jar", planned_azimuth_deg=plan(2), provenance=PROVENANCE)
        enrollment.set_reference_image(image(7))
        assert finished(verify(catalog)).findings == ()
        (catalog.path / (enrollment.sitting.reference_image or "")).write_bytes(b"x")
        assert problems(finished(verify(catalog))) == [Problem.CHANGED_IMAGE]

    def test_looking_changes_nothing(self, catalog: Catalog) -> None:
        self.images(catalog, "mug")[1].unlink()
        (catalog.path / "images" / "stray.png").write_bytes(b"x")
        before = (files(catalog), len(catalog.log()))
        with Catalog.open(catalog.path, clock=VirtualClock(), read_only=True) as reader:
            assert len(finished(verify(reader)).findings) == 2
        assert (files(catalog), len(catalog.log())) == before


class TestRedescribe:
    def test_a_new_version_is_noticed_and_comes_by_describing_anew(
        self, catalog: Catalog, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        true_fill(catalog, "mug", 3, 0)
        true_fill(catalog, "tin", 2, 10)
        monkeypatch.setitem(registry._KNOWN, "cedd", Cedd(version=2))
        with pytest.raises(DescriptorOutdated, match=r"compares cedd 2, the catalog is described by cedd 1") as refused:
            catalog.views()
        assert "rig catalog redescribe" in refused.value.next_step
        assert refused.value.evidence["objects"] == 2
        assert catalog.object("mug").views[0].record.descriptor is None
        done = finished(redescribe(catalog))
        assert (done.version, done.described, done.unchanged, done.failed) == (2, 5, 0, ())
        assert len(catalog.views().views) == 5
        assert finished(redescribe(catalog)).described == 0
        # both versions stand side by side, for a bench whose program is older, until they are collected
        assert [kind.version for kind in statistics(catalog).descriptors] == [1, 2]
        collect_garbage(catalog)
        assert [kind.version for kind in statistics(catalog).descriptors] == [2]

    def test_other_descriptors_stand_beside(self, catalog: Catalog) -> None:
        true_fill(catalog, "mug", 3, 0, (2, 0, 12, 12))
        with pytest.raises(DescriptorOutdated, match="by no cedd-blurred") as refused:
            catalog.views("cedd-blurred")
        assert "--descriptor cedd-blurred" in refused.value.next_step
        finished(redescribe(catalog, "cedd-blurred"))
        wanted = descriptor("cedd-blurred").describe(image(1)[:, 2:14])
        assert np.array_equal(catalog.views("cedd-blurred").views.descriptors[1], wanted)
        assert np.array_equal(catalog.views().views.descriptors[1], hbr.describe(image(1)[:, 2:14]))
        with pytest.raises(UsageError, match="sift"):
            catalog.views("sift")

    def test_a_region_is_for_what_a_bench_has_taken(self, catalog: Catalog) -> None:
        true_fill(catalog, "mug", 2, 0, (2, 0, 12, 12))
        imported = catalog.begin("postcard", planned_azimuth_deg=plan(1), provenance=PROVENANCE)
        imported.add(described(0, 20, None, commanded_deg=None, encoder_deg=None, captured_ns=None), image(20))
        imported.finish()
        done = finished(redescribe(catalog, region=(0, 0, 10, 10)))
        assert (done.described, done.unchanged) == (2, 1)
        assert np.array_equal(catalog.views().views.descriptors[0], hbr.describe(image(0)[:10, :10]))
        assert np.array_equal(catalog.views().views.descriptors[2], hbr.describe(image(20)))
        outside = finished(redescribe(catalog, region=(0, 0, 100, 10)))
        assert [reason for _, reason in outside.failed] == [
            "the region [0, 0, 100, 10] does not lie within an image of 16x12"
        ] * 2
        assert np.array_equal(catalog.views().views.descriptors[0], hbr.describe(image(0)[:10, :10]))

    def test_it_goes_on_where_it_was_stopped(self, catalog: Catalog, monkeypatch: pytest.MonkeyPatch) -> None:
        true_fill(catalog, "mug", 6, 0)
        monkeypatch.setattr("rig.catalog.jobs.PORTION", 2)
        job = redescribe(catalog, "cedd-blurred")
        assert [next(job).done for _ in range(2)] == [0, 2]
        job.close()
        assert finished(redescribe(catalog, "cedd-blurred")).described == 4

    def test_a_missing_image_does_not_stop_the_others(self, catalog: Catalog) -> None:
        true_fill(catalog, "mug", 3, 0)
        lost = catalog.object("mug").views[1]
        catalog.image_path(lost).unlink()
        done = finished(redescribe(catalog, again=True))
        assert (done.described, [path for path, _ in done.failed]) == (2, [lost.image])
        assert len(catalog.views().views) == 3  # what was known of it is kept
        with pytest.raises(DescriptorOutdated):
            finished(redescribe(catalog, "cedd-blurred"))
            catalog.views("cedd-blurred")


def test_settings_that_nobody_knows_are_told(catalog: Catalog) -> None:
    true_fill(catalog, "mug", 1, 0)
    sql(catalog, """UPDATE descriptors SET settings = '{"lens": "fish"}'""")
    with pytest.raises(CatalogError, match="fish") as refused:
        catalog.object("mug")
    assert "redescribe" in refused.value.next_step
    values: dict[str, Any] = {"jobs": 1}
    assert problems(finished(verify(catalog, **values))) == [Problem.DESCRIPTOR_DIFFERS]
