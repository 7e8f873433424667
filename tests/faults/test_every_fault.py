"""An enrollment and an identification under every simulated fault."""

from pathlib import Path

import pytest

from rig.core.errors import FaultLatched, Unreferenced
from rig.motion.turntable import Turntable
from sim.faults import fault_kinds
from tests.faults.document import (
    SLACK_S,
    documented,
    identification_cell,
    masked,
    message,
    planned_views,
    recovery,
    sentence,
)
from tests.faults.fault_runs import (
    NAME,
    SHORT,
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
"""Half the backlash, the encoder's noise, and a slip smaller than the gyro's error over 5°."""
UPDATE = "docs/reference/faults.md is out of date: check the difference, then run python tests/faults/document.py"
RESUMED_VIEWS = 1
LATE_MOVE = 20
KINDS_OF_RECOVERY = {(one.step, one.after, one.late, one.torque): name for name, one in reversed(SCENARIOS.items())}
"""The first fault of each way to continue; the default tests continue after these."""
SEVERAL_AT_ONCE = (
    ("servo.slow", "crc_flip", "late_reply", "friction", "camera.slow", "stamp_jump", "light_flicker"),
    ("servo.intermittent", "duplicate_reply", "i2c_nack", "lost_frames", "stamps_backwards", "mains_flicker"),
    ("babble", "camera.delayed", "camera.intermittent", "stamp_jitter", "clock_jump"),
    ("echo", "doubled_frame", "imu.bursts"),
)
"""Faults that stop no enrollment, in groups that can happen together."""


def is_shown_by_others(name: str) -> bool:
    """Return whether other default tests show the outcome of an enrollment under a fault.

    Faults that stop nothing happen several at once. Others stop an identification with the same error, and an
    enrollment under another fault stops and continues in the same way.
    """
    scenario = SCENARIOS[name]
    return scenario.code is None or (scenario.answer == scenario.code and name not in KINDS_OF_RECOVERY.values())


SURVIVED = ("servo.intermittent", "camera.intermittent", "crc_flip", "i2c_nack")
"""Faults that stop nothing, under which the default tests identify an object, too."""


def test_every_fault_has_a_scenario_and_a_documented_row() -> None:
    assert set(SCENARIOS) == set(fault_kinds())
    assert list(documented()) == list(fault_kinds())
    for name, cells in documented().items():
        assert cells[1:3] == (fault_kinds()[name].what, sentence(SCENARIOS[name].found)), UPDATE
        assert cells[5] == recovery(SCENARIOS[name]), UPDATE


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.nightly] * is_shown_by_others(name)) for name in SCENARIOS],
)
def test_enrollment_completes_or_stops_without_lost_views_or_wrong_angles(tmp_path: Path, name: str) -> None:
    scenario = SCENARIOS[name]
    recovers = name in KINDS_OF_RECOVERY.values()
    outcome = check_enrollment(tmp_path, scenario, scenario.fault, views=planned_views(scenario), recovers=recovers)
    cells = documented()[name]
    assert masked(cells[4]) == masked(message(outcome)), UPDATE
    if scenario.code is not None:
        assert outcome.found_s <= float(cells[3].removesuffix(" s")) + SLACK_S, UPDATE


@pytest.mark.parametrize("names", SEVERAL_AT_ONCE)
def test_enrollment_completes_under_several_faults_at_once(tmp_path: Path, names: tuple[str, ...]) -> None:
    """The nightly profile enrolls under each of these faults alone."""
    with new_rig(tmp_path) as rig:
        outcome = enrollment(rig, *(SCENARIOS[name].fault for name in names), views=SHORT)
        assert outcome.error is None
        assert enrolled(outcome)
        assert {one.fault.kind.name for one in rig.faults.history} == set(names)
        assert outcome.stored == set(range(SHORT))
        check_stands(rig)
        check_stored(rig, outcome.stored, tolerance_deg=TOLERANCE_DEG, planned=SHORT)
        assert not rig.torque


def test_every_fault_that_stops_no_enrollment_is_among_several_at_once() -> None:
    survived = {name for name, one in SCENARIOS.items() if one.code is None}
    assert survived == {name for names in SEVERAL_AT_ONCE for name in names}
    for name in survived:
        assert documented()[name][4] == message(Outcome()), UPDATE


@pytest.mark.nightly
@pytest.mark.parametrize(
    "name", [name for name, one in SCENARIOS.items() if one.code is not None and name not in KINDS_OF_RECOVERY.values()]
)
def test_enrollment_continues_after_every_fault(tmp_path: Path, name: str) -> None:
    check_enrollment(tmp_path, SCENARIOS[name], SCENARIOS[name].fault, views=planned_views(SCENARIOS[name]))


