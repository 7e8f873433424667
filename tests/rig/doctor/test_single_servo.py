"""Change of id and baud rate: only on a single servo, with its torque off, and verified."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.config.servos import known_model, model_numbers
from rig.core.errors import BenchBusy, DeviceMismatch, DeviceNotFound, RequestRejected, SeveralServos, UsageError
from rig.devices.dynamixel.registers import control_table
from rig.doctor.register_meaning import baud_codes, meaning
from rig.doctor.single_servo import single_servo
from rig.safety.saved_state import Holder
from tests.fuzzing import fuzz_settings
from tests.rig.doctor.doctor_parts import unopened

WRITE = 0x03


@fuzz_settings(0.02)
@given(
    at=st.tuples(st.integers(0, 252), st.sampled_from([57_600, 1_000_000, 9_600])),
    new_id=st.integers(0, 252),
    new_baud=st.sampled_from([9_600, 57_600, 115_200, 4_500_000]),
)
def test_servo_at_any_id_and_rate_can_be_changed(at, new_id, new_baud):
    with unopened(servo_at=at) as bench:
        memory = bench.devices.servo.memory
        memory["Torque Enable"] = 1
        with single_servo(bench.context) as servo:
            assert (servo.found.bus_id, servo.found.baud) == at
            servo.set_id(new_id)
        assert memory["ID"] == new_id
        assert memory["Torque Enable"] == 0
        with single_servo(bench.context) as servo:
            assert (servo.found.bus_id, servo.found.baud) == (new_id, at[1])
            servo.set_baud(new_baud)
        with single_servo(bench.context) as servo:
            assert (servo.found.bus_id, servo.found.baud) == (new_id, new_baud)


@pytest.mark.parametrize("place", [(2, 57_600), (2, 1_000_000), (1, 57_600), (1, 115_200)])
def test_second_servo_at_any_rate_prevents_changes(place, bench):
    bench.add_servo(*place)
    with pytest.raises(SeveralServos) as caught, single_servo(bench.context):
        pass
    assert "Unplug" in caught.value.next_step
    assert caught.value.exit_code == 4
    assert WRITE not in bench.instructions


def test_missing_servo_unknown_model_and_busy_bench_are_errors(monkeypatch):
    monkeypatch.setattr("rig.doctor.single_servo.BAUD_RATES_1", (1_000_000,))
    with unopened() as bench:
        for number in (4711, 4000):  # no model, and one that the rig cannot drive
            bench.devices.servo.memory["Model Number"] = number
            with pytest.raises(DeviceMismatch, match="cannot drive") as caught, single_servo(bench.context):
                pass
            assert caught.value.evidence["model_number"] == number
            assert WRITE not in bench.instructions
        bench.devices.servo_bus.detach(bench.devices.servo)
        with pytest.raises(DeviceNotFound, match="at any baud rate"), single_servo(bench.context):
            pass
        bench.sent.clear()
        bench.context.holder = Holder(pid=7, command="rig enroll mug", since_utc="")
        with pytest.raises(BenchBusy, match="rig enroll mug"), single_servo(bench.context):
            pass
        assert not bench.sent


def test_invalid_id_and_rate_are_rejected_before_writing():
    with unopened() as bench, single_servo(bench.context) as servo:
        with pytest.raises(UsageError, match="No servo has the id 253"):
            servo.set_id(253)
        with pytest.raises(UsageError) as caught:
            servo.set_baud(250_000)
        assert "4500000" in caught.value.next_step
        assert WRITE not in bench.instructions


def test_servo_that_keeps_its_id_is_an_error(monkeypatch):
    with unopened() as bench, single_servo(bench.context) as servo:
        monkeypatch.setattr(type(bench.devices.servo), "bus_id", property(lambda _: 1))
        with pytest.raises(RequestRejected, match="did not accept the id 9"):
            servo.set_id(9)


def test_servo_that_keeps_its_rate_is_still_reached(monkeypatch):
    with unopened() as bench, single_servo(bench.context) as servo:
        monkeypatch.setattr(type(bench.devices.servo), "baudrate", property(lambda _: 57_600))
        with pytest.raises(RequestRejected, match="1000000 baud"):
            servo.set_baud(1_000_000)
        assert servo.read()["Baud Rate"] == 3  # the register has the new value; the servo answers at its old rate


def test_servo_that_answers_only_reads_can_be_changed(bench):
    bench.devices.servo.memory["Status Return Level"] = 1
    with single_servo(bench.context) as servo:
        servo.set_id(5)
    assert bench.devices.servo.memory["ID"] == 5


def test_ax_12a_is_changed_by_protocol_1(monkeypatch):
    monkeypatch.setattr("rig.doctor.single_servo.BAUD_RATES_1", (1_000_000, 115_200))  # each asks 253 ids
    with unopened("servo.model=ax_12a", "table.mode=pan", servo_at=(1, 1_000_000)) as bench:
        with single_servo(bench.context) as servo:
            assert servo.found.model == "ax_12a"
            servo.set_id(4)
            servo.set_baud(115_200)
        with single_servo(bench.context) as servo:
            assert (servo.found.bus_id, servo.found.baud) == (4, 115_200)
            assert meaning(servo.table, "Baud Rate", servo.read()["Baud Rate"]).startswith("1176")  # 2 MBd by 17


# -- meaning ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("Baud Rate", 3, "1000000 bit/s"),
        ("Return Delay Time", 250, "500 µs"),
        ("Drive Mode", 0b1101, "reversed direction, time-based profile, torque on by goal"),
        ("Operating Mode", 4, "extended position, many revolutions"),
        ("Secondary ID", 255, "off"),
        ("Homing Offset", -1024, "−90.00°"),
        ("Min Voltage Limit", 95, "9.5 V"),
        ("PWM Limit", 885, "100.0 %"),
        ("Current Limit", 1193, "3209 mA"),
        ("Shutdown", 0b110100, "overheating, electrical shock, overload"),
        ("Hardware Error Status", 0, "none"),
        ("Bus Watchdog", 25, "500 ms"),
        ("Bus Watchdog", 255, "tripped"),
        ("Profile Acceleration", 11, "236.0 °/s²"),
        ("Profile Velocity", 0, "as fast as it can"),
        ("Present Velocity", -66, "−90.68 °/s"),
        ("Present Position", 4096, "360.00°"),
        ("Present Current", -100, "−269 mA"),
        ("Present Temperature", 33, "33 °C"),
        ("Torque Enable", 1, "on"),
        ("Position P Gain", 640, ""),
    ],
)
def test_registers_have_the_units_of_the_e_manual(name, value, expected):
    assert meaning(control_table("xm430_w350"), name, value) == expected


def test_every_register_of_every_model_accepts_every_value():
    for model in (name for name in model_numbers().values() if not known_model(name).missing()):
        table = control_table(model)
        assert baud_codes(table)
        for register in table.values():
            top = 256**register.size
            for value in (0, 1, 2, top // 2 - 1, -top // 2 if register.signed else top - 1):
                assert isinstance(meaning(table, register.name, value), str)
