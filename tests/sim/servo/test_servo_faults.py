"""Faults of a servo, their detection, and their end."""

from typing import Any

import pytest
from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS
from hypothesis import given
from hypothesis import strategies as st

from sim.servo.device import (
    BOOT_S,
    ELECTRICAL_ERROR,
    ENCODER_ERROR,
    OVERHEATING_ERROR,
    OVERLOAD_ERROR,
    SUPERVISION_S,
    VOLTAGE_ERROR,
)
from sim.servo.models import MODELS
from sim.servo.motor import OVERLOAD_S
from sim.servo.protocol2 import StatusError
from tests.fuzzing import examples
from tests.sim.servo.servo_bench import ALERT, DEG_PER_COUNT, Line, extended

FOLLOWING_ERROR = 0x08


# -- Bus Watchdog ---------------------------------------------------------------------------------------------------


@given(units=st.integers(1, 127), last_read_s=st.floats(0.0, 1.0))
@examples(6)
def test_watchdog_trips_after_its_time_without_instructions(units: int, last_read_s: float) -> None:
    line = Line()
    servo = line.add()
    line.put(Operating_Mode=4, Profile_Velocity=50, Torque_Enable=1, Goal_Position=100_000, Bus_Watchdog=units)
    if last_read_s < units * 0.02 - 0.005:
        line.sleep(last_read_s)
        line.read("Present Position")
    heard_ns = [frame for frame in line.frames if frame.source.value == "host"][-1].end_ns
    line.clock.advance_to(heard_ns + units * 20_000_000 - 1)
    assert servo.memory["Bus Watchdog"] == units
    assert line.worlds[1].shaft()[1] > 0
    line.clock.advance_to(heard_ns + units * 20_000_000)
    assert servo.memory["Bus Watchdog"] == 0xFF
    line.sleep(0.2)
    assert line.worlds[1].shaft()[1] == 0.0


def test_tripped_watchdog_rejects_goals_until_it_is_cleared(line: Line) -> None:
    extended(line)
    line.put(Bus_Watchdog=5, Goal_Position=9000)
    line.sleep(0.5)
    stopped = line.shaft()
    assert 0 < stopped < 60
    assert line.read("Bus Watchdog") == 0xFF
    assert line.read("Torque Enable") == 1
    assert (line.read("Profile Velocity"), line.read("Profile Acceleration")) == (0, 0)
    for goal in ("Goal Position", "Goal Velocity", "Goal PWM"):
        assert line.write(goal, 1) == StatusError.DATA_RANGE
    assert line.write("Bus Watchdog", 5) == StatusError.DATA_RANGE
    line.put(Bus_Watchdog=0)
    line.sleep(1.0)
    assert line.shaft() == stopped  # clearing it moves nothing
    line.put(Goal_Position=2048)
    line.sleep(1.0)
    assert line.shaft() == pytest.approx(0.0)


def test_watchdog_trips_only_without_instructions_to_its_own_servo(line: Line) -> None:
    line.add(2)
    extended(line)
    line.put(Bus_Watchdog=5, Goal_Position=9000)
    for _ in range(60):
        line.sleep(0.09)
        line.read("Present Position")
    assert line.read("Bus Watchdog") == 5
    for _ in range(4):
        line.sleep(0.03)
        line.sdk.ping(line.port, 2)
    assert line.read("Bus Watchdog") == 0xFF


def test_watchdog_is_inactive_while_torque_is_off(line: Line) -> None:
    line.put(Bus_Watchdog=1)
    line.sleep(5.0)
    assert line.read("Bus Watchdog") == 1
    line.put(Torque_Enable=1)
    line.sleep(0.1)
    assert line.read("Bus Watchdog") == 0xFF


# -- hardware errors ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [OVERLOAD_ERROR, OVERHEATING_ERROR, ELECTRICAL_ERROR])
def test_error_in_the_shutdown_mask_disables_torque_until_reboot(line: Line, error: int) -> None:
    line.put(Torque_Enable=1)
    line.servos[1].fail(error)
    assert line.sdk.ping(line.port, 1) == (1060, COMM_SUCCESS, ALERT)
    assert line.read("Hardware Error Status") == error
    assert line.read("Torque Enable") == 0
    assert line.write("Torque Enable", 1) == ALERT
    assert line.read("Torque Enable") == 0
    line.sdk.reboot(line.port, 1)
    line.sleep(BOOT_S)
    line.put(Torque_Enable=1)
    assert line.read("Torque Enable") == 1


def test_error_outside_the_mask_only_raises_the_alert(line: Line) -> None:
    line.put(Torque_Enable=1)
    line.servos[1].fail(ENCODER_ERROR)
    assert line.sdk.ping(line.port, 1)[2] == ALERT
    assert line.read("Torque Enable") == 1


@pytest.mark.parametrize(("supply_v", "alert"), [(5.9, True), (6.0, False), (14.0, False), (14.1, True)])
def test_supply_is_compared_with_its_limits(line: Line, supply_v: float, alert: bool) -> None:
    line.put(Torque_Enable=1)
    line.servos[1].set_voltage(supply_v)
    assert (line.sdk.ping(line.port, 1)[2] == ALERT) is alert
    assert line.read("Hardware Error Status") == (VOLTAGE_ERROR if alert else 0)
    assert line.read("Present Input Voltage") == round(supply_v * 10)
    assert line.read("Torque Enable") == 1  # the XL430's mask leaves the voltage out
    line.servos[1].set_voltage(12.0)
    assert (line.sdk.ping(line.port, 1)[2] == ALERT) is alert  # once raised, it stays