@pytest.mark.nightly
@pytest.mark.parametrize("name", SCENARIOS)
def test_enrollment_of_a_full_revolution_resumes_to_the_end_after_a_late_fault(tmp_path: Path, name: str) -> None:
    scenario = SCENARIOS[name]
    check_enrollment(tmp_path, scenario, scenario.at_move(LATE_MOVE), views=VIEWS, resumed_views=None)


def check_enrollment(
    folder: Path,
    scenario: Scenario,
    fault: str,
    *,
    views: int,
    recovers: bool = True,
    resumed_views: int | None = RESUMED_VIEWS,
) -> Outcome:
    """Enroll under the fault and check the end; with ``recovers`` remove the cause and check how it continues."""
    with new_rig(folder) as rig:
        outcome = enrollment(rig, fault, views=views)
        assert outcome.code == scenario.code, outcome.error
        assert rig.faults.history, "the fault did not happen"
        assert enrolled(outcome) == (scenario.code is None)
        assert rig.torque == scenario.torque
        check_stands(rig)
        if outcome.stored:
            check_stored(rig, outcome.stored, tolerance_deg=TOLERANCE_DEG, planned=views, shown=scenario.shown)
        if scenario.code is None:
            assert outcome.stored == set(range(views))
        elif recovers:
            remove_cause(rig, scenario)
            check_recovery(rig, scenario, outcome, views, resumed_views)
        assert not rig.torque
    return outcome


def remove_cause(rig: Rig, scenario: Scenario) -> None:
    """Remove the cause, check that nothing moves yet, and take the step that lets the table move again."""
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


def check_recovery(rig: Rig, scenario: Scenario, outcome: Outcome, planned: int, at_most: int | None) -> None:
    """Check that the enrollment is replaced or resumed, as the scenario says; resume at most this number of views."""
    if scenario.after is After.REPLACE:
        again = enrollment(rig, replace=True, views=SHORT)
        assert enrolled(again), again.error
        # A slipped part stays at its place, so the new views agree with each other.
        check_stored(rig, again.stored, tolerance_deg=TOLERANCE_DEG, planned=SHORT, offset=True)
        return
    missing = sorted(set(range(planned)) - outcome.stored)
    resumed = set(missing[:at_most])
    again = enrollment(rig, resume=bool(outcome.events), views=planned, at_most=at_most)
    assert again.error is None
    assert again.stored == resumed
    assert enrolled(again) == (resumed == set(missing))
    check_stored(rig, outcome.stored | resumed, tolerance_deg=TOLERANCE_DEG, planned=planned)


# Most faults that do not stop an enrollment do not stop an identification either.
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.nightly] * (scenario.code is None and name not in SURVIVED))
        for name, scenario in SCENARIOS.items()
    ],
)
def test_identification_names_the_object_or_stops(tmp_path: Path, name: str) -> None:
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


SHORT_FAULTS = (
    "camera.off@view3+1s",
    "black_frame@view3+0.7s",
    "crc_flip:rate=0.3@move3+0.5s",
    "overheat:celsius=60@move3+1s",
    "camera.stuck@view3+0.1s",
    "exposure_jump@view3+0.05s",
    "babble:period=0.001@move3+2s",
    "i2c_nack:rate=0.3@move3+0.1s",
    "light_flicker:depth=0.5@move3+5s",
    "slip:angle=0.2@move3",
)
ONE_AFTER_THE_OTHER = (
    "crc_flip:rate=0.3@move1+0.5s",
    "camera.off@view1+1s",
    "overheat:celsius=60@move3+1s",
    "black_frame@view3+0.7s",
)


@pytest.mark.parametrize(
    "faults", [ONE_AFTER_THE_OTHER, *(pytest.param((one,), marks=pytest.mark.nightly) for one in SHORT_FAULTS)]
)
def test_short_faults_do_not_end_an_enrollment(tmp_path: Path, faults: tuple[str, ...]) -> None:
    """The plan waits, repeats the view or repeats the transaction."""
    with new_rig(tmp_path) as rig:
        outcome = enrollment(rig, *faults, views=SHORT)
        assert outcome.error is None
        assert len({one.fault.kind.name for one in rig.faults.history}) == len(faults), "a fault did not happen"
        check_stored(rig, set(range(SHORT)), tolerance_deg=TOLERANCE_DEG, planned=SHORT)
        assert not rig.torque
