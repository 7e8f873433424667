"""Verify, repair and redescribe a catalog."""

from pathlib import Path

import numpy as np
import pytest

import hbr
from hbr.descriptors import descriptor, registry
from hbr.descriptors.plain_cedd import Cedd
from rig.catalog import Catalog
from rig.catalog.redescribe import redescribe
from rig.catalog.seal import seal_enrollments
from rig.catalog.unfinished import UnfinishedJob
from rig.catalog.upkeep import collect_garbage, statistics
from rig.catalog.verify import Verification, verify
from rig.catalog.verify_images import Problem
from rig.cli.catalog.findings import finding_text
from rig.core.errors import CatalogDamaged, CatalogError, DescriptorOutdated, UsageError
from rig.core.next_steps import Do
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import (
    PROVENANCE,
    described,
    files,
    finished,
    image,
    plan,
    record,
    sql,
    true_fill,
)


def problems(found: Verification) -> list[str]:
    return [finding.problem for finding in found.findings]


class TestVerify:
    @pytest.fixture(autouse=True)
    def enrolled(self, catalog: Catalog) -> None:
        true_fill(catalog, "mug", 3, 0)
        true_fill(catalog, "tin", 3, 10, (2, 0, 12, 12))

    def images(self, catalog: Catalog, name: str) -> list[Path]:
        return [catalog.image_path(view) for view in catalog.object(name).views]

    def repaired(self, catalog: Catalog) -> list[str]:
        """Repair the catalog, check that nothing is found afterwards, and return the problems."""
        found = finished(verify(catalog, repair=True))
        assert found.unrepaired == ()
        assert finished(verify(catalog)).findings == ()
        for name, seed in (("mug", 0), ("tin", 10)):
            for view in catalog.object(name).views:
                assert np.array_equal(catalog.read_image(view), image(seed + view.record.index))
        return problems(found)

    def test_continued_check_leaves_out_what_was_right(self, catalog: Catalog, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("rig.catalog.jobs.PORTION", 1)
        first, *_ = self.images(catalog, "mug")
        content = first.read_bytes()
        first.write_bytes(b"damaged")  # so this view has to be checked again
        with UnfinishedJob(catalog.path / "unfinished", "verify") as unfinished:
            job = verify(catalog, jobs=1, unfinished=unfinished)
            assert [next(job).done for _ in range(5)] == [0, 1, 2, 3, 4]
            job.close()
        first.write_bytes(content)

        def again(**options: bool) -> list[str]:
            with UnfinishedJob(catalog.path / "unfinished", "verify") as unfinished:
                unfinished.load()
                return problems(finished(verify(catalog, jobs=1, unfinished=unfinished, **options)))

        for one in self.images(catalog, "mug")[1:]:
            one.write_bytes(b"damaged")
        assert again() == []  # they were right
        assert Problem.CHANGED_IMAGE in again(quick=True)  # another kind of check
        assert problems(finished(verify(catalog))).count(Problem.CHANGED_IMAGE) == 2

    @pytest.mark.sqlite
    def test_continued_check_looks_at_views_whose_rows_changed(self, catalog: Catalog) -> None:
        with UnfinishedJob(catalog.path / "unfinished", "verify") as unfinished:
            assert problems(finished(verify(catalog, unfinished=unfinished))) == []
        sql(catalog, "UPDATE views SET image_sha256 = 'another' WHERE id = 2")
        with UnfinishedJob(catalog.path / "unfinished", "verify") as unfinished:
            unfinished.load()
            assert len(unfinished.found) == 6
            assert Problem.CHANGED_IMAGE in problems(finished(verify(catalog, unfinished=unfinished)))

    def test_several_processes_report_a_missing_image(self, catalog: Catalog, monkeypatch: pytest.MonkeyPatch) -> None:
        found = finished(verify(catalog))
        assert (found.objects, found.views, found.findings) == (2, 6, ())
        self.images(catalog, "mug")[1].unlink()
        monkeypatch.setattr("rig.catalog.jobs.PORTION", 1)
        alone, together = finished(verify(catalog, jobs=1)), finished(verify(catalog, jobs=2))
        assert alone == together
        assert problems(alone) == [Problem.MISSING_IMAGE]

        (finding,) = finished(verify(catalog, repair=True)).unrepaired
        assert (finding.problem, finding.object_name) == (Problem.MISSING_IMAGE, "mug")
        assert finding.details["copy"] is None
        assert finding_text(finding) == (
            f"image missing: 'mug': {finding.path}; No such file or directory; "
            "restore it from a backup, or enroll the object again: rig enroll --replace"
        )

    def test_renamed_and_swapped_images_are_restored(self, catalog: Catalog) -> None:
        first = self.images(catalog, "mug")[0]
        first.rename(first.with_name("copy of 0.png"))
        assert problems(finished(verify(catalog))) == [Problem.MISSING_IMAGE, Problem.ORPHANED_FILE]
        assert not first.exists()
        assert self.repaired(catalog) == [Problem.MISSING_IMAGE, Problem.ORPHANED_FILE]
        assert (catalog.path / "lost+found").exists()

        first, second, _ = self.images(catalog, "mug")
        a, b = first.read_bytes(), second.read_bytes()
        first.write_bytes(b)
        second.write_bytes(a)
        assert self.repaired(catalog) == [Problem.CHANGED_IMAGE, Problem.CHANGED_IMAGE]

    @pytest.mark.parametrize("damage", [b"", b"\x89PNG\r\n\x1a\n", b"x" * 5000])
    def test_damaged_image_is_found(self, catalog: Catalog, damage: bytes) -> None:
        self.images(catalog, "tin")[2].write_bytes(damage)
        for quick in (True, False):
            assert problems(finished(verify(catalog, quick=quick))) == [Problem.CHANGED_IMAGE]

    @pytest.mark.sqlite
    def test_wrong_descriptor_is_computed_again(self, catalog: Catalog) -> None:
        sql(catalog, "UPDATE descriptors SET packed = zeroblob(54) WHERE view_id IN (2, 5)")
        found = finished(verify(catalog))
        assert problems(found) == [Problem.DESCRIPTOR_DIFFERS] * 2 + [Problem.ENROLLMENT_CHANGED] * 2
        assert [finding.object_name for finding in found.findings] == ["mug", "tin"] * 2
        assert len(self.repaired(catalog)) == 2

    @pytest.mark.sqlite
    def test_view_without_descriptor_is_described_within_its_region(self, catalog: Catalog) -> None:
        before = catalog.views().views.descriptors
        sql(catalog, "DELETE FROM descriptors WHERE view_id = 4")
        assert problems(finished(verify(catalog))) == [Problem.NOT_DESCRIBED, Problem.ENROLLMENT_CHANGED]
        sql(catalog, """UPDATE sessions SET conditions = '{"view": {"roi": [2, 0, 12, 12]}}' WHERE id = 2""")
        with pytest.raises(DescriptorOutdated, match="'tin'"):
            catalog.views()
        assert finished(redescribe(catalog)).described == 1
        with pytest.raises(CatalogDamaged, match="'tin'"):  # its session was changed
            catalog.views()
        with catalog.database.write() as connection:
            seal_enrollments(connection, None)
        assert np.array_equal(catalog.views().views.descriptors, before)

    @pytest.mark.sqlite
    def test_orphaned_rows_are_recorded_in_the_log(self, catalog: Catalog) -> None:
        sql(catalog, "DELETE FROM enrollments WHERE id = 2")
        assert set(problems(finished(verify(catalog)))) == {Problem.ORPHANED_ROW}
        repaired = finished(verify(catalog, repair=True))
        assert set(problems(repaired)) == {Problem.ORPHANED_ROW, Problem.ORPHANED_FILE}
        assert repaired.unrepaired == ()
        assert finished(verify(catalog)).findings == ()
        kept = [e.details["row"] for e in catalog.log() if e.action == "orphaned row removed"]
        assert {row["azimuth_deg"] for row in kept if "azimuth_deg" in row} == {0.0, 5.0, 10.0}
        assert sorted((catalog.path / "lost+found").rglob("*.png"))

    def test_views_of_different_sizes_are_reported(self, catalog: Catalog) -> None:
        enrollment = catalog.begin("jar", planned_azimuth_deg=plan(2), provenance=PROVENANCE)
        for index, picture in enumerate((image(0), image(1)[:, :10])):
            enrollment.add(record(index, descriptors={"cedd": hbr.describe(picture)}), picture)
        assert problems(finished(verify(catalog))) == [Problem.SIZES_DIFFER]

    def test_empty_table_image_is_checked(self, catalog: Catalog) -> None:
        enrollment = catalog.begin("jar", planned_azimuth_deg=plan(2), provenance=PROVENANCE)
        enrollment.store_empty_table(image(7))
        assert finished(verify(catalog)).findings == ()
        (catalog.path / (enrollment.session.empty_table_image or "")).write_bytes(b"x")
        assert problems(finished(verify(catalog))) == [Problem.CHANGED_IMAGE]

    def test_verify_without_repair_changes_nothing(self, catalog: Catalog) -> None:
        self.images(catalog, "mug")[1].unlink()
        (catalog.path / "images" / "stray.png").write_bytes(b"x")
        before = (files(catalog), len(catalog.log()))
        with Catalog.open(catalog.path, clock=VirtualClock(), read_only=True) as reader:
            assert len(finished(verify(reader)).findings) == 2
        assert (files(catalog), len(catalog.log())) == before


class TestRedescribe:
    def test_new_version_of_a_descriptor_needs_redescribe(
        self, catalog: Catalog, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        true_fill(catalog, "mug", 3, 0)
        true_fill(catalog, "tin", 2, 10)
        monkeypatch.setitem(registry._KNOWN, "cedd", Cedd(version=2))
        with pytest.raises(DescriptorOutdated, match=r"0 of 5 views have the descriptor cedd 2") as error:
            catalog.views()
        assert Do.REDESCRIBE() in error.value.steps
        assert "it is missing for 'mug', 'tin'. Other views have version 1." in error.value.what
        assert error.value.evidence["objects"] == 2
        assert catalog.object("mug").views[0].record.descriptors == {}
        done = finished(redescribe(catalog))
        assert (done.version, done.described, done.unchanged, done.failed) == (2, 5, 0, ())
        assert len(catalog.views().views) == 5
        assert finished(redescribe(catalog)).described == 0
        # both versions stay, for a bench with an older program, until garbage is collected
        assert [kind.version for kind in statistics(catalog).descriptors] == [1, 2]
        collect_garbage(catalog)
        assert [kind.version for kind in statistics(catalog).descriptors] == [2]

    def test_redescribe_adds_another_descriptor(self, catalog: Catalog) -> None:
        true_fill(catalog, "mug", 3, 0, (2, 0, 12, 12))
        with pytest.raises(DescriptorOutdated, match="0 of 3 views have the descriptor cedd-blurred") as error:
            catalog.views("cedd-blurred")
        assert error.value.steps == (Do.REDESCRIBE(descriptor="cedd-blurred"),)
        finished(redescribe(catalog, "cedd-blurred"))
        wanted = descriptor("cedd-blurred").describe(image(1)[:, 2:14])
        assert np.array_equal(catalog.views("cedd-blurred").views.descriptors[1], wanted)
        assert np.array_equal(catalog.views().views.descriptors[1], hbr.describe(image(1)[:, 2:14]))
        true_fill(catalog, "tin", 2, 10)
        with pytest.raises(DescriptorOutdated) as error:
            catalog.views("cedd-blurred")
        assert error.value.what == "3 of 5 views have the descriptor cedd-blurred 1; it is missing for 'tin'."
        with pytest.raises(UsageError, match="sift"):
            catalog.views("sift")

    def test_region_is_not_applied_to_imported_views(self, catalog: Catalog) -> None:
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
            "The region [0, 0, 100, 10] does not lie within an image of 16x12"
        ] * 2
        assert np.array_equal(catalog.views().views.descriptors[0], hbr.describe(image(0)[:10, :10]))

    def test_redescribe_again_continues_after_an_interruption(self, catalog: Catalog, monkeypatch) -> None:
        true_fill(catalog, "mug", 6, 0)
        monkeypatch.setattr("rig.catalog.jobs.PORTION", 2)
        with UnfinishedJob(catalog.path / "unfinished", "again") as first:
            job = redescribe(catalog, again=True, jobs=1, unfinished=first)
            assert [next(job).done for _ in range(3)] == [0, 2, 4]
            job.close()
        with UnfinishedJob(catalog.path / "unfinished", "again") as second:
            second.load()
            assert finished(redescribe(catalog, again=True, unfinished=second)).described == 2

    def test_redescribe_continues_after_an_interruption(self, catalog: Catalog, monkeypatch) -> None:
        true_fill(catalog, "mug", 6, 0)
        monkeypatch.setattr("rig.catalog.jobs.PORTION", 2)
        job = redescribe(catalog, "cedd-blurred")
        assert [next(job).done for _ in range(2)] == [0, 2]
        job.close()
        assert finished(redescribe(catalog, "cedd-blurred")).described == 4

    def test_redescribe_skips_missing_images(self, catalog: Catalog) -> None:
        true_fill(catalog, "mug", 3, 0)
        lost = catalog.object("mug").views[1]
        catalog.image_path(lost).unlink()
        done = finished(redescribe(catalog, again=True))
        assert (done.described, [path for path, _ in done.failed]) == (2, [lost.image])
        assert len(catalog.views().views) == 3  # the old levels of the missing image stay
        with pytest.raises(DescriptorOutdated):
            finished(redescribe(catalog, "cedd-blurred"))
            catalog.views("cedd-blurred")


@pytest.mark.sqlite
def test_unknown_settings_are_reported(catalog: Catalog) -> None:
    true_fill(catalog, "mug", 1, 0)
    sql(catalog, """UPDATE descriptors SET settings = '{"lens": "fish"}'""")
    with pytest.raises(CatalogError, match="fish") as error:
        catalog.object("mug")
    assert Do.REDESCRIBE() in error.value.steps
    assert problems(finished(verify(catalog, jobs=1))) == [Problem.DESCRIPTOR_DIFFERS, Problem.ENROLLMENT_CHANGED]
