"""Faults that end a motion: each is found in time, the table stops, its torque goes off, and the fault is latched."""

from dataclasses import replace

import pytest

from rig.config import SafetyConfig
from rig.core.errors import (
    DeviceFault,
    FollowingError,
    MotionStopped,
    NoProgress,
    Overheated,
    Overloaded,
    RotationDisagreement,
    Stalled,
    SupplyOutOfRange,
)
from rig.devices.servo import ServoLimits, ServoState
from rig.motion.turntable import Turntable
from rig.safety.gyro_rotation import GyroIssue, Rotation
from rig.safety.motion_checks import MotionMonitor, SlipMonitor, find_servo_fault
from rig.safety.supervisor import TableState
from sim.servo import motor
from tests.rig.bench_parts import motion_bench

CONFIG = SafetyConfig()
LIMITS = ServoLimits(temperature_c=72.0, voltage_v=(6.0, 14.0))
WELL = ServoState(0, 0.0, 90.0, 10.0, 12.0, 33.0, True, False, ())
PERIOD_S = 0.04


FAULTS = {
    "jam": (lambda w: w.device.jam(), Stalled, 0.7),
    "heat": (lambda w: w.device.set_temperature(68.0), Overheated, 0.1),
    "low supply": (lambda w: w.device.set_voltage(6.1), SupplyOutOfRange, 0.25),
    "high supply": (lambda w: w.device.set_voltage(13.95), SupplyOutOfRange, 0.25),
    "shutdown": (lambda w: w.device.fail(0x20), DeviceFault, 0.1),
    "encoder error": (lambda w: w.device.fail(0x08), DeviceFault, 0.1),
    "loose platter": (lambda w: w.world.slip(-40.0, 0.5), RotationDisagreement, 0.5),
    "encoder slips": (lambda w: w.device.slip_encoder(40.0), RotationDisagreement, 0.5),
}


@pytest.mark.parametrize("name", FAULTS)
def test_fault_in_a_motion_stops_the_table_and_latches(name):
    cause, error, within_s = FAULTS[name]
    with motion_bench() as (bench, wires):
        clock = wires.world.clock
        begun_ns = []

        def happen() -> None:
            begun_ns.append(clock.now_ns())
            cause(wires)

        with pytest.raises(error) as caught, Turntable(bench) as table:
            clock.call_at(clock.now_ns() + 1_500_000_000, happen)
            try:
                table.goto(300.0)
            except error:
                # Found, and stopped: the ramp from 90 °/s takes 0.375 s.
                assert (clock.now_ns() - begun_ns[0]) * 1e-9 < within_s + 0.6
                assert abs(wires.world.shaft()[1]) < bench.servo.profile_units.velocity_dps / 2  # it reads 0
                raise
        assert bench.safety.state is TableState.FAULT
        assert bench.safety.fault.code == caught.value.code
        assert caught.value.exit_code in (4, 5)
        assert caught.value.next_step
        assert wires.device.memory["Torque Enable"] == 0
        assert wires.world.shaft()[0] < 300.0
        clock.sleep(2.0)
        assert wires.world.shaft()[1] == 0


def test_high_friction_is_an_overload(monkeypatch):
    with motion_bench() as (bench, wires):
        with pytest.raises(Overloaded) as caught, Turntable(bench) as table:
            monkeypatch.setattr(motor, "FRICTION_LOAD", 0.85)
            table.goto(300.0)
        assert caught.value.evidence["load_percent"] == pytest.approx(85, abs=10)
        assert wires.device.memory["Hardware Error Status"] == 0
        assert bench.safety.state is TableState.FAULT


def test_servo_without_torque_makes_no_progress():
    with motion_bench() as (bench, wires):
        with pytest.raises(NoProgress), Turntable(bench) as table:
            table.goto(10.0)
            wires.device.memory["Torque Enable"] = 0
            wires.device.motor.release()
            table.goto(60.0)
        assert bench.safety.state is TableState.FAULT
        bench.safety.acknowledge()
        with Turntable(bench) as table:
            assert table.goto(60.0).agrees


