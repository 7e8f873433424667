"""Results: recorded with their image, corrected without a change of the answer, checked, exported."""

import csv
import json
import os
import shutil
import signal
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from rig.catalog import Catalog
from rig.catalog.edit import delete, rename
from rig.catalog.exchange import read_objects, write_bundle
from rig.catalog.exchange.tables import RESULTS, TableFormat, write_results
from rig.catalog.records import Outcome
from rig.catalog.results import ResultFilter, correct, find_result, find_results, record
from rig.catalog.upkeep import collect_garbage
from rig.catalog.verify import verify
from rig.catalog.verify_images import Problem
from rig.core.errors import CatalogError, ExportFailed, ObjectNotFound, UsageError
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import (
    finished,
    image,
    new_result,
    other_program,
    true_fill,
    without_waiting,
)


@pytest.fixture(scope="module")
def three_results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("results") / "catalog"
    clock = VirtualClock()
    with pytest.MonkeyPatch.context() as patch, Catalog.open(path, clock=clock) as opened:
        without_waiting(patch)
        true_fill(opened, "mug", 1, 0)
        true_fill(opened, "tin", 1, 10)
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
    assert second.answered == (Outcome.AMBIGUOUS, "tin", "S-2")
    assert (second.operator, first.operator) == ("A. Silva", first.user)
    assert (second.time_utc - first.time_utc).total_seconds() == 3600
    assert (first.provenance.bench, first.catalog_version) == ("bench-1", "c" * 64)
    assert first.details["yaw_deg"] == 70.0
    assert first.azimuths_deg == (0.0, 60.0)
    assert first.image is not None
    assert first.image_sha256 is not None
    assert np.array_equal(catalog.database.images.pixels(str(first.image), str(first.image_sha256)), image(1))
    assert third.image is None


def test_results_are_filtered(catalog: Catalog) -> None:
    times = [result.time_utc for result in find_results(catalog)]
    assert numbers(catalog, sample="S-2") == [2]
    assert numbers(catalog, object_name="mug") == [1]
    assert numbers(catalog, outcome=Outcome.UNKNOWN) == [3]
    assert numbers(catalog, bench="another") == []
    assert numbers(catalog, since=times[1], before=times[2]) == [2]
    assert numbers(catalog, corrected=True) == []


def test_correction_keeps_the_answer_and_is_in_the_log(catalog: Catalog) -> None:
    correct(catalog, 1, object_name="tin", sample="S-9", reason="read the label", operator="B. Meyer")
    correct(catalog, 1, unknown=True, reason="it was neither")
    result = find_result(catalog, 1)
    assert result.answered == (Outcome.FOUND, "mug", "S-1")
    assert result.current == (Outcome.UNKNOWN, None, "S-9")
    assert [(one.operator, one.reason) for one in result.corrections] == [
        ("B. Meyer", "read the label"),
        (result.user, "it was neither"),
    ]
    row = result.as_row()
    assert (row["object"], row["answered_object"], row["yaw_deg"], row["confidence"]) == (None, "mug", None, None)
    assert numbers(catalog, outcome=Outcome.UNKNOWN) == [1, 3]
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


def test_results_outlive_their_objects_and_stay_out_of_bundles(catalog: Catalog, tmp_path: Path) -> None:
    rename(catalog, "tin", "box")
    delete(catalog, "mug")
    collect_garbage(catalog, old=True)
    assert [result.answered.object_name for result in find_results(catalog)] == ["mug", "tin", None]
    assert finished(verify(catalog, jobs=1)).findings == ()
    write_bundle(tmp_path / "a.zip", read_objects(catalog))  # it would reject an image that belongs to no view


def test_version_of_the_catalog_changes_with_the_views_of_searches(catalog: Catalog) -> None:
    first = catalog.version()
    record(catalog, new_result(), None)
    assert catalog.version() == first
    true_fill(catalog, "box", 1, 20)
    rename(catalog, "box", "case")
    delete(catalog, "case")
    assert catalog.version() == first
    rename(catalog, "tin", "can")
    assert catalog.version() != first


