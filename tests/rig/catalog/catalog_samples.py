"""Sample views for the tests of the catalog, and a program that enrolls them.

The program prints the index of each stored view, and kills itself before a durable step. Steps count from 1: two syncs
for a new folder, sync of the image, rename, sync of its folder, commit, then those of the next view.
"""

import os
import signal
import sqlite3
import sys
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from sqlalchemy import Engine, delete, event

from rig.catalog import Catalog, Provenance, View
from rig.catalog.facts import Derived
from rig.catalog.jobs import finished as finished
from rig.catalog.records import RecordedOutcome
from rig.catalog.results import Answer, NewResult
from rig.catalog.results import record as record_result
from rig.core.clock import SystemClock
from tests.programs import Program
from tests.servers.postgres import use_postgres

NOW = datetime(2026, 3, 1, tzinfo=UTC)
OpenCatalog = Callable[[str], Catalog]
PROVENANCE = Provenance("bench-1", {"servo": {"model": "XL430-W250", "id": 1}}, {"noise": "defaults"})


def without_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip waiting for the disk, except in the database. `test_durability` tests what is durable."""
    monkeypatch.setattr(os, "fsync", lambda _: None)
    monkeypatch.setattr(os, "sync", lambda: None)


def plan(views: int) -> list[float]:
    return [i * 360 / views for i in range(views)]


def image(seed: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (24, 32, 3), np.uint8)


def record(index: int, /, **changes: Any) -> View:
    values: dict[str, Any] = {
        "index": index,
        "commanded_deg": -5.0 * index,
        "encoder_deg": -5.0 * index + 0.03,
        "azimuth_deg": 5.0 * index % 360,
        "captured_ns": 0,
    }
    return View(**values | changes)


def fill(
    catalog: Catalog,
    name: str,
    views: int,
    seed: int = 0,
    region: tuple[int, int, int, int] | None = None,
    **begin: Any,
) -> None:
    """Enroll an object with the images of ``seed`` and the numbers after it."""
    enrollment = catalog.begin(name, planned_azimuth_deg=plan(views), provenance=PROVENANCE, **begin)
    for index in range(views):
        enrollment.add(record(index, region=region), image(seed + index))
    enrollment.finish()


def new_result(
    outcome: str = "found", object_name: str | None = "mug", sample: str | None = None, **changes: Any
) -> NewResult:
    values: dict[str, Any] = {
        "answered": Answer(RecordedOutcome(outcome), object_name, sample),
        "details": {
            "event": "identified",
            "yaw_deg": 70.0,
            "yaw_sigma_deg": 1.5,
            "confidence": 0.99,
            "not_enrolled": 0.003,
            "score": 0.9,
        },
        "azimuths_deg": (0.0, 60.0),
        "provenance": PROVENANCE,
        "catalog_version": "c" * 64,
    }
    return NewResult(**values | changes)


def main() -> None:
    use_postgres()
    path, name, views, die_before = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    with Catalog.open(path, clock=SystemClock()) as catalog:
        if not views:
            record_result(catalog, new_result(), image(1))
            print("answered", flush=True)
            die_at(die_before)
            record_result(catalog, new_result(), image(2))
            return
        enrollment = catalog.begin(name, planned_azimuth_deg=plan(views), provenance=PROVENANCE)
        if die_before:
            die_at(die_before)
        for index in range(views):
            enrollment.add(record(index), image(index))
            print(index, flush=True)
        enrollment.finish()


def die_at(step: int) -> None:
    steps = count(1)

    def counted(call: Any) -> Any:
        def maybe_die(*args: Any) -> Any:
            if next(steps) == step:
                os.kill(os.getpid(), signal.SIGKILL)
            return call(*args)

        return maybe_die

    os.fsync, os.replace = counted(os.fsync), counted(os.replace)
    event.listen(Engine, "commit", counted(lambda _: None))


def other_program(path: Path, name: str, views: int, die_before: int = 0) -> Program:
    """Start a program that enrolls, or records answers if ``views`` is 0; it dies before that step of storing."""
    code = "from tests.rig.catalog.catalog_samples import main; main()"
    return Program(str(path), name, str(views), str(die_before), code=code)


def forget(catalog: Catalog) -> None:
    """Remove everything that can be computed again."""
    with catalog.database.write() as transaction:
        transaction.execute(delete(Derived))


def files(catalog: Catalog) -> set[str]:
    return {path.relative_to(catalog.path).as_posix() for path in catalog.path.rglob("*.png")}


def sql(catalog: Catalog | Path, *statements: str) -> None:
    """Change the database directly, as a person could who removes its triggers and puts them back."""
    root = catalog if isinstance(catalog, Path) else catalog.path
    with closing(sqlite3.connect(root / "catalog.sqlite", isolation_level=None)) as connection:
        triggers = connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'").fetchall()
        removed = [f"DROP TRIGGER {name}" for name, _ in triggers]
        for statement in (*removed, *statements, *(definition for _, definition in triggers)):
            connection.execute(statement)