def test_frozen_readings_never_become_a_goal():
    with motion_bench() as (bench, wires):
        kept, speeds = [], []

        def stick(memory) -> None:
            kept.append(memory.live())
            memory.set_live(kept[0])

        def view() -> None:
            speeds.append(wires.world.shaft()[1])
            wires.world.clock.call_at(wires.world.clock.now_ns() + 10_000_000, view)

        view()
        with pytest.raises((NoProgress, FollowingError, RotationDisagreement)), Turntable(bench) as table:
            wires.world.clock.call_at(
                wires.world.clock.now_ns() + 1_500_000_000, lambda: wires.device.distortions.append(stick)
            )
            table.goto(300.0)
        wires.world.clock.sleep(1.0)
        assert max(speeds) > 80
        assert min(speeds) > -1
        assert wires.device.memory["Torque Enable"] == 0


def test_hot_servo_at_rest_is_a_fault_until_it_cooled_down():
    with motion_bench() as (bench, wires):
        wires.device.set_temperature(70.0)
        driven = []
        wires.bus.taps.append(lambda _: driven.append(wires.device.memory["Torque Enable"]))
        with pytest.raises(Overheated) as caught, Turntable(bench):
            pytest.fail("it moves")
        assert not any(driven)
        assert "below 62 °C" in caught.value.next_step
        assert bench.safety.state is TableState.FAULT
        wires.device.set_temperature(65.0)  # not too hot any more, but not cool either
        with pytest.raises(Overheated):
            bench.safety.acknowledge()
        wires.device.set_temperature(50.0)
        assert bench.safety.acknowledge() is TableState.READY


def test_heat_and_stop_requests_are_checked_between_motions():
    with motion_bench() as (bench, wires):
        with pytest.raises(MotionStopped), Turntable(bench) as table:
            table.goto(20.0)
            bench.state.stop = True
            table.check_still()
        assert wires.device.memory["Torque Enable"] == 0
        with pytest.raises(Overheated), Turntable(bench) as table:
            table.goto(40.0)
            wires.device.set_temperature(70.0)
            table.check_still()
        assert bench.safety.state is TableState.FAULT
        assert wires.device.memory["Torque Enable"] == 0


@pytest.mark.parametrize("volts", [6.1, 13.95])
def test_supply_out_of_range_is_reported_with_the_range(volts):
    with motion_bench() as (bench, wires):
        wires.device.set_voltage(volts)
        with pytest.raises(SupplyOutOfRange, match=r"6\.2 V to 13\.8 V") as caught, Turntable(bench):
            pytest.fail("it moves")
        assert caught.value.evidence["voltage_v"] == pytest.approx(volts, abs=0.1)


def test_slip_below_the_bound_does_not_stop_the_move():
    with motion_bench(seed=3) as (bench, wires), Turntable(bench) as table:
        clock = wires.world.clock
        clock.call_at(clock.now_ns() + 1_000_000_000, lambda: wires.world.slip(-6.0, 0.2))
        move = table.goto(120.0)
        assert not move.agrees
        assert bench.safety.state is TableState.READY


def test_calibration_of_the_gyro_ignores_slip():
    with motion_bench("imu.sign=-1") as (bench, _), Turntable(bench, trust_gyro=False) as table:
        assert not table.goto(120.0).agrees
    with (
        motion_bench("imu.sign=-1") as (bench, _),
        pytest.raises(RotationDisagreement) as caught,
        Turntable(bench) as table,
    ):
        table.goto(120.0)
    assert "imu.sign" in caught.value.next_step


