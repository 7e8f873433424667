"""The table with real drivers on simulated wires: where it stops, when it is at rest, and what it rejects."""

import json

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rig.core.errors import FaultLatched, LimitExceeded, MotionTimeout, NoProgress, NotReady, Stalled
from rig.core.json_form import plain
from rig.devices.servo import MotionProfile
from rig.motion.move import motion_seconds
from rig.motion.trajectory import TrajectoryRecorder
from rig.motion.turntable import Flight, Turntable
from rig.safety.supervisor import TableState
from sim.noise import NoiseModel
from sim.servo import SentBytes
from tests.fuzzing import examples
from tests.rig.bench_parts import at_rest, motion_bench


def test_table_reaches_its_goal_and_the_platter_agrees():
    with motion_bench(seed=1) as (bench, wires), Turntable(bench) as table:
        for target in (5.0, 90.0, -45.0, 0.0, 180.0):
            move = table.goto(target)
            assert move.encoder_deg == at_rest(wires.device, target)
            # The platter hangs behind by half of the backlash, always on the same side.
            lag = move.encoder_deg - wires.world.table_deg()
            assert lag == pytest.approx(wires.world.noise.backlash_deg / 2, abs=0.1)
            assert move.agrees


def test_backlash_is_taken_up_on_the_same_side_in_both_directions():
    noise = NoiseModel(backlash_deg=2.0)
    with motion_bench(noise=noise) as (bench, wires), Turntable(bench) as table:
        table.goto(50.0)
        from_below = wires.world.table_deg()
        table.goto(100.0)
        table.goto(50.0)
        from_above = wires.world.table_deg()
        assert from_above == pytest.approx(from_below, abs=0.15)


def test_table_arrives_although_friction_holds_the_servo_outside_its_window():
    with motion_bench() as (bench, wires), Turntable(bench) as table:
        wires.device.motor.set_friction(0.03)
        for target in (90.0, 60.0, 61.0, 60.5):
            move = table.goto(target)
            state = bench.servo.read_state()
            assert not state.in_position
            assert state.load_percent == pytest.approx(3, abs=0.1)
            assert 0.35 < target - move.encoder_deg < 0.6
            assert move.agrees
        wires.device.motor.set_friction(0.0)
        assert table.goto(30.0).encoder_deg == pytest.approx(30.0, abs=0.2)


def test_steady_load_adds_to_the_friction():
    with motion_bench() as (bench, wires), Turntable(bench) as table:
        wires.device.motor.set_friction(0.02, 0.01)
        assert 90.0 - table.goto(90.0).encoder_deg == pytest.approx(0.03 * 885 / 5 * 0.0879, abs=0.1)
        wires.device.motor.set_friction(0.02, -0.01)
        assert 120.0 - table.goto(120.0).encoder_deg == pytest.approx(0.01 * 885 / 5 * 0.0879, abs=0.1)


def test_distance_of_a_table_that_friction_holds_beyond_the_tolerance_is_reported():
    with (
        motion_bench() as (bench, wires),
        pytest.raises(NoProgress, match=r"[01]\.\d° from its goal: friction") as held,
        Turntable(bench) as table,
    ):
        wires.device.motor.set_friction(0.08)
        table.goto(90.0)
    assert "table.tolerance_deg above" in held.value.next_step


def test_servo_that_lost_its_torque_near_its_goal_has_not_arrived():
    """Without torque no profile is ongoing, and the table may stand within the tolerance."""

    def drop() -> None:
        wires.device.memory["Torque Enable"] = 0
        wires.device.motor.release()

    with motion_bench() as (bench, wires), pytest.raises(MotionTimeout), Turntable(bench) as table:
        wires.device.motor.set_friction(0.03)
        begun_ns = wires.world.clock.now_ns()
        wires.world.clock.call_at(begun_ns + round(0.97e9), drop)
        table.goto(45.0)


def test_entering_moves_nothing_and_leaving_switches_torque_off():
    with motion_bench() as (bench, wires):
        with Turntable(bench):
            assert wires.device.memory["Torque Enable"] == 1
            assert abs(wires.world.shaft()[0]) < 0.2
        assert wires.device.memory["Torque Enable"] == 0


