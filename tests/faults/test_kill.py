"""A process that is killed at any point of an enrollment loses no reported view, and can be resumed."""

import json
import os
from pathlib import Path

import pytest

from rig.catalog import Catalog
from rig.catalog.upkeep import collect_garbage
from rig.core.clock import SystemClock
from tests.faults.fault_runs import NAME, check_stored, enrolled, enrollment, new_rig
from tests.faults.killed_enrollments import VIEWS
from tests.programs import Program


@pytest.mark.parametrize("kills", [8, pytest.param(400, marks=[pytest.mark.nightly, pytest.mark.timeout(1800)])])
def test_killed_enrollment_keeps_reported_views_and_resumes(tmp_path: Path, kills: int) -> None:
    code = "from tests.faults.killed_enrollments import main; main()"
    process = Program(str(tmp_path), str(kills), "2", code=code)
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    runs = [json.loads(line) for line in output.splitlines()]
    assert len(runs) == kills
    assert len({len(run["reported"]) for run in runs}) > VIEWS / 2  # they died at different points
    for run in runs:
        check_run(tmp_path / str(run["number"]), run["reported"])


def check_run(folder: Path, reported: list[int]) -> None:
    assert reported == list(range(len(reported)))
    with new_rig(folder, seed=1) as rig:
        with Catalog.open(folder, clock=rig.world.clock) as catalog:
            begun = bool(catalog.objects())
            unfinished = catalog.resumable(NAME) if begun else None
            present = set(unfinished.enrollment.present) if unfinished else set(range(VIEWS)) if begun else set()
        assert set(reported) <= present
        assert len(present) <= len(reported) + 1  # the last one may have been stored, but not yet reported
        check_stored(rig, present, tolerance_deg=0.5, planned=VIEWS)
        if unfinished or not begun:
            resumed = enrollment(rig, resume=begun, views=VIEWS)
            assert enrolled(resumed), resumed.error
            assert resumed.stored == set(range(VIEWS)) - present
            check_stored(rig, set(range(VIEWS)), tolerance_deg=0.5, planned=VIEWS)
    left = list(folder.rglob("*.part"))
    assert len(left) <= 1  # what the killed process was writing
    for part in left:
        os.utime(part, (0, 0))  # the garbage collection spares files of the last day
    with Catalog.open(folder, clock=SystemClock()) as catalog:
        collect_garbage(catalog)
        for view in catalog.object(NAME).views:
            catalog.read_image(view.image)
    assert not list(folder.rglob("*.part"))
