"""Verify a catalog, and describe its views again."""

from pathlib import Path

import numpy as np
import pytest

from rig.catalog import Catalog, derived
from rig.catalog.verify import CatalogFinding, CatalogProblem, CatalogVerification, verify
from rig.views.description import BENCH_DESCRIPTOR
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import (
    PROVENANCE,
    files,
    fill,
    finished,
    image,
    plan,
    record,
    sql,
)

REGION = (4, 0, 24, 24)


def problems(found: CatalogVerification) -> list[str]:
    return [finding.problem for finding in found.findings]


def concerned(found: CatalogVerification) -> list[tuple[str, str | None]]:
    return [(finding.problem, finding.object_name) for finding in found.findings]


class TestVerify:
    @pytest.fixture(autouse=True)
    def enrolled(self, catalog: Catalog) -> None:
        fill(catalog, "mug", 3, 0)
        fill(catalog, "tin", 3, 10, REGION)

    def images(self, catalog: Catalog, name: str) -> list[Path]:
        return [catalog.image_path(view.image) for view in catalog.object(name).views]

    def test_several_processes_report_a_missing_image(self, catalog: Catalog, monkeypatch: pytest.MonkeyPatch) -> None:
        found = finished(verify(catalog))
        assert (found.objects, found.views, found.findings) == (2, 6, ())
        assert found.image_bytes == sum((catalog.path / name).stat().st_size for name in files(catalog))
        lost = self.images(catalog, "mug")[1]
        lost.unlink()
        monkeypatch.setattr("rig.catalog.jobs.PORTION", 1)
        alone, together = finished(verify(catalog, jobs=1)), finished(verify(catalog, jobs=2))
        assert alone == together
        (finding,) = alone.findings
        assert (finding.problem, finding.object_name) == (CatalogProblem.MISSING_IMAGE, "mug")
        assert finding.path == lost.relative_to(catalog.path).as_posix()
        assert finding.text == (
            f"image missing: 'mug': {finding.path}; No such file or directory; "
            "restore it from a backup, or enroll the object again"
        )

    @pytest.mark.sqlite
    @pytest.mark.parametrize(
        ("statement", "found"),
        [
            ("UPDATE views SET azimuth_deg = 7 WHERE id = 2", (CatalogProblem.ENROLLMENT_CHANGED, "mug")),
            ("UPDATE enrollments SET id = 7 WHERE id = 2", (CatalogProblem.MISSING_ENROLLMENT, "tin")),
            ("UPDATE log SET user = 'x' WHERE id = 4", (CatalogProblem.LOG_CHANGED, "tin")),
            ("DELETE FROM log WHERE id = 2", (CatalogProblem.LOG_CHANGED, None)),
            ("UPDATE properties SET value = '4 x' WHERE key = 'head'", (CatalogProblem.DAMAGED_DATABASE, None)),
        ],
    )
    def test_changed_rows_are_named(
        self, catalog: Catalog, statement: str, found: tuple[CatalogProblem, str | None]
    ) -> None:
        sql(catalog, statement)
        with Catalog.open(catalog.path, clock=VirtualClock(), read_only=True) as reader:
            assert found in concerned(finished(verify(reader, jobs=1)))

    @pytest.mark.sqlite
    @pytest.mark.parametrize("column", ["user", "time_utc"])  # a line with another time cannot be read
    def test_images_are_checked_although_lines_of_the_log_are_damaged(self, catalog: Catalog, column: str) -> None:
        lost = self.images(catalog, "tin")[1]
        sql(catalog, f"UPDATE log SET {column} = 'x' WHERE id = 2", "DELETE FROM log WHERE id = 3")
        lost.unlink()
        found = concerned(finished(verify(catalog, jobs=1)))
        assert {
            (CatalogProblem.LOG_CHANGED, "mug"),
            (CatalogProblem.LOG_CHANGED, None),
            (CatalogProblem.MISSING_IMAGE, None),
        } <= set(found)

    @pytest.mark.sqlite
    def test_work_on_one_object_reads_no_lines_of_others(self, catalog: Catalog) -> None:
        enrollment = catalog.begin("jar", planned_azimuth_deg=plan(2), provenance=PROVENANCE)
        sql(catalog, "UPDATE log SET time_utc = 'x' WHERE object_name = 'tin'")  # these cannot be read
        enrollment.add(record(0), image(0))  # with many objects, all lines would take too long
        assert enrollment.missing() == (1,)
        catalog.set_texts("jar", note="of glass")
        catalog.rename("jar", "jam")
        assert (catalog.summary("jam").unfinished_views, catalog.object("jam").summary.note) == (1, "of glass")
        catalog.begin("box", planned_azimuth_deg=plan(2), provenance=PROVENANCE)
        catalog.delete("jam")

    @pytest.mark.sqlite
    def test_removed_and_added_enrollments_are_found(self, catalog: Catalog) -> None:
        sql(
            catalog,
            "UPDATE views SET enrollment_id = 7 WHERE enrollment_id = 2",
            "UPDATE sessions SET enrollment_id = 7 WHERE enrollment_id = 2",
            "UPDATE enrollments SET id = 7 WHERE id = 2",
        )
        found = finished(verify(catalog, jobs=1)).findings
        assert [(one.problem, one.details["enrollment_id"]) for one in found] == [
            (CatalogProblem.MISSING_ENROLLMENT, 2),
            (CatalogProblem.ENROLLMENT_CHANGED, 7),
        ]

    @pytest.mark.sqlite
    def test_wrong_descriptions_are_found_and_computed_again(self, catalog: Catalog) -> None:
        before = derived.views(catalog, BENCH_DESCRIPTOR).descriptors
        sql(catalog, "UPDATE derived SET content = zeroblob(length(content)) WHERE what != 'cedd'")
        found = finished(verify(catalog, jobs=1))
        assert concerned(found) == [(CatalogProblem.DESCRIPTION_DAMAGED, name) for name in ("mug", "mug", "tin", "tin")]
        assert found.findings[0].text == (
            f"description damaged: 'mug'; the stored {BENCH_DESCRIPTOR} is not the one that was computed; "
            "it is computed again when it is needed"
        )
        assert np.array_equal(derived.views(catalog, BENCH_DESCRIPTOR).descriptors, before)
        assert finished(verify(catalog, jobs=1)).findings == ()

    def test_empty_table_image_is_checked(self, catalog: Catalog) -> None:
        enrollment = catalog.begin("jar", planned_azimuth_deg=plan(2), provenance=PROVENANCE, empty_table=image(7))
        assert finished(verify(catalog)).findings == ()
        catalog.image_path(enrollment.session.empty_table or "").write_bytes(b"x")
        assert concerned(finished(verify(catalog))) == [(CatalogProblem.CHANGED_IMAGE, "jar")]

    def test_check_changes_nothing_and_needs_no_image_that_no_row_names(self, catalog: Catalog) -> None:
        catalog.database.images.put(b"\x89PNG of a program that was killed")
        self.images(catalog, "mug")[1].unlink()
        before = (files(catalog), len(catalog.log()))
        with Catalog.open(catalog.path, clock=VirtualClock(), read_only=True) as reader:
            assert problems(finished(verify(reader))) == [CatalogProblem.MISSING_IMAGE]
        assert (files(catalog), len(catalog.log())) == before


@pytest.mark.parametrize("problem", CatalogProblem)
def test_every_problem_has_words_and_a_next_step(problem: CatalogProblem) -> None:
    keys = ("message", "entry_id", "enrollment_id", "reason", "bytes", "stored_bytes", "descriptor")
    details = dict.fromkeys(keys, 1)
    for name in (None, "mug"):
        words = CatalogFinding(problem, name, None, None, details).text
        assert words.startswith(f"{problem}")
        assert words.count("; ") == 2
