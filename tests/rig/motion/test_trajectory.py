"""The platter's angle in motion, compared with the simulated world's truth."""

from functools import partial
from itertools import chain, count

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rig.motion.trajectory import TrajectoryRecorder, backlash_states
from rig.motion.turntable import Flight, Turntable
from tests.fuzzing import examples
from tests.rig.bench_parts import at_rest, motion_bench
from tests.sim.truth import table_rates

CENTER_DEG = 180.0
"""The encoder's reading at the shaft's angle 0."""


def flown(goals: list[float], velocity_dps: float, seed: int, lost: int):  # type: ignore[no-untyped-def]
    """Return errors, stated uncertainties and errors of the rate at times of a flight, and its trajectory.

    Of five successive readings of the encoder, ``lost`` are lost. If each was lost by chance, a flight could lose all
    readings of its beginning, and no fit could know its angle there better than the backlash.
    """
    rng = np.random.default_rng(seed)
    with motion_bench(seed=seed) as (bench, wires), Turntable(bench) as table:
        table.goto(5.0)
        # The platter, where the encoder shows its angle: by the shaft, because a reading is rounded by up to 0.044°.
        shaft_deg = wires.world.shaft()[0] + CENTER_DEG
        offset_deg = wires.world.table_deg() - bench.safety.angle_reference.to_table(shaft_deg)
        recorder = table.recorder()
        add, losses = recorder.add_reading, chain.from_iterable(rng.permutation(5) < lost for _ in count())
        recorder.add_reading = lambda time_ns, angle: None if next(losses) else add(time_ns, angle)  # type: ignore[method-assign]
        for goal in goals:
            table.fly(goal, Flight(lambda: wires.world.clock.sleep(0.033), (-100.0, 390.0), recorder, velocity_dps))
        trajectory = recorder.fit()
        assert trajectory is not None
        first_ns = max(trajectory.start_ns, trajectory.end_ns - 11_000_000_000)
        times = np.sort(rng.integers(first_ns, trajectory.end_ns, 300))
        motion = trajectory.at(times)
        angle, rate = wires.world.table_angles(times), table_rates(wires.world, times)
        return motion.angle_deg - (angle - offset_deg), motion.sigma_deg, motion.rate_dps - rate, trajectory


@examples(5)
@given(
    st.integers(0, 1000),
    st.sampled_from([[120.0], [200.0, 60.0], [90.0, 30.0, 200.0]]),
    st.floats(20.0, 150.0),
    st.sampled_from([0, 2]),
)
@example(seed=59, goals=[120.0], velocity_dps=20.0, lost=0)
def test_angle_and_its_uncertainty_are_true_at_any_time(
    seed: int, goals: list[float], velocity_dps: float, lost: int
) -> None:
    error, sigma, _, trajectory = flown(goals, velocity_dps, seed, lost)
    assert np.abs(error).max() < 0.2
    assert np.sqrt(np.mean(np.square(error / sigma))) < 2.0
    assert sigma.max() < 0.2
    assert trajectory.consistent


def test_angle_of_a_fast_platter_is_neither_late_nor_early() -> None:
    """Views at rest and at full speed, in both directions: the error of a late angle would change its sign with the
    speed."""
    late_ms = []
    for seed in range(3):
        for start_deg, end_deg in ((0.0, 150.0), (150.0, 0.0)):
            with motion_bench(seed=seed) as (bench, wires), Turntable(bench) as table:
                table.goto(start_deg)
                recorder, pause = table.recorder(), partial(wires.world.clock.sleep, 0.033)
                table.fly(end_deg, Flight(pause, (0.0, 150.0), recorder, 90.0))
                trajectory = recorder.fit()
                assert trajectory is not None
                times = np.linspace(trajectory.start_ns + 5e6, trajectory.end_ns - 1e7, 400).astype(np.int64)
                angle, rate = wires.world.table_angles(times), table_rates(wires.world, times)
            error = trajectory.at(times).angle_deg - angle
            fast, resting = np.abs(rate) > 85, np.abs(rate) < 0.5
            late_ms.append((error[resting].mean() - error[fast].mean()) / rate[fast].mean() * 1e3)
    assert abs(np.mean(late_ms)) < 0.25


def test_missing_gyro_samples_widen_the_uncertainty_where_they_are_missing() -> None:
    recorder = TrajectoryRecorder(0.088, 0.5, 0.01, 0.0035, 0.0, 0.005)
    times = np.arange(0, 2_000_000_000, 5_000_000)
    kept = (times < 900_000_000) | (times > 1_100_000_000)
    for part in (times[kept & (times < 10**9)], times[kept & (times > 10**9)]):
        recorder.add_samples(part, np.full(len(part), 60.0))
    for t in range(0, 2_000_000_000, 33_000_000):
        recorder.add_reading(t, 60e-9 * t)
    trajectory = recorder.fit()
    assert trajectory is not None
    inside, outside = trajectory.at([1_000_000_000, 500_000_000]).sigma_deg
    assert inside > 10 * outside
    later = trajectory.at([2_300_000_000]).sigma_deg[0]
    assert later > 5.0  # nothing was measured then
    assert (trajectory.start_ns, trajectory.end_ns) == (times[0], times[-1])