def test_temperature_is_compared_with_its_limit(line: Line) -> None:
    line.put(Torque_Enable=1)
    line.servos[1].set_temperature(72.0)
    assert line.read("Hardware Error Status") == 0
    line.servos[1].set_temperature(72.1)
    assert line.read("Hardware Error Status") == OVERHEATING_ERROR
    assert line.read("Present Temperature") == 72


# -- a jammed table -------------------------------------------------------------------------------------------------


def test_jam_shows_as_following_error_then_load_then_overload(line: Line) -> None:
    extended(line)
    line.put(Goal_Position=9000)
    line.sleep(1.0)
    servo = line.servos[1]
    servo.jam()
    jammed_ns, stuck = line.clock.now_ns(), line.shaft()
    line.sleep(0.3)
    assert line.shaft() == stuck
    assert line.read("Present Velocity") == 0
    assert line.read("Moving Status") & FOLLOWING_ERROR
    line.sleep(0.3)
    assert line.read("Present Load") == 1000
    assert line.read("Hardware Error Status") == 0
    while not servo.memory["Hardware Error Status"] and line.clock.now_ns() < jammed_ns + 10_000_000_000:
        line.sleep(0.01)
    elapsed_s = (line.clock.now_ns() - jammed_ns) * 1e-9
    # The load saturates when the error has grown so far at 44 units of speed.
    saturation_s = MODELS["xl430_w250"].stall_error_deg / (44 * 1.374)
    assert elapsed_s == pytest.approx(saturation_s + OVERLOAD_S, abs=2 * SUPERVISION_S)
    assert line.read("Hardware Error Status") == OVERLOAD_ERROR
    assert line.read("Torque Enable") == 0
    assert line.read("Present Load") == 0
    servo.free()
    line.sleep(1.0)
    assert line.shaft() == stuck


def test_servo_continues_after_a_short_jam(line: Line) -> None:
    extended(line)
    line.put(Goal_Position=4000)
    line.sleep(0.5)
    line.servos[1].jam()
    line.sleep(1.0)
    line.servos[1].free()
    line.sleep(3.0)
    assert line.read("Present Position") == 4000
    assert line.read("Hardware Error Status") == 0
    line.put(Torque_Enable=0)
    line.put(Operating_Mode=1, Torque_Enable=1, Goal_Velocity=50)
    line.servos[1].jam()
    line.sleep(0.2)
    assert line.read("Present Velocity") == 0
    line.servos[1].free()
    line.sleep(0.5)
    assert line.read("Present Velocity") == 50


def test_jam_without_torque_causes_no_overload(line: Line) -> None:
    line.servos[1].jam()
    line.sleep(10.0)
    assert line.read("Hardware Error Status") == 0
    with pytest.raises(ValueError, match="held"):
        line.servos[1].rotate_by_hand(10.0)


def test_stalling_heats_the_case(line: Line) -> None:
    line.put(Shutdown=4)  # no overload shutdown
    extended(line)
    line.servos[1].jam()
    line.put(Goal_Position=9000)
    line.sleep(100.0)
    assert line.read("Present Temperature") == pytest.approx(33 + 90 * (1 - 2.71828**-0.25), abs=2)
    line.sleep(300.0)
    assert line.read("Hardware Error Status") & OVERHEATING_ERROR
    assert line.read("Torque Enable") == 0


# -- power ----------------------------------------------------------------------------------------------------------


def test_servo_without_power_is_silent_and_has_no_torque(line: Line) -> None:
    extended(line, velocity=100)
    line.put(Goal_Position=20_000)
    line.sleep(1.0)
    line.servos[1].power_off()
    line.sleep(1.0)
    stopped = line.shaft()
    assert line.sdk.ping(line.port, 1)[1] == COMM_RX_TIMEOUT
    line.servos[1].rotate_by_hand(30.0)
    line.sleep(5.0)
    assert line.shaft() == pytest.approx(stopped + 30)
    line.servos[1].power_on()
    line.sleep(BOOT_S)
    assert line.read("Torque Enable") == 0
    assert line.read("Present Position") == round((stopped + 30) / DEG_PER_COUNT + 2048) % 4096
    line.servos[1].power_cycle()
    line.servos[1].power_off()  # while it boots
    line.sleep(BOOT_S)
    assert not line.servos[1].powered


@pytest.mark.parametrize(
    ("option", "message"),
    [({"bus_id": 253}, "253"), ({"baudrate": 56_000}, "56000"), ({"model": "xl999"}, r"xl999.*xl430_w250")],
)
def test_invalid_servos_are_rejected(option: dict[str, Any], message: str) -> None:
    assert set(MODELS) == {"xl430_w250", "xm430_w350", "xl330_m288", "mx_28", "ph54_200_s500"}
    with pytest.raises(ValueError, match=message):
        Line().add(**option)