def test_stop_follows_the_ramp_without_overshoot():
    with motion_bench() as (bench, wires):
        speeds = []

        def view() -> None:
            speeds.append(wires.world.shaft()[1])
            wires.world.clock.call_at(wires.world.clock.now_ns() + 10_000_000, view)

        def interrupt() -> None:
            raise KeyboardInterrupt

        wires.world.clock.call_at(0, view)
        wires.world.clock.call_at(wires.world.clock.now_ns() + 1_900_000_000, interrupt)
        with pytest.raises(KeyboardInterrupt), Turntable(bench) as table:
            table.goto(300.0)
        assert max(speeds) == pytest.approx(bench.config.table.velocity_dps, abs=1)
        assert min(speeds) > -5
        slowing = -np.diff(speeds).min() / 0.01
        assert slowing < 1.5 * bench.config.table.acceleration_dps2
        assert speeds[-1] == 0
        assert bench.safety.state is TableState.STOPPED


def test_target_beyond_the_limits_is_rejected_before_anything_moves():
    with motion_bench() as (bench, wires), Turntable(bench) as table:
        before = len(wires.instructions)
        with pytest.raises(LimitExceeded) as caught:
            table.goto(401.0)
        assert len(wires.instructions) == before
        assert caught.value.evidence == {"from_deg": 0.0, "to_deg": 401.0, "limits_deg": [-400.0, 400.0]}


@examples(10)
@given(target=st.floats(-3000, 3000), low=st.floats(-800, 0), span=st.floats(360, 1500))
@example(target=-5e-324, low=0.0, span=360.0)
def test_within_reach_returns_an_equivalent_angle(target, low, span):
    high = low + span
    if high < 0:
        return
    with motion_bench(f"table.limits_deg=[{low!r}, {high!r}]") as (bench, _):
        table = Turntable(bench)
        found = table.within_reach(target)
        assert low <= found <= high
        revolutions = (found - target) / 360
        assert revolutions == pytest.approx(round(revolutions), abs=1e-9)
        if low <= target <= high:
            assert found == target


def test_motion_needs_torque():
    with motion_bench() as (bench, _):
        table = Turntable(bench)
        flight = Flight(lambda: None, (0.0, 5.0), TrajectoryRecorder(0.088, 0.5, 0.01, 0.0035), 90.0)
        for move in (table.goto, lambda to: table.fly(to, flight)):
            with pytest.raises(NotReady, match="torque"):
                move(5.0)


def test_shaking_bench_is_not_at_rest():
    noise = NoiseModel(structure_hz=8.0, structure_damping=0.001)  # rings for minutes
    with motion_bench(noise=noise) as (bench, _), pytest.raises(MotionTimeout) as caught, Turntable(bench) as table:
        table.goto(30.0)
    assert caught.value.evidence["peak_rate_dps"] > bench.config.table.quiet_dps


def test_check_still_detects_a_push_after_settling():
    with motion_bench() as (bench, wires), Turntable(bench) as table:
        table.goto(20.0)
        wires.world.clock.sleep(0.2)
        assert table.check_still().still
        servo = bench.servo
        servo.move_to(servo.read_state().position_deg + 5)
        wires.world.clock.sleep(0.15)
        assert not table.check_still().still


def test_direction_and_zero_belong_to_the_table():
    with (
        motion_bench("table.direction=-1", "imu.sign=-1", "table.zero_deg=170.0") as (bench, wires),
        Turntable(bench) as table,
    ):
        move = table.goto(30.0)
        assert move.agrees
        assert -10.0 - wires.world.shaft()[0] == at_rest(wires.device, 30.0)


@given(distance=st.floats(-400, 400), v=st.floats(1, 300), a=st.floats(10, 2000))
def test_motion_seconds_follows_the_trapezoid(distance, v, a):
    from sim.motion import to_position

    expected = to_position(0.0, 0.0, 0.0, distance, v, a).end_s
    assert motion_seconds(distance, MotionProfile(v, a)) == pytest.approx(expected, abs=1e-9)


