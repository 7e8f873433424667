"""Results: recorded with their image, corrected without a change of the answer, checked, exported."""

import csv
import json
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from rig.catalog import Catalog
from rig.catalog.exchange.tables import RESULTS, TableFormat, write_rows
from rig.catalog.records import RecordedOutcome
from rig.catalog.results import ResultFilter, correct, find_result, find_results, record
from rig.catalog.transfer import CatalogSource, transfer
from rig.catalog.upkeep import collect_garbage
from rig.catalog.verify import CatalogProblem, verify
from rig.core.errors import CatalogDamaged, CatalogError, ExportFailed, ObjectNotFound, UsageError
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import fill, finished, image, new_result, sql, without_waiting


@pytest.fixture(scope="module")
def three_results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("results") / "catalog"
    clock = VirtualClock()
    with pytest.MonkeyPatch.context() as patch, Catalog.open(path, clock=clock) as opened:
        without_waiting(patch)
        fill(opened, "mug", 1, 0)
        fill(opened, "tin", 1, 10)
        record(opened, new_result(sample="S-1"), image(1))
        clock.sleep(3600)
        record(opened, new_result("ambiguous", "tin", " S-2 ", operator="A. Silva"), image(2))
        clock.sleep(3600)
        record(opened, new_result("unknown", None), None)
    return path


@pytest.fixture
def catalog(three_results: Path, tmp_path: Path) -> Iterator[Catalog]:
    with Catalog.open(shutil.copytree(three_results, tmp_path / "catalog"), clock=VirtualClock()) as opened:
        yield opened


def numbers(catalog: Catalog, **wanted: object) -> list[int]:
    return [result.id for result in find_results(catalog, ResultFilter(**wanted))]  # type: ignore[arg-type]


def test_result_has_everything_about_the_answer(catalog: Catalog) -> None:
    first, second, third = find_results(catalog)
    assert second.answered == (RecordedOutcome.AMBIGUOUS, "tin", "S-2")
    assert (second.operator, first.operator) == ("A. Silva", first.user)
    assert (second.time_utc - first.time_utc).total_seconds() == 3600
    assert (first.provenance.bench, first.catalog_version) == ("bench-1", "c" * 64)
    assert first.details["yaw_deg"] == 70.0
    assert first.azimuths_deg == (0.0, 60.0)
    assert first.image is not None
    assert np.array_equal(catalog.read_image(first.image), image(1))
    assert (catalog.path / str(first.image_path)).is_file()
    assert third.image is None


def test_results_are_filtered(catalog: Catalog) -> None:
    times = [result.time_utc for result in find_results(catalog)]
    assert numbers(catalog, sample="S-2") == [2]
    assert numbers(catalog, object_name="mug") == [1]
    assert numbers(catalog, outcome=RecordedOutcome.UNKNOWN) == [3]
    assert numbers(catalog, since=times[1], before=times[2]) == [2]


def test_correction_keeps_the_answer_and_is_in_the_log(catalog: Catalog) -> None:
    correct(catalog, 1, object_name="tin", sample="S-9", reason="read the label", operator="B. Meyer")
    correct(catalog, 1, unknown=True, reason="it was neither")
    result = find_result(catalog, 1)
    assert result.answered == (RecordedOutcome.FOUND, "mug", "S-1")
    assert result.current == (RecordedOutcome.UNKNOWN, None, "S-9")
    assert [(one.operator, one.reason) for one in result.corrections] == [
        ("B. Meyer", "read the label"),
        (result.user, "it was neither"),
    ]
    row = result.as_row()
    assert (row.object, row.answered_object, row.yaw_deg, row.confidence, row.not_enrolled) == (
        None,
        "mug",
        *[None] * 3,
    )
    assert numbers(catalog, outcome=RecordedOutcome.UNKNOWN) == [1, 3]
    entries = catalog.log()[-5:]
    assert [(entry.action, entry.object_name, entry.details["result"]) for entry in entries] == [
        ("identified", "mug", 1),
        ("identified", "tin", 2),
        ("identified", None, 3),
        ("result corrected", "tin", 1),
        ("result corrected", None, 1),
    ]
    assert entries[3].details["before"] == ["found", "mug", "S-1"]


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"object_name": "mugg"}, ObjectNotFound),
        ({"object_name": "mug", "unknown": True}, UsageError),
        ({"object_name": "mug"}, UsageError),  # the object is already correct
        ({"unknown": True, "reason": " "}, UsageError),
        ({"sample": "a\tb"}, UsageError),
        ({"sample": "x" * 2000}, UsageError),
        ({"result_id": 9, "unknown": True}, CatalogError),
    ],
)
def test_impossible_corrections_change_nothing(catalog: Catalog, changes: dict[str, str], error: type) -> None:
    with pytest.raises(error):
        correct(catalog, **{"result_id": 1, "reason": "why", **changes})  # type: ignore[arg-type]
    assert find_result(catalog, 1).corrections == ()