def test_short_gap_of_the_gyro_adds_little_uncertainty_even_without_later_readings() -> None:
    recorder = TrajectoryRecorder(0.088, 0.5, 0.01, 0.0035, 0.0, 0.005)
    for begin_ns, end_ns in ((0, 1_000_000_000), (1_015_000_000, 1_100_000_000)):
        times = np.arange(begin_ns, end_ns, 5_000_000)
        recorder.add_samples(times, np.full(len(times), 60.0))
    for t in range(0, 1_000_000_000, 33_000_000):
        recorder.add_reading(t, 60e-9 * t)
    trajectory = recorder.fit()
    assert trajectory is not None
    assert trajectory.at([1_080_000_000]).sigma_deg[0] < 0.2


def test_slip_of_the_platter_shows_in_the_residuals() -> None:
    with motion_bench(seed=3) as (bench, wires), Turntable(bench) as table:
        recorder = table.recorder()
        rounds = 0

        def each() -> None:
            nonlocal rounds
            rounds += 1
            if rounds == 40:
                wires.world.slip(1.5)
            wires.world.clock.sleep(0.033)

        table.fly(250.0, Flight(each, (-100.0, 390.0), recorder, 90.0))
        trajectory = recorder.fit()
    assert trajectory is not None
    assert not trajectory.consistent


def test_goal_may_change_without_a_stop_and_speed_returns_to_the_usual() -> None:
    with motion_bench(seed=1) as (bench, wires), Turntable(bench) as table:
        recorder, speeds = table.recorder(), []

        def each() -> float | None:
            wires.world.clock.sleep(0.033)
            state = bench.servo.read_state()
            speeds.append(state.velocity_dps)
            return table.stopping_deg(state) if wires.world.table_deg() > 60.0 else 300.0

        move = table.fly(100.0, Flight(each, (0.0, 350.0), recorder, 45.0, quiet=False))
        assert 60.0 < move.commanded_deg < 75.0
        assert max(speeds) < 50.0
        assert min(speeds[10:25]) > 40.0  # from the goal 100° to the goal 300° it did not stop
        assert table.goto(90.0).seconds < 1.5


def test_angle_of_a_stop_includes_the_rotation_since_the_reading() -> None:
    with motion_bench(seed=1) as (bench, wires), Turntable(bench) as table:
        stops_deg: list[float] = []

        def each() -> None:
            wires.world.clock.sleep(0.033)
            state = bench.servo.read_state()
            if not stops_deg and wires.world.table_deg() > 60.0:
                wires.world.clock.sleep(0.2)
                stops_deg.extend(map(table.stopping_deg, (state, bench.servo.read_state())))

        table.fly(200.0, Flight(each, (0.0, 200.0), table.recorder(), 45.0))
    assert stops_deg[0] == pytest.approx(stops_deg[1], abs=1.0)
    assert stops_deg[0] > 69.0


def test_small_change_of_the_goal_of_a_flight_is_followed() -> None:
    with motion_bench(seed=1) as (bench, wires), Turntable(bench) as table:
        goal_deg = 60.0 + bench.config.table.tolerance_deg

        def each() -> float:
            wires.world.clock.sleep(0.033)
            return goal_deg

        assert table.fly(60.0, Flight(each, (0.0, 70.0), table.recorder(), 45.0)).commanded_deg == goal_deg


def test_goal_beyond_the_reach_of_a_flight_is_moved_into_it_and_the_usual_speed_returns() -> None:
    with motion_bench(seed=1) as (bench, wires), Turntable(bench) as table:
        usual, speeds = wires.device.memory["Profile Velocity"], set()

        def each() -> float:
            wires.world.clock.sleep(0.033)
            speeds.add(wires.device.memory["Profile Velocity"])
            return 300.0

        move = table.fly(60.0, Flight(each, (0.0, 70.0), table.recorder(), 45.0))
        assert move.commanded_deg == 70.0
        assert move.encoder_deg == at_rest(wires.device, 70.0)
        assert usual not in speeds
        assert wires.device.memory["Profile Velocity"] == usual


def test_flight_waits_for_quiet_only_if_it_must() -> None:
    with motion_bench(seed=1) as (bench, wires), Turntable(bench) as table:
        pause, seconds = partial(wires.world.clock.sleep, 0.033), []
        for goal_deg, quiet in ((60.0, True), (0.0, False)):
            flight = Flight(pause, (0.0, 60.0), table.recorder(), 90.0, quiet)
            seconds.append(table.fly(goal_deg, flight).seconds)
        assert seconds[1] < seconds[0] - bench.config.table.quiet_s / 2


@pytest.mark.parametrize(
    ("angles", "states", "used"),
    [
        ([0.0, 0.4, 0.8, 2.0], [0, 0, 1, 1], [True, False, True, True]),
        ([0.0, 2.0, 1.7, 1.0, 0.0], [0, 1, 1, -1, -1], [True, True, False, True, True]),
        ([0.0, 2.0, 1.7, 2.0], [0, 1, 1, 1], [True, True, False, True]),
    ],
)
def test_readings_within_the_backlash_are_not_used(angles: list[float], states: list[int], used: list[bool]) -> None:
    found, usable = backlash_states(np.array(angles), 0.5)
    assert found.tolist() == states
    assert usable.tolist() == used
