"""The servo drivers on every simulated model: as a turntable, behind a gear, and as an arm."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.config import load_config
from rig.core.errors import DeviceMismatch, DeviceSilent, RequestRejected
from rig.devices.dynamixel import settings as permanent
from rig.devices.dynamixel.servo import DynamixelServo, open_servo
from rig.devices.dynamixel.settings import SettingDifference
from rig.devices.servo import MotionProfile
from sim.devices import SimDevices
from sim.noise import NoiseModel
from sim.servo.models import MODELS
from sim.world import World
from tests.fuzzing import examples


def parts_of(*overrides: str, noise: NoiseModel | None = None) -> SimDevices:
    """Return simulated devices with the IMU's bus closed: only the servo is used."""
    with SimDevices.connected(load_config(None, overrides), World(noise=noise or NoiseModel.none())) as devices:
        return devices


def servo_of(devices: SimDevices, *overrides: str, write: bool = True) -> DynamixelServo:
    config = load_config(None, overrides)
    servo = open_servo(devices.adapter, config.servo, devices.world.clock, config.table.mode)
    if write:
        servo.prepare(write=True)
    return servo


def go(devices: SimDevices, servo: DynamixelServo, angle_deg: float) -> float:
    """Move to ``angle_deg`` and return the true rotation of the table's shaft."""
    start_deg = devices.world.shaft()[0]
    servo.set_profile(MotionProfile(90.0, 500.0))
    servo.torque_on()
    servo.move_to(angle_deg)
    devices.world.clock.sleep(8.0)
    return devices.world.shaft()[0] - start_deg


@pytest.fixture
def devices() -> SimDevices:
    return parts_of()


# -- the models --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", MODELS)
def test_load_is_a_percentage_for_each_model(model: str) -> None:
    chosen = f"servo.model={model}"
    devices = parts_of(chosen)
    servo = servo_of(devices, chosen)
    servo.set_profile(MotionProfile(90.0, 500.0))
    servo.torque_on()
    devices.servo.jam()
    servo.move_to(servo.read_state().position_deg - 90.0)
    devices.world.clock.sleep(1.0)
    assert -101 <= servo.read_state().load_percent < -60


# -- gear and pan ------------------------------------------------------------------------------------------------------


@examples(6)
@given(ratio=st.floats(0.3, 12.0), angle_deg=st.floats(20.0, 300.0), sign=st.sampled_from([1, -1]))
def test_gear_converts_angles_and_rates_to_the_table(ratio: float, angle_deg: float, sign: int) -> None:
    angle_deg *= sign
    chosen = f"servo.gear_ratio={ratio}"
    devices = parts_of(chosen)
    servo = servo_of(devices, chosen)
    start_deg = servo.read_state().position_deg
    profile = servo.set_profile(MotionProfile(20.0, 100.0))
    assert profile.velocity_dps == pytest.approx(20.0, rel=0.1)
    servo.torque_on()
    servo.move_to(start_deg + angle_deg)
    devices.world.clock.sleep(0.6)
    assert servo.read_state().velocity_dps == pytest.approx(sign * profile.velocity_dps, abs=1.4 / ratio)
    assert devices.world.shaft()[1] == pytest.approx(sign * profile.velocity_dps, abs=1.4 / ratio)
    devices.world.clock.sleep(20.0)
    assert devices.world.shaft()[0] == pytest.approx(angle_deg, abs=servo.resolution_deg)
    assert servo.read_state().position_deg - start_deg == pytest.approx(angle_deg, abs=1.01 * servo.resolution_deg)


def test_pan_servo_stays_within_one_revolution() -> None:
    chosen = ("table.mode=pan", "table.limits_deg=[-170, 170]")
    devices = parts_of(*chosen)
    servo = servo_of(devices, *chosen)
    assert devices.servo.memory["Operating Mode"] == 3
    assert servo.reach_deg == pytest.approx((0.0, 359.9), abs=0.1)
    assert go(devices, servo, 10.0) == pytest.approx(-170.0, abs=0.1)
    with pytest.raises(RequestRejected, match="data limit"):
        servo.move_to(400.0)


@pytest.mark.parametrize(("carries", "sign"), [("object", -1), ("camera", 1)])
def test_sign_of_the_orientation_depends_on_what_the_servo_rotates(carries: str, sign: int) -> None:
    assert load_config(None, [f"table.carries={carries}"]).table.orientation_sign == sign


# -- permanent settings ------------------------------------------------------------------------------------------------

WRONG = {
    "Drive Mode": 0b1101,
    "Operating Mode": 1,
    "Homing Offset": -300,
    "Return Delay Time": 20,
    "Secondary ID": 7,
    "Startup Configuration": 1,
    "Shutdown": 0,
}


def test_wrong_settings_are_found_explained_written_and_verified(devices: SimDevices) -> None:
    servo = servo_of(devices, write=False)
    for name, value in WRONG.items():
        devices.servo.memory[name] = value
    differences = servo.setting_differences()
    assert {d.register: d.found for d in differences} == WRONG
    assert all(d.reason and str(d).startswith(f"{d.register}: {d.found} → {d.wanted} (") for d in differences)
    before = {name: devices.servo.memory[name] for name in WRONG}
    with pytest.raises(DeviceMismatch, match="7 EEPROM settings"):
        servo.prepare(write=False)
    assert {name: devices.servo.memory[name] for name in WRONG} == before  # nothing without a confirmation
    permanent.write(servo.bus, 1, servo._table, differences)
    assert servo.setting_differences() == []
    assert devices.servo.memory["Shutdown"] == 52


def test_settings_are_written_with_torque_off_and_without_write_replies(devices: SimDevices) -> None:
    servo = servo_of(devices, write=False)
    servo.torque_on()
    devices.servo.memory["Status Return Level"] = 1
    servo.prepare(write=True)
    assert (devices.servo.memory["Torque Enable"], devices.servo.memory["Status Return Level"]) == (0, 2)
    assert servo.setting_differences() == []


def test_servo_that_answers_only_pings_is_reported(devices: SimDevices) -> None:
    devices.servo.memory["Status Return Level"] = 0
    with pytest.raises(DeviceSilent) as caught:
        servo_of(devices, write=False)
    assert "Status Return Level" in caught.value.__notes__[0]


def test_setting_that_is_not_stored_is_reported(devices: SimDevices) -> None:
    servo = servo_of(devices, write=False)
    devices.servo._on_write["Homing Offset"] = lambda: devices.servo.memory.__setitem__("Homing Offset", 5)
    with pytest.raises(RequestRejected, match="Homing Offset") as caught:
        permanent.write(servo.bus, 1, servo._table, [SettingDifference("Homing Offset", 5, 0, "")])
    assert caught.value.evidence == {"register": "Homing Offset", "wrote": 0, "read_back": 5}


def test_pan_servo_needs_the_position_mode(devices: SimDevices) -> None:
    servo = servo_of(devices, write=False)
    found = {d.register: d.wanted for d in permanent.compare(servo.bus, 1, servo._table, "pan")}
    assert "Operating Mode" not in found  # the factory's
