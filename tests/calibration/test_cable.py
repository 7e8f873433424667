"""The cable's reach, taught by hand."""

from datetime import UTC, datetime

import pytest

from calibration.cable import MARGIN_DEG, from_data, live
from calibration.events import Ask
from rig.calibrations import put_in_force


def hand(s, angle_deg: float) -> None:
    s.bench.clock.sleep(s.operator.parts.servo.turn_by_hand(angle_deg))
    s.bench.clock.sleep(abs(angle_deg) / 60)


def test_the_ends_that_a_hand_shows_become_the_limits(simulated):
    s = simulated(seed=2)
    fact = None
    turns = iter([500.0, -1100.0, 600.0])
    for event in live(s.bench):
        if isinstance(event, Ask):
            hand(s, next(turns))
        else:
            fact = event
    assert fact.passed, fact.refusals
    low, high = fact.settings["table.limits_deg"]
    assert high == pytest.approx(500 - MARGIN_DEG, abs=2)
    assert low == pytest.approx(-600 + MARGIN_DEG, abs=2)
    config, _ = put_in_force(s.bench.config, [fact])
    assert config.table.limits_deg == (low, high)


@pytest.mark.parametrize(
    ("high", "low", "pan", "reason"),
    [
        (-200.0, 200.0, False, "table.direction"),
        (150.0, -150.0, False, 'table.mode = "pan"'),
        (900.0, 60.0, False, "rig home --set"),
    ],
)
def test_ends_that_cannot_be_are_refused_with_what_to_do(high, low, pan, reason):
    fact = from_data(high, low, pan=pan, when_utc=datetime(2026, 3, 1, tzinfo=UTC), device={})
    assert reason in fact.refusals[0]
    assert not fact.settings


def test_a_pan_table_needs_no_whole_turn():
    assert from_data(150.0, -150.0, pan=True, when_utc=datetime(2026, 3, 1, tzinfo=UTC), device={}).passed