@pytest.mark.parametrize(
    ("velocity", "target"),
    [
        (5.0, 0.5),
        (180.0, 40.0),
        *(
            pytest.param(*one, marks=pytest.mark.nightly)
            for one in ((90.0, 0.5), (180.0, 0.5), (5.0, 40.0), (90.0, 40.0))
        ),
    ],
)
def test_normal_motion_is_never_stopped(velocity, target):
    fast = (f"table.velocity_dps={velocity}", "table.acceleration_dps2=900")
    with motion_bench(*fast) as (bench, _), Turntable(bench) as table:
        for goal in (target, -target, 0.0):
            assert table.goto(goal).agrees


# -- the monitor alone -----------------------------------------------------------------------------------------------


def monitor(goal_deg: float = 300.0) -> MotionMonitor:
    return MotionMonitor(CONFIG, LIMITS, start_deg=0.0, goal_deg=goal_deg, tolerance_deg=0.6, cruise_dps=90.0)


def at(k: int, **values) -> ServoState:
    return replace(WELL, time_ns=round(k * PERIOD_S * 1e9), **values)


def readings_until(error, watch: MotionMonitor, state, angle_deg, lag_deg) -> float:
    """Return the number of seconds of such readings after which the monitor raises ``error``."""
    for k in range(200):
        try:
            watch.check(at(k, **state), angle_deg(k), lag_deg)
        except error:
            return k * PERIOD_S
    return float("inf")


def rotating(k: int) -> float:
    return 90.0 * k * PERIOD_S


def standing(_: int) -> float:
    return 20.0


@pytest.mark.parametrize("load", [75.0, -100.0])
def test_each_limit_has_its_duration(load):
    push = {"load_percent": load}
    assert readings_until(Stalled, monitor(), push | {"velocity_dps": 0.0}, standing, 0.0) == pytest.approx(
        0.28, abs=0.05
    )
    assert readings_until(Overloaded, monitor(), push, rotating, 0.0) == pytest.approx(0.8, abs=0.05)
    assert readings_until(FollowingError, monitor(), {}, rotating, 13.0) == pytest.approx(0.4, abs=0.05)
    assert readings_until(NoProgress, monitor(), {"velocity_dps": 0.0}, standing, 0.0) == pytest.approx(1.0, abs=0.05)
    assert readings_until(FollowingError, monitor(60.0), {}, rotating, 0.0) == pytest.approx(0.8, abs=0.05)


def test_table_at_its_goal_needs_no_progress():
    assert readings_until(NoProgress, monitor(20.3), {"velocity_dps": 0.0}, standing, None) == float("inf")


def test_short_push_or_voltage_dip_is_not_a_fault():
    watch = monitor()
    for k in range(70):
        dip = {"voltage_v": 6.1} if k % 3 == 0 else {}
        watch.check(at(k, load_percent=90.0 if k % 18 else 5.0, **dip), rotating(k), 0.0)


def test_hardware_errors_come_first_and_a_hot_servo_must_cool_down():
    assert isinstance(
        find_servo_fault(replace(WELL, hardware_errors=("overload",), temperature_c=90.0), CONFIG, LIMITS), DeviceFault
    )
    warm = replace(WELL, temperature_c=64.0)
    assert find_servo_fault(warm, CONFIG, LIMITS) is None
    assert isinstance(find_servo_fault(warm, CONFIG, LIMITS, again=True), Overheated)


def test_slip_is_compared_at_the_same_time_within_the_uncertainty():
    slip = SlipMonitor(CONFIG, start_deg=5.0)
    for k in range(10):
        slip.add_reading(k * 40, 5.0 + k)
    assert slip.encoder_deg(-1) is None
    assert slip.encoder_deg(165) == (160, 4.0)
    slip.compare(100.0, Rotation(89.0, 0.3, 1.0))
    slip.compare(100.0, Rotation(20.0, 0.3, 1.0, GyroIssue.LOST_SAMPLES, 5))
    with pytest.raises(RotationDisagreement):
        slip.compare(100.0, Rotation(88.0, 0.3, 1.0))
