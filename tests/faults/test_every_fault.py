"""An enrollment of 72 views, and an identification, under every fault of the vocabulary."""

from pathlib import Path

import pytest

from rig.core.errors import FaultLatched, Unreferenced
from rig.motion.turntable import Turntable
from sim.faults import kinds
from tests.faults.document import SLACK_S, documented, goes_on, identification_cell, masked, message, sentence
from tests.faults.fault_runs import (
    NAME,
    VIEWS,
    Outcome,
    Rig,
    answer,
    check_stands,
    check_stored,
    enrolled,
    enrollment,
    identification,
    new_rig,
)
from tests.faults.scenarios import BOOT_S, FOUND, SCENARIOS, After, Scenario, Step

TOLERANCE_DEG = 0.5
"""Half the play, the encoder's noise, and a slip too small to be told from the gyro's error over 5°."""
UPDATE = "docs/faults.md is not what is: look at the difference, then python tests/faults/document.py"
VIEWS_AGAIN = 12
"""Of an object that is enrolled anew."""
WHOLE = ("servo.off", "imu.off", "camera.off", "unplug", "jam", "disk_full")
"""Faults after which the rest of the turn is taken, too; after the others a part of it is."""
SHORT = 8
"""Views where the rest of the turn would prove nothing more."""


def test_there_is_a_scenario_and_a_row_of_the_page_for_every_fault() -> None:
    assert set(SCENARIOS) == set(kinds())
    assert list(documented()) == list(kinds())
    for name, cells in documented().items():
        assert cells[1:3] == (kinds()[name].what, sentence(SCENARIOS[name].found)), UPDATE
        assert cells[5] == goes_on(SCENARIOS[name]), UPDATE


@pytest.mark.parametrize("name", SCENARIOS)
def test_an_enrollment_is_completed_or_stopped_with_nothing_lost_and_no_wrong_angle(tmp_path: Path, name: str) -> None:
    scenario = SCENARIOS[name]
    with new_rig(tmp_path) as rig:
        outcome = enrollment(rig, scenario.fault)
        assert outcome.code == scenario.code, outcome.error
        assert enrolled(outcome) == (scenario.code is None)
        assert rig.torque == scenario.torque
        check_stands(rig)
        if outcome.stored:
            check_stored(rig, outcome.stored, tolerance_deg=TOLERANCE_DEG, shown=scenario.shown)
        if scenario.code is None:
            assert outcome.stored == set(range(VIEWS))
        else:
            _mended(rig, scenario)
            _goes_on(rig, scenario, outcome)
        assert not rig.torque
    cells = documented()[name]
    assert masked(cells[4]) == masked(message(outcome)), UPDATE
    if scenario.code is not None:
        assert outcome.found_s <= float(cells[3].removesuffix(" s")) + SLACK_S, UPDATE


def _mended(rig: Rig, scenario: Scenario) -> None:
    """Take the cause away, check that nothing moves, and take the step after which it may."""
    rig.faults.clear()
    rig.world.clock.sleep(BOOT_S)
    if scenario.step is None:
        return
    with rig.bench() as bench:
        with pytest.raises(Unreferenced if scenario.step is Step.HOME else FaultLatched):
            Turntable(bench).__enter__()
        if scenario.step is Step.HOME:
            bench.safety.set_revolutions(0)
        else:
            bench.safety.acknowledge(reboot=scenario.step is Step.REBOOT)


def _goes_on(rig: Rig, scenario: Scenario, outcome: Outcome) -> None:
    """Check that the enrollment is completed as the scenario says."""
    if scenario.after is After.REPLACE:
        again = enrollment(rig, replace=True, views=VIEWS_AGAIN)
        assert enrolled(again), again.error
        # What slipped stays where it is: the new views agree with each other.
        check_stored(rig, again.stored, tolerance_deg=TOLERANCE_DEG, planned=VIEWS_AGAIN, offset=True)
    else:
        missing = sorted(set(range(VIEWS)) - outcome.stored)
        whole = scenario.name in WHOLE or not missing
        taken = set(missing if whole else missing[:SHORT])
        again = enrollment(rig, resume=bool(outcome.events), at_most=None if whole else SHORT)
        assert again.error is None
        assert again.stored == taken
        assert enrolled(again) == whole
        check_stored(rig, outcome.stored | taken, tolerance_deg=TOLERANCE_DEG)


@pytest.mark.parametrize("name", SCENARIOS)
def test_an_identification_names_the_object_or_is_stopped(tmp_path: Path, name: str) -> None:
    scenario = SCENARIOS[name]
    with new_rig(tmp_path) as rig:
        outcome = identification(rig, scenario.of_identification)
        assert rig.faults.history, "the fault did not happen"
        assert documented()[name][6] == identification_cell(outcome), UPDATE
        identified = answer(outcome)
        if isinstance(scenario.answer, int):
            assert outcome.code == scenario.answer, outcome.error
        else:
            assert outcome.error is None
            assert identified is not None
            assert identified.name == (NAME if scenario.answer == FOUND else None)
        assert rig.torque == (scenario.torque and outcome.error is not None)
        check_stands(rig)


@pytest.mark.parametrize(
    "fault",
    [
        "camera.off@view3+1s",
        "camera.stuck@view3+0.1s",
        "black_frame@view3+0.7s",
        "exposure_jump@view3+0.05s",
        "babble:period=0.001@move3+2s",
        "crc_flip:rate=0.3@move3+0.5s",
        "i2c_nack:rate=0.3@move3+0.1s",
        "overheat:celsius=60@move3+1s",
        "light_flicker:depth=0.5@move3+5s",
        "slip:angle=0.2@move3",
    ],
)
def test_what_passes_in_time_ends_nothing(tmp_path: Path, fault: str) -> None:
    """Waited for, taken again, or repeated: the enrollment is complete, at the right angles."""
    with new_rig(tmp_path) as rig:
        outcome = enrollment(rig, fault, views=SHORT)
        assert outcome.error is None
        assert rig.faults.history, "the fault did not happen"
        check_stored(rig, set(range(SHORT)), tolerance_deg=TOLERANCE_DEG, planned=SHORT)
        assert not rig.torque