def test_ctrl_c_during_torque_on_switches_it_off():
    with motion_bench() as (bench, wires):

        def interrupt() -> None:
            raise KeyboardInterrupt

        def when_on(frame: SentBytes) -> SentBytes:
            if wires.device.memory["Torque Enable"]:
                wires.bus.filters.clear()
                wires.world.clock.call_at(wires.world.clock.now_ns(), interrupt)
            return frame

        wires.bus.filters.append(when_on)
        with pytest.raises(KeyboardInterrupt), Turntable(bench):
            pass
        assert not wires.bus.filters
        assert wires.device.memory["Torque Enable"] == 0


def test_armed_watchdog_of_a_killed_program_does_not_stop_the_next_run():
    with motion_bench() as (bench, wires):
        bench.servo.torque_on()
        bench.servo.arm_watchdog(0.2)  # and the host is killed: no torque off
        wires.world.clock.sleep(0.1)
        with Turntable(bench) as table:
            assert wires.device.memory["Profile Velocity"] > 0  # 0 would mean full speed
            assert table.goto(20.0).encoder_deg == at_rest(wires.device, 20.0)


def test_short_disturbance_at_rest_does_not_fail_the_move():
    with motion_bench() as (bench, wires), Turntable(bench) as table:
        table.goto(20.0)
        wires.world.slip(0.06, 0.05)
        assert table.goto(40.0).agrees


def test_platter_pushed_at_rest_shows_in_the_next_move():
    with motion_bench() as (bench, wires), Turntable(bench) as table:
        table.goto(20.0)
        wires.world.slip(5.0, 0.2)
        wires.world.clock.sleep(0.4)
        move = table.goto(40.0)
        assert not move.agrees
        assert move.rotation_deg == pytest.approx(25.0, abs=0.6)


def test_shake_at_the_start_of_a_long_exposure_is_detected():
    with motion_bench() as (bench, wires), Turntable(bench) as table:
        settled_ns = table.goto(20.0).settled_ns
        wires.world.slip(0.06, 0.05)
        wires.world.clock.sleep(0.6)
        assert table.check_still().still  # it stands now
        assert not table.check_still(settled_ns).still


def test_push_of_the_platter_stays_visible_at_rest():
    with motion_bench() as (bench, wires), Turntable(bench) as table:
        table.goto(20.0)
        wires.world.slip(2.0, 0.1)
        wires.world.clock.sleep(0.5)
        stillness = table.check_still()
        assert not stillness.still
        assert stillness.platter_change_deg == pytest.approx(2.0, abs=0.2)


def test_timeout_without_gyro_data_is_valid_json():
    with motion_bench() as (bench, wires), pytest.raises(MotionTimeout) as caught:
        wires.device.jam()
        wires.device.memory["Shutdown"] = 0
        with Turntable(bench) as table:
            table._gyro.bias = None
            table._wait_for_rest(60.0, 0.1, 0.5)
    reported = json.loads(json.dumps(plain(caught.value.problem), allow_nan=False))
    assert reported["evidence"]["peak_rate_dps"] is None


def test_interrupted_motion_must_be_acknowledged():
    with motion_bench() as (bench, wires):
        table = Turntable(bench)
        with table:
            table.goto(10.0)
            wires.device.jam()
            with pytest.raises(Stalled):
                table.goto(60.0)
            sent = len(wires.instructions)
            with pytest.raises(FaultLatched, match="blocked"):
                table.goto(10.0)
            assert len(wires.instructions) == sent
        with pytest.raises(FaultLatched), table:
            pass
        assert wires.device.memory["Torque Enable"] == 0
        wires.device.free()
        bench.safety.acknowledge()
        with table:
            assert table.goto(20.0).agrees


def test_backlash_is_visible_without_approach():
    """Without the approach, the backlash is visible: the test above would fail."""
    noise = NoiseModel(backlash_deg=2.0)
    with (
        motion_bench("table.approach_deg=0", "table.backlash_deg=3", noise=noise) as (bench, wires),
        Turntable(bench) as table,
    ):
        table.goto(50.0)
        from_below = wires.world.table_deg()
        table.goto(100.0)
        table.goto(50.0)
        assert abs(wires.world.table_deg() - from_below) > 1.5
