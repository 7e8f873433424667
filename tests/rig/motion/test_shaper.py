"""Shaped motions: they have the given length, end without ringing, and reach the goal even if a part is late."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.config import TableConfig
from rig.devices.servo import MotionProfile
from rig.motion.move import motion_seconds
from rig.motion.shaper import QUIET_SHARE, shaped
from rig.motion.turntable import Turntable
from sim.motion import Platter, to_position
from sim.noise import NoiseModel
from tests.fuzzing import examples
from tests.rig.bench_parts import at_rest, motion_bench

USUAL, UNITS = MotionProfile(89.3, 236.0), MotionProfile(1.374, 21.4577)


def rate_at_end(distance_deg: float, hz: float, damping: float) -> tuple[float, float]:
    """Return the largest rate of the platter at the end of the shaped motion, and how much later than usual that is."""
    plan = shaped(distance_deg, USUAL, UNITS, TableConfig(ringing_hz=hz, ringing_damping=damping))
    assert plan is not None
    first = to_position(0.0, 0.0, 0.0, distance_deg, plan.cruise.velocity_dps, plan.cruise.acceleration_dps2)
    at_deg, at_dps, _ = first.state_at(plan.slow_s)
    last = to_position(plan.slow_s, at_deg, at_dps, distance_deg, plan.slow.velocity_dps, plan.slow.acceleration_dps2)
    assert last.end_s == pytest.approx(plan.seconds, abs=1e-3)
    before, after = Platter(0.0, hz, damping), Platter(0.0, hz, damping)
    before.follow(first, None)
    after.follow(last, before)
    times = plan.seconds + plan.rings_s + np.arange(0.001, 0.3, 0.001)
    rates = np.diff(after.at(times)) / 0.001
    return float(np.abs(rates).max()), plan.seconds + plan.rings_s - motion_seconds(distance_deg, USUAL)


@given(st.floats(2.0, 300.0), st.floats(6.0, 20.0), st.floats(0.02, 0.2))
@examples(60)
def test_shaped_motion_is_at_rest_before_a_usual_one_rings_down(distance_deg, hz, damping):
    rate_dps, later_s = rate_at_end(distance_deg, hz, damping)
    assert rate_dps < TableConfig().quiet_dps / 2
    omega = 2 * np.pi * hz
    quiet_dps = QUIET_SHARE * TableConfig().quiet_dps
    rings_s = np.log(2 * USUAL.acceleration_dps2 / omega / quiet_dps) / (damping * omega)
    assert later_s < rings_s / 2 + 0.12


def test_too_short_motion_has_no_profile_of_its_own():
    assert shaped(0.0, USUAL, UNITS, TableConfig(ringing_hz=9.0)) is None


def test_table_reaches_its_goal_if_the_computer_is_late():
    noise = NoiseModel(structure_hz=9.0, structure_damping=0.1)
    settings = "table.ringing_hz=9", "table.ringing_damping=0.1"
    with motion_bench(*settings, noise=noise) as (bench, wires), Turntable(bench) as table:
        pause = wires.world.clock.sleep
        wires.world.clock.sleep = lambda seconds: pause(1.5 * seconds + 0.01)
        for target in (60.0, 20.0, 23.0, 22.9):
            assert table.goto(target).encoder_deg == at_rest(wires.device, target, 0.2)
