"""The servo driver on the byte-true simulator."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.core.clock import seconds_between
from rig.core.errors import DeviceFault, DeviceMismatch, DeviceNotFound
from rig.devices.dynamixel.servo import DynamixelServo
from rig.devices.servo import MotionProfile
from sim.noise import NoiseModel
from tests.fuzzing import examples
from tests.rig.bench_parts import open_bus, open_servo, servo_wires


@pytest.fixture
def servo(wires):
    return open_servo(wires)


def test_factory_settings_are_rejected_with_a_list_of_differences_and_not_changed(wires):
    servo = DynamixelServo(open_bus(wires), bus_id=1, model="xl430_w250", clock=wires.world.clock)
    with pytest.raises(DeviceMismatch) as caught:
        servo.prepare(write=False)
    assert {frame[7] for frame in wires.instructions} <= {1, 2}  # Ping and Read
    reported = {register: text.partition(":")[0] for register, text in caught.value.evidence.items()}
    assert reported == {"Operating Mode": "found 3, wanted 4", "Return Delay Time": "found 250, wanted 0"}
    assert all(text.partition(": ")[2] for text in caught.value.evidence.values())  # each with its reason
    assert "write_settings" in caught.value.next_step


def test_missing_servo_raises_device_not_found(wires):
    with pytest.raises(DeviceNotFound, match="id 9"):
        DynamixelServo(open_bus(wires, retries=0), bus_id=9, model="xl430_w250", clock=wires.world.clock)


def test_torque_on_sets_the_goal_to_the_present_position_first(wires, servo):
    wires.device.rotate_by_hand(123.0)
    wires.world.clock.sleep(3.0)
    before = wires.world.shaft()[0]
    servo.torque_on()
    wires.world.clock.sleep(1.0)
    assert abs(wires.world.shaft()[0] - before) < 0.2


@examples(6)
@given(goal_deg=st.floats(-700, 700))
def test_goal_is_reached_within_one_count_over_many_revolutions(goal_deg):
    wires = servo_wires(NoiseModel.none())
    servo = open_servo(wires)
    servo.set_profile(MotionProfile(300.0, 3000.0))
    servo.torque_on()
    start = servo.read_state().position_deg
    servo.move_to(start + goal_deg)
    wires.world.clock.sleep(6.0)
    state = servo.read_state()
    assert state.position_deg == pytest.approx(start + goal_deg, abs=360 / 4096)
    assert state.in_position
    assert not state.moving


def test_profile_is_never_zero(wires):
    got = open_servo(wires).set_profile(MotionProfile(0.01, 0.01))
    assert got.velocity_dps > 0
    assert got.acceleration_dps2 > 0
    assert wires.device.memory["Profile Velocity"] == 1


def test_hardware_error_is_reported_and_prevents_torque(wires, servo):
    wires.device.set_temperature(95.0)
    wires.world.clock.sleep(2.0)
    assert servo.read_state().hardware_errors == ("overheating",)
    with pytest.raises(DeviceFault, match="overheating"):
        servo.torque_on()


def test_state_is_read_in_one_transaction(wires, servo):
    servo.read_state()  # a second reading confirms the first one
    before = len(wires.instructions)
    state = servo.read_state()
    assert len(wires.instructions) == before + 1
    assert state.voltage_v == pytest.approx(12.0, abs=1.0)
    assert 15 < state.temperature_c < 60


def test_tripped_watchdog_is_cleared_only_by_torque_on(wires, servo):
    servo.torque_on()
    servo.arm_watchdog(0.1)
    servo.move_to(servo.read_state().position_deg + 90)
    wires.world.clock.sleep(2.0)  # the host is silent
    assert wires.device.memory["Bus Watchdog"] == 0xFF
    assert abs(wires.world.shaft()[1]) < 1e-9
    servo.torque_on()
    assert wires.device.memory["Bus Watchdog"] == 0


def test_reading_has_the_time_of_the_attempt_that_was_answered():
    """Else the servo's clock would not agree, and a busy computer would take a good servo for a broken one."""
    wires = servo_wires()
    servo, clock = open_servo(wires), wires.world.clock
    servo.read_state()
    lost = iter([True, True])
    wires.bus.filters.append(lambda frame: None if next(lost, False) else frame)
    before = servo.bus.statistics.transactions
    state = servo.read_state()
    assert servo.bus.statistics.transactions == before + 3
    assert seconds_between(state.time_ns, clock.now_ns()) < 0.01