def test_results_outlive_their_objects_and_stay_out_of_transfers(catalog: Catalog, tmp_path: Path) -> None:
    catalog.rename("tin", "box")
    catalog.delete("mug")
    collect_garbage(catalog, old=True)
    assert [result.answered.object_name for result in find_results(catalog)] == ["mug", "tin", None]
    assert finished(verify(catalog, jobs=1)).findings == ()
    with Catalog.open(tmp_path / "other", clock=VirtualClock()) as other:
        finished(transfer(CatalogSource(catalog), other))
        assert find_results(other) == []


def test_version_of_the_catalog_changes_with_the_views_of_searches(catalog: Catalog) -> None:
    first = catalog.version()
    record(catalog, new_result(), None)
    assert catalog.version() == first
    fill(catalog, "box", 1, 20)
    catalog.rename("box", "case")
    catalog.delete("case")
    assert catalog.version() == first
    catalog.rename("tin", "can")
    assert catalog.version() != first


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ("UPDATE log SET object_name = 'tin' WHERE result = 1 AND action = 'identified'", 5),
        ("UPDATE log SET record = replace(record, 'bench-1', 'bench-2') WHERE result = 1", 5),
        ("DELETE FROM log WHERE result = 2", 6),
        ("DELETE FROM log WHERE action = 'result corrected'", 8),
    ],
)
@pytest.mark.sqlite
def test_lines_cannot_change_and_verify_finds_a_change_without_triggers(
    catalog: Catalog, change: str, line: int
) -> None:
    correct(catalog, 1, unknown=True, reason="why")
    with (
        closing(sqlite3.connect(catalog.path / "catalog.sqlite", isolation_level=None)) as connection,
        pytest.raises(sqlite3.IntegrityError, match="a fact is written once"),
    ):
        connection.execute(change)
    sql(catalog, change)
    found = finished(verify(catalog, jobs=1)).findings
    assert (CatalogProblem.LOG_CHANGED, line) in [(one.problem, one.details.get("entry_id")) for one in found]
    if change.startswith("UPDATE"):
        for read in (lambda: find_results(catalog), lambda: find_result(catalog, 1)):
            with pytest.raises(CatalogDamaged, match="Result 1 in the catalog changed after it was recorded"):
                read()
        assert find_result(catalog, 2).answered.sample == "S-2"


def test_verify_finds_a_changed_image(catalog: Catalog) -> None:
    path = find_result(catalog, 1).image_path
    assert path is not None
    (catalog.path / path).write_bytes(b"x")
    (finding,) = finished(verify(catalog, jobs=1)).findings
    assert (finding.problem, finding.path) == (CatalogProblem.CHANGED_IMAGE, path)


def test_table_has_a_row_for_each_result(catalog: Catalog, tmp_path: Path) -> None:
    correct(catalog, 1, sample="=1+1", reason='a "quoted" reason')
    wanted = [one.as_row().model_dump() for one in find_results(catalog)]
    for form in TableFormat:
        write_rows(tmp_path / f"a.{form}", form, RESULTS, wanted)
    with pytest.raises(ExportFailed, match="exists already"):
        write_rows(tmp_path / "a.csv", TableFormat.CSV, RESULTS, wanted)
    loaded = json.loads((tmp_path / "a.json").read_text())
    assert (loaded[0]["sample"], loaded[0]["answered_sample"]) == ("=1+1", "S-1")
    with (tmp_path / "a.csv").open(newline="") as file:
        rows = [{key: "" if value is None else str(value) for key, value in one.items()} for one in loaded]
        assert list(csv.DictReader(file)) == rows
    assert pytest.importorskip("pyarrow.parquet").read_table(tmp_path / "a.parquet").to_pylist() == wanted
