"""The cable budget, shown by hand."""

import pytest

from calibration.cable import MARGIN_DEG, Cable, evaluate
from calibration.procedure import Ask
from rig.calibrations import RejectionCode, apply_results
from rig.catalog.log import asked_by
from tests.calibration.drawn import codes


def test_ends_shown_by_hand_become_the_limits(simulated):
    s = simulated(seed=2)
    rotations_deg = iter([500.0, -1100.0, 600.0])
    with asked_by("A. Silva"):
        for event in Cable().live(s.bench):
            if isinstance(event, Ask):
                by_hand_deg = next(rotations_deg)
                s.bench.clock.sleep(s.operator.devices.servo.rotate_by_hand(by_hand_deg))
                s.bench.clock.sleep(abs(by_hand_deg) / 60)
    assert event.passed, event.rejections
    assert (event.reference, event.operator) == ("encoder of the servo", "A. Silva")
    limits_deg = event.settings["table.limits_deg"]
    assert limits_deg == pytest.approx([-600 + MARGIN_DEG, 500 - MARGIN_DEG], abs=2)
    config, _ = apply_results(s.bench.config, [event])
    assert config.table.limits_deg == tuple(limits_deg)
    assert apply_results(config, [event]) == (config, ()), "the configuration says the same"


@pytest.mark.parametrize(
    ("high", "low", "pan", "found"),
    [
        (-200.0, 200.0, False, [RejectionCode.CABLE_ENDS_SWAPPED]),
        (150.0, -150.0, False, [RejectionCode.CABLE_TOO_SHORT]),
        (150.0, -150.0, True, []),
        (900.0, 60.0, False, [RejectionCode.HOME_OUTSIDE_CABLE]),
    ],
)
def test_impossible_ends_are_rejected(high, low, pan, found):
    result = evaluate(high, low, pan=pan)
    assert codes(result) == found
    assert bool(result.settings) == (not found)
