"""Properties of trajectories and of the platter's motion, for any motion."""

from math import sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.motion import PiecewiseMotion, Platter, Response, rest, to_position, to_velocity
from tests.fuzzing import examples

quick = examples(10)
angles = st.floats(-2_000, 2_000)
speeds = st.floats(-300, 300).map(lambda dps: round(dps, 6))  # a smaller one moves nothing in a lifetime
limits = st.floats(1, 400)
ramps = st.floats(5, 4_000)
starts = st.floats(0, 1_000)


@st.composite
def trajectories(draw: st.DrawFn) -> PiecewiseMotion:
    """Draw the last of a few moves, each begun where the one before was interrupted."""
    t, x, v = 0.0, draw(angles), 0.0
    path = rest(t, x)
    for _ in range(draw(st.integers(1, 4))):
        if draw(st.booleans()):
            path = to_position(t, x, v, draw(angles), draw(limits), draw(ramps))
        else:
            path = to_velocity(t, x, v, draw(speeds), draw(ramps))
        t += draw(st.floats(0.01, 5.0))
        x, v = (float(value) for value in path.at(t))
    return path


def inner_knots(path: PiecewiseMotion, step_s: float) -> np.ndarray:
    """Return the times between pieces that are later than the beginning by a step; before it, nothing moves."""
    return path.start_s[1:][path.start_s[1:] - step_s >= path.start_s[0]]


def samples(path: PiecewiseMotion, n: int = 400, beyond_s: float = 1.0) -> np.ndarray:
    return np.unique(np.concatenate([np.linspace(path.start_s[0], path.end_s + beyond_s, n), path.start_s]))


# -- trajectories ---------------------------------------------------------------------------------------------------


@quick
@given(starts, angles, speeds, angles, limits, ramps)
def test_move_starts_at_the_shaft_arrives_exactly_and_stays(
    t: float, x: float, v: float, goal: float, v_max: float, a_max: float
) -> None:
    path = to_position(t, x, v, goal, v_max, a_max)
    assert path.at(t) == pytest.approx((x, v), abs=1e-9)
    for later in (0.0, 1e-9, 1.0, 1e4):
        position, velocity = path.at(path.end_s + later)
        assert position == goal
        assert velocity == 0.0


@quick
@given(starts, angles, speeds, angles, limits, ramps)
def test_move_keeps_to_its_limits(t: float, x: float, v: float, goal: float, v_max: float, a_max: float) -> None:
    path = to_position(t, x, v, goal, v_max, a_max)
    times = samples(path)
    _, velocity = path.at(times)
    assert np.abs(velocity).max() <= max(v_max, abs(v)) * (1 + 1e-9) + 1e-9
    assert np.abs(path.acceleration_dps2).max() <= a_max * (1 + 1e-12)
    braking_s = max(abs(v) - v_max, 0) / a_max
    _, velocity = path.at(times[times >= t + braking_s + 1e-6])
    assert np.abs(velocity).max() <= v_max * (1 + 1e-6) + 1e-6


@quick
@given(trajectories())
def test_position_and_velocity_are_continuous_and_pieces_monotone(path: PiecewiseMotion) -> None:
    step = 1e-7
    knots = inner_knots(path, step)
    before, after = path.at(knots - step), path.at(knots)
    scale = 1e-6 + step * 4_000
    assert np.abs(after[0] - before[0] - before[1] * step).max(initial=0) <= 1e-6
    assert np.abs(after[1] - before[1]).max(initial=0) <= scale
    # The platter relies on it: within a piece the shaft does not turn back.
    v, a = path.velocity_dps[:-1], path.acceleration_dps2[:-1]
    assert np.all(v * (v + a * np.diff(path.start_s)) >= -1e-6)


@quick
@given(trajectories(), st.floats(-1.0, 30.0))
def test_state_at_one_time_is_that_of_an_array_of_times(path: PiecewiseMotion, after_s: float) -> None:
    time_s = float(path.start_s[0]) + after_s
    position, velocity = path.at([time_s])
    (piece,), _ = path.pieces(np.array([time_s]))
    assert path.state_at(time_s) == (position[0], velocity[0], path.acceleration_dps2[piece])


@quick
@given(starts, angles, speeds, speeds, ramps, st.floats(0, 10))
def test_speed_is_reached_and_held(t: float, x: float, v: float, goal: float, a_max: float, after: float) -> None:
    path = to_velocity(t, x, v, goal, a_max)
    assert path.end_s - t == pytest.approx(abs(goal - v) / a_max, abs=1e-9)
    position, velocity = path.at(path.end_s + after)
    assert velocity == goal
    assert position - path.at(path.end_s)[0] == pytest.approx(goal * after, abs=1e-9)


# -- the platter ----------------------------------------------------------------------------------------------------


def platter(play_deg: float, structure_hz: float = 0.0, damping: float = 0.15) -> Platter:
    result = Platter(play_deg, structure_hz, damping)
    result.follow(rest(0.0, 0.0), None)
    return result


def play_operator(shaft: np.ndarray, start: float, half_play: float) -> np.ndarray:
    """Return the backlash operator by its definition, sample by sample."""
    angle, held = np.empty_like(shaft), start
    for i, x in enumerate(shaft):
        held = min(max(held, x - half_play), x + half_play)
        angle[i] = held
    return angle


@quick
@given(trajectories(), st.floats(0, 3))
def test_backlash_follows_its_operator_and_stays_within_its_half(path: PiecewiseMotion, play_deg: float) -> None:
    follower = Platter(play_deg, 0.0, 0.0)
    follower.follow(path, None)
    times = samples(path, 2_000)
    shaft, _ = path.at(times)
    angle = follower.at(times)
    assert np.abs(angle - shaft).max() <= play_deg / 2 + 1e-9
    assert angle == pytest.approx(play_operator(shaft, shaft[0], play_deg / 2), abs=1e-6)