def changed(connection: sqlite3.Connection) -> None:
    connection.execute("UPDATE results SET object_name = 'tin' WHERE id = 1")


def deleted_first(connection: sqlite3.Connection) -> None:
    connection.execute("DELETE FROM results WHERE id = 1")


def deleted_last(connection: sqlite3.Connection) -> None:
    connection.execute("DELETE FROM corrections WHERE id = 1")


@pytest.mark.parametrize(("spoil", "row"), [(changed, 1), (deleted_first, 2), (deleted_last, 1)])
@pytest.mark.sqlite
def test_rows_cannot_change_and_verify_finds_a_change_without_triggers(
    catalog: Catalog, spoil: Callable[[sqlite3.Connection], None], row: int
) -> None:
    correct(catalog, 1, unknown=True, reason="why")
    with closing(sqlite3.connect(catalog.path / "catalog.sqlite", isolation_level=None)) as connection:
        with pytest.raises(sqlite3.IntegrityError, match="only appended to"):
            spoil(connection)
        triggers = connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'").fetchall()
        for name, _ in triggers:
            connection.execute(f"DROP TRIGGER {name}")
        spoil(connection)
        for _, statement in triggers:
            connection.execute(statement)
    found = finished(verify(catalog, repair=True, jobs=1)).unrepaired
    assert (Problem.RESULT_CHANGED, row) in [(one.problem, one.details.get("entry_id")) for one in found]


def test_verify_finds_a_changed_image(catalog: Catalog) -> None:
    path = find_result(catalog, 1).image
    assert path is not None
    (catalog.path / path).write_bytes(b"x")
    (finding,) = finished(verify(catalog, jobs=1)).findings
    assert (finding.problem, finding.path) == (Problem.CHANGED_IMAGE, path)


@pytest.mark.parametrize("die_before", [*(pytest.param(n, marks=pytest.mark.nightly) for n in (1, 2, 3, 4, 5, 7)), 6])
def test_process_killed_while_recording_leaves_nothing_half_written(tmp_path: Path, die_before: int) -> None:
    program = other_program(tmp_path / "catalog", "-", 0, die_before)
    assert program.communicate()[0] == "answered\n"
    with Catalog.open(tmp_path / "catalog", clock=VirtualClock()) as catalog:
        killed = program.returncode == -signal.SIGKILL
        assert numbers(catalog) == ([1] if killed else [1, 2])
        record(catalog, new_result(), image(3))
        assert finished(verify(catalog, jobs=1)).findings == ()  # the image without a row was replaced


def test_table_has_a_row_for_each_result(catalog: Catalog, tmp_path: Path) -> None:
    correct(catalog, 1, sample="=1+1", reason='a "quoted" reason')
    results = find_results(catalog)
    assert list(results[0].as_row()) == list(RESULTS)
    for form in TableFormat:
        write_results(tmp_path / f"a.{form}", results, form)
    with pytest.raises(ExportFailed, match="exists already"):
        write_results(tmp_path / "a.csv", results, TableFormat.CSV)
    with (tmp_path / "a.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    loaded = json.loads((tmp_path / "a.json").read_text())
    for row, other, result in zip(rows, loaded, results, strict=True):
        assert row == {key: "" if value is None else str(value) for key, value in other.items()}
        assert other["time_utc"] == result.time_utc.isoformat()
    assert (loaded[0]["sample"], loaded[0]["answered_sample"]) == ("=1+1", "S-1")
    parquet = pytest.importorskip("pyarrow.parquet").read_table(tmp_path / "a.parquet").to_pylist()
    assert parquet == [result.as_row() for result in results]


def test_full_disk_is_reported_and_earlier_results_are_safe(catalog: Catalog, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: int) -> None:
        raise OSError(28, os.strerror(28))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fail)
        with pytest.raises(CatalogError, match=r"full.*earlier ones are safe"):
            record(catalog, new_result(), image(5))
    assert numbers(catalog) == [1, 2, 3]
    assert record(catalog, new_result(), image(5)) == 4
