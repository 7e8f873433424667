"""The cable budget, shown by hand."""

import pytest

from calibration.cable import MARGIN_DEG, Cable, evaluate
from calibration.procedure import Ask
from rig.calibrations import RejectionCode, apply_results
from rig.catalog.log import asked_by
from tests.calibration.rejected import codes


def hand(s, angle_deg: float) -> None:
    s.bench.clock.sleep(s.operator.devices.servo.rotate_by_hand(angle_deg))
    s.bench.clock.sleep(abs(angle_deg) / 60)


def test_ends_shown_by_hand_become_the_limits(simulated):
    s = simulated(seed=2)
    result = None
    revolutions = iter([500.0, -1100.0, 600.0])
    for event in Cable().live(s.bench):
        if isinstance(event, Ask):
            hand(s, next(revolutions))
        else:
            result = event
    assert result.passed, result.rejections
    low, high = result.settings["table.limits_deg"]
    assert high == pytest.approx(500 - MARGIN_DEG, abs=2)
    assert low == pytest.approx(-600 + MARGIN_DEG, abs=2)
    config, _ = apply_results(s.bench.config, [result])
    assert config.table.limits_deg == (low, high)


@pytest.mark.parametrize(
    ("high", "low", "pan", "code"),
    [
        (-200.0, 200.0, False, RejectionCode.CABLE_ENDS_SWAPPED),
        (150.0, -150.0, False, RejectionCode.CABLE_TOO_SHORT),
        (900.0, 60.0, False, RejectionCode.HOME_OUTSIDE_CABLE),
    ],
)
def test_impossible_ends_are_rejected(high, low, pan, code):
    result = evaluate(high, low, pan=pan)
    assert codes(result) == [code]
    assert not result.settings


def test_result_names_reference_and_person_at_the_page(simulated):
    with asked_by("A. Silva"):
        *_, result = Cable().live(simulated().bench)
    assert (result.reference, result.operator) == ("encoder of the servo", "A. Silva")


def test_pan_table_needs_no_whole_revolution():
    assert evaluate(150.0, -150.0, pan=True).passed
