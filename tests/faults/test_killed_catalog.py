"""A kill or a full disk at any step of a change of a catalog: nothing is lost, nothing is doubled, verify is clean."""

import errno
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Engine, event

from rig.catalog import EnrollmentStatus, derived
from rig.catalog.jobs import finished
from rig.catalog.results import find_results
from rig.catalog.verify import verify
from rig.core.errors import CatalogError
from rig.core.next_steps import Do
from rig.views.description import BENCH_DESCRIPTOR
from tests.faults.catalog_work import WORK, opened, prepare, run
from tests.programs import Program
from tests.rig.catalog.catalog_samples import without_waiting

KILLS = int(os.environ.get("RIG_TEST_KILLS", "1"))
"""Kills of each kind of work; `make test-kills` asks for more."""
SIMILAR = ("enroll again", "continue", "take again", "replace", "restore", "rename", "correct", "describe")
"""Work that stores as other work does; with one kill, only the nightly tests do it."""
VIEW_BY_VIEW = {"enroll": "new", "enroll again": "mug", "continue": "begun"}
"""Work that keeps each view, and its object; all other work takes effect as a whole or not at all."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("killed")
    with pytest.MonkeyPatch.context() as patch:
        without_waiting(patch)
        prepare(folder / "home")
    return folder


def state(home: Path) -> dict[str, Any]:
    """Return everything that the catalogs of a folder tell, but for times, ids and computed data."""
    found: dict[str, Any] = {}
    for name in ("catalog", "other"):
        with opened(home, name) as catalog:
            found[name] = {
                one.name: (one.label, [_enrollment(each) for each in catalog.object(one.name).enrollments])
                for one in catalog.objects()
            }
            found[name]["deleted"] = [one.name for one in catalog.objects(deleted=True)]
            found[name]["results"] = [(one.answered, len(one.corrections)) for one in find_results(catalog)]
            views = derived.views(catalog, BENCH_DESCRIPTOR)
            found[name]["searched"] = (views.object_names, views.descriptors.tolist())
    return found


def _enrollment(each: Any) -> tuple[EnrollmentStatus, list[tuple[int, str]]]:
    return each.status, [(view.index, view.image) for view in each.enrollment.views]


def views_in_progress(found: dict[str, Any], name: str) -> set[int]:
    """Return the indices of the views of the unfinished enrollment of an object."""
    _, enrollments = found["catalog"].get(name, ("", []))
    views = [views for status, views in enrollments if status is EnrollmentStatus.IN_PROGRESS]
    return {index for index, _ in views[0]} if views else set()


def check_clean(home: Path) -> None:
    for name in ("catalog", "other"):
        with opened(home, name) as catalog:
            assert finished(verify(catalog, jobs=1)).findings == ()


@pytest.mark.parametrize(
    "name", [pytest.param(one, marks=[pytest.mark.nightly] * (KILLS == 1 and one in SIMILAR)) for one in WORK]
)
def test_killed_work_loses_nothing_and_completes(folder: Path, name: str) -> None:
    code = "from tests.faults.catalog_work import main; main()"
    process = Program(str(folder), str(KILLS), "3", name, code=code)
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    before, complete = state(folder / "home"), state(folder / name / "complete")
    runs = [json.loads(line) for line in output.splitlines()]
    assert len(runs) == KILLS
    for one in runs:
        home = folder / name / str(one["number"])
        check_interrupted(name, home, before, complete, one["reported"])
        shutil.rmtree(home)


def check_interrupted(
    name: str, home: Path, before: dict[str, Any], complete: dict[str, Any], reported: list[int]
) -> None:
    """Check what interrupted work left, do the work again, and check that it is complete."""
    check_clean(home)
    found = state(home)
    if name in VIEW_BY_VIEW:
        present = views_in_progress(found, VIEW_BY_VIEW[name])
        there = views_in_progress(before, VIEW_BY_VIEW[name])
        if found != complete:
            assert set(reported) | there <= present
            assert len(present - there - set(reported)) <= 1  # stored, and not reported any more
        for other in before["catalog"].keys() - {VIEW_BY_VIEW[name], "searched"}:
            assert found["catalog"][other] == before["catalog"][other]
    else:
        assert found in (before, complete), "it takes effect as a whole or not at all"
    run(name, home, lambda _: None)
    check_clean(home)
    assert state(home) == complete


@contextmanager
def full_disk(step: int) -> Iterator[list[int]]:
    """Let a step of storing fail, from 1: a sync, a rename or a commit. Yield a list with the number of steps."""
    steps, passed = count(1), [0]
    fsync, rename = os.fsync, os.replace

    def take(reading: bool = False) -> None:
        passed[0] = passed[0] if reading else next(steps)
        if passed[0] == step and not reading:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def failing_fsync(descriptor: int) -> None:
        take()
        fsync(descriptor)

    def failing_rename(source: Any, target: Any) -> None:
        take()
        rename(source, target)

    def failing_commit(connection: Any) -> None:
        take(reading=not connection.get_execution_options().get("begin"))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", failing_fsync)
        patch.setattr(os, "replace", failing_rename)
        event.listen(Engine, "commit", failing_commit)
        try:
            yield passed
        finally:
            event.remove(Engine, "commit", failing_commit)


@contextmanager
def suppress_full_disk() -> Iterator[None]:
    """Let only the error pass that says what to do."""
    try:
        yield
    except CatalogError as error:
        if Do.FREE_DISK() not in error.steps:
            raise


@pytest.mark.parametrize(
    "name", [pytest.param(one, marks=[pytest.mark.nightly] * (KILLS == 1 and one in SIMILAR)) for one in WORK]
)
def test_a_full_disk_at_any_step_loses_nothing(folder: Path, tmp_path: Path, name: str) -> None:
    before = state(folder / "home")
    run(name, whole := Path(shutil.copytree(folder / "home", tmp_path / "complete")), lambda _: None)
    complete = state(whole)
    for step in count(1, 1 if KILLS > 1 else 25):
        home = Path(shutil.copytree(folder / "home", tmp_path / str(step)))
        reported: list[int] = []
        with full_disk(step) as passed, suppress_full_disk():
            run(name, home, reported.append)
        check_interrupted(name, home, before, complete, reported)
        shutil.rmtree(home)
        if passed[0] < step:
            assert passed[0]
            return
