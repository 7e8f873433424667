"""Shaped motions: they have the given length, end without ringing, and reach the goal even if a part is late."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.config import TableConfig
from rig.devices.servo import MotionProfile
from rig.motion.move import motion_seconds
from rig.motion.shaper import QUIET_SHARE, SLACK_DEG, ShapedMove, shaped
from rig.motion.turntable import Turntable
from sim.motion import PiecewiseMotion, Platter, to_position
from sim.noise import NoiseModel
from tests.fuzzing import examples
from tests.rig.bench_parts import at_rest, motion_bench

UNITS = MotionProfile(1.374, 21.4577)
USUAL = MotionProfile(65 * UNITS.velocity_dps, 11 * UNITS.acceleration_dps2)  # a servo has whole multiples only


def paths(plan: ShapedMove, distance_deg: float) -> list[PiecewiseMotion]:
    """Return the profile of each part of a motion; it is valid until that of the next one begins."""
    found: list[PiecewiseMotion] = []
    for begins_s, profile in plan.parts:
        at_deg, at_dps, _ = found[-1].state_at(begins_s) if found else (0.0, 0.0, 0.0)
        speeds = profile.velocity_dps, profile.acceleration_dps2
        found.append(to_position(begins_s, at_deg, at_dps, distance_deg, *speeds))
    return found


def rate_at_end(distance_deg: float, hz: float, damping: float) -> tuple[float, float]:
    """Return the largest rate of the platter at the end of the shaped motion, and how much later than usual that is."""
    plan = shaped(distance_deg, USUAL, UNITS, TableConfig(ringing_hz=hz, ringing_damping=damping))
    assert plan is not None
    platter = None
    for path in paths(plan, distance_deg):
        before, platter = platter, Platter(0.0, hz, damping)
        platter.follow(path, before)
    assert platter is not None
    assert path.end_s == pytest.approx(plan.seconds, abs=1e-3)
    times = plan.seconds + plan.rings_s + np.arange(0.001, 0.3, 0.001)
    rates = np.diff(platter.at(times)) / 0.001
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


@given(st.floats(0.06, 1.0), st.floats(3.0, 300.0), st.sampled_from((6.0, 20.0)))
@examples(20)
def test_profile_creeps_while_the_shaft_breaks_away_from_friction(held_deg, distance_deg, hz):
    config = TableConfig(ringing_hz=hz, ringing_damping=0.02, held_deg=held_deg)
    plan = shaped(-distance_deg, USUAL, UNITS, config, behind_deg=held_deg)
    assert plan is not None
    times = np.arange(0.0, plan.seconds, 0.0005)
    path = paths(plan, distance_deg)
    part = np.searchsorted([begins_s for begins_s, _ in plan.parts], times, side="right") - 1
    moved_deg, speed_dps = np.array([path[i].state_at(time_s)[:2] for i, time_s in zip(part, times, strict=True)]).T
    breaks_away = abs(moved_deg - 2 * held_deg) < SLACK_DEG - 0.01
    assert speed_dps[breaks_away] == pytest.approx(UNITS.velocity_dps, abs=1e-6)
    # Up to the creep, the profile loses no time: the shaft does not move yet.
    creep_s = 2 * SLACK_DEG / UNITS.velocity_dps
    assert times[breaks_away][0] < motion_seconds(2 * held_deg, USUAL) + 0.15
    assert times[breaks_away][-1] - times[breaks_away][0] < creep_s


def test_shaft_that_its_profile_pulls_already_needs_no_creep():
    config = TableConfig(ringing_hz=9.0, held_deg=0.4)
    after_upwards, after_downwards = (shaped(30.0, USUAL, UNITS, config, behind_deg=deg) for deg in (0.4, -0.4))
    assert after_upwards is not None
    assert after_downwards is not None
    assert len(after_downwards.parts) == len(after_upwards.parts) + 2


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
