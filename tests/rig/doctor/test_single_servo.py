"""Change of id and baud rate: only on a single servo, with its torque off, and verified."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.config.servos import known_model, model_numbers
from rig.core.errors import BenchBusy, DeviceMismatch, DeviceNotFound, RequestRejected, SeveralServos, UsageError
from rig.devices.dynamixel.registers import control_table
from rig.doctor.servo_scan import baud_codes, single_servo
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


def test_missing_servo_unknown_model_and_busy_bench_are_errors():
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


def test_rate_that_the_adapter_lacks_is_rejected_before_writing():
    with unopened() as bench, single_servo(bench.context) as servo:

        class Slow(type(servo._wire)):
            def __setattr__(self, name, value):
                if name == "baudrate" and value > 1_000_000:
                    raise ValueError(value)
                super().__setattr__(name, value)

        servo._wire.__class__ = Slow
        with pytest.raises(UsageError, match="adapter has no baud rate 4500000"):
            servo.set_baud(4_500_000)
        assert WRITE not in bench.instructions


def test_invalid_rate_is_rejected_before_writing():
    with unopened() as bench, single_servo(bench.context) as servo:
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
        assert (
            servo.bus.read_table(servo.found.bus_id, servo.table)["Baud Rate"] == 3
        )  # the register has the new value; the servo answers at its old rate


def test_servo_that_answers_only_reads_can_be_changed(bench):
    bench.devices.servo.memory["Status Return Level"] = 1
    with single_servo(bench.context) as servo:
        servo.set_id(5)
    assert bench.devices.servo.memory["ID"] == 5


def test_every_driven_model_has_baud_rates():
    for model in (name for name in model_numbers().values() if not known_model(name).missing()):
        assert baud_codes(control_table(model))