@quick
@given(trajectories(), trajectories(), st.sampled_from([8.0, 30.0]))
def test_vibration_continues_from_piece_to_piece_and_from_motion_to_motion(
    path: PiecewiseMotion, other: PiecewiseMotion, structure_hz: float
) -> None:
    """Without backlash the platter's deflection from the shaft changes its speed nowhere at once."""
    h = 1e-5
    first = platter(0.0, structure_hz)
    first.follow(path, None)
    when = float(path.start_s[-1]) + 0.05  # while it rings
    x, v = (float(value) for value in path.at(when))
    second = platter(0.0, structure_hz)
    second.follow(to_position(when, x, v, float(other.position_deg[0]), 60.0, 300.0), first)

    def deflection(followed: Platter, times: np.ndarray) -> np.ndarray:
        return followed.at(times) - followed.shaft.at(times)[0]

    # With the deflection's acceleration d'', its mean speeds over h before and after a knot differ by h * max|d''| at
    # most. A change of the shaft's acceleration by c changes d'' by 1.02 c at most, and this decays. The first path has
    # at most six changes of 4,000 °/s², the second one of 300 °/s²: the difference is below 0.3 °/s.
    for followed in (first, second):
        knots = inner_knots(followed.shaft, h)
        before = (deflection(followed, knots) - deflection(followed, knots - h)) / h
        after = (deflection(followed, knots + h) - deflection(followed, knots)) / h
        assert after == pytest.approx(before, abs=0.5)
    at = np.array([when])
    before = (deflection(first, at) - deflection(first, at - h)) / h
    after = (deflection(second, at + h) - deflection(second, at)) / h
    assert after == pytest.approx(before, abs=0.5)


def test_stop_rings_at_the_structures_frequency_and_decays() -> None:
    hz, damping, a_max = 11.0, 0.15, 400.0
    follower = platter(0.0, hz, damping)
    path = to_position(0.0, 0.0, 0.0, 90.0, 60.0, a_max)
    ringing = Platter(0.0, hz, damping)
    ringing.follow(path, follower)
    times = path.end_s + np.linspace(0, 1.0, 20_001)
    angle = ringing.at(times)
    deflection = angle - 90.0
    # Before it stops, the shaft brakes long enough for the deflection to settle at a / ω².
    omega = 2 * np.pi * hz
    assert np.abs(deflection).max() == pytest.approx(a_max / omega**2, rel=0.2)
    crossings = times[1:][np.diff(np.sign(deflection)) != 0]
    period = 2 * np.diff(crossings[:6]).mean()
    assert period == pytest.approx(1 / (hz * sqrt(1 - damping**2)), rel=0.01)
    envelope = np.exp(-damping * omega * 0.5)
    assert np.abs(deflection[10_000:]).max() <= 1.3 * a_max / omega**2 * envelope


# -- response of a servo -----------------------------------------------------------------------------------------


@quick
@given(trajectories(), st.floats(0.02, 0.1), st.floats(0, 3), st.floats(-1, 1), st.floats(-1, 1))
def test_shaft_rests_within_the_error_that_friction_holds(
    path: PiecewiseMotion, lag_s: float, half: float, load: float, start: float
) -> None:
    begun = float(path.position_deg[0]) + load * half + start * half
    shaft = Response(lag_s, 0.0, half, load * half, 1e4).follow(path, begun, 0.0)
    cruise_dps = float(path.velocity_dps[-1])
    later_s = path.end_s + 20 * lag_s + (3 * half / abs(cruise_dps) if cruise_dps else 0.0)
    (x, v), (y, w) = path.at(later_s), shaft.at(later_s)
    assert shaft.at(path.start_s[0])[0] == pytest.approx(begun, abs=1e-9)
    assert w == pytest.approx(v, abs=0.05)
    behind = x + load * half - y
    if cruise_dps:
        assert behind == pytest.approx(cruise_dps * lag_s + np.copysign(half, cruise_dps), abs=0.01)
    else:
        assert abs(behind) <= half + 0.01


def test_shaft_has_the_lag_of_the_gains_and_stops_short_of_its_goal() -> None:
    """An XL430 with factory gains: 5 PWM for each count of error, and 885 at 366 °/s."""
    response = Response(0.0425, 0.0, 0.4, 0.0, 366.0)
    shaft = response.follow(to_position(0.0, 0.0, 0.0, 180.0, 90.0, 240.0), 0.0, 0.0)
    assert 90.0 - shaft.at(1 + 90 / 240 / 2)[0] == pytest.approx(90 * 0.0425 + 0.4, abs=0.01)
    assert 180.0 - shaft.at(10.0)[0] == pytest.approx(0.4, abs=0.01)
    assert shaft.at(np.linspace(0, 10, 1000))[0].max() < 180.0


def test_heavy_shaft_overshoots() -> None:
    path = to_position(0.0, 0.0, 0.0, 90.0, 350.0, 3000.0)
    light, heavy = (Response(0.03, inertia_s, 0.1, 0.0, 350.0).follow(path, 0.0, 0.0) for inertia_s in (0.0, 0.03))
    times = np.linspace(0, 3, 1000)
    assert light.at(times)[0].max() < 90.0 < heavy.at(times)[0].max() - 2
    assert heavy.at(3.0)[0] == pytest.approx(90.0, abs=0.11)
