"""The rig head's driver on the firmware itself: opening, outputs, and safety functions."""

from pkgutil import resolve_name

import pytest

from rig.config import ImuConfig, load_config
from rig.core.errors import (
    ConfigError,
    DeviceMismatch,
    DeviceNotFound,
    DeviceSilent,
    EmergencyStop,
    FirmwareMismatch,
    HeadRestarted,
    HeartbeatLost,
    RequestRejected,
)
from rig.core.next_steps import Do
from rig.devices.head.head import RigHead
from rig.devices.head.protocol import (
    DEADMAN_MAX_MS,
    DEADMAN_MIN_MS,
    PROTOCOL_VERSION,
    HeadFault,
    HeadState,
    Reset,
)
from rig.devices.head.samples import head_sensor
from rig.devices.mpu6050 import DRIVERS
from sim.clock import VirtualClock
from sim.head.serial_port import HeadSerial
from sim.imu.mpu6050 import SimMpu6050
from sim.noise import NoiseModel
from tests.contract.heads import AVR_NIGHTLY, mpu6050, opened_head, simulated_head, switch_on
from tests.rig.devices.scripted_serial import ScriptedSerial

MS = 1_000_000


# -- opening -----------------------------------------------------------------------------------------------------


def test_opening_reads_the_identity_and_leaves_outputs_off(opened, request):
    who = opened.imu.identity
    assert (who.model, who.who_am_i, who.bus_address) == ("MPU-6050", 0x68, 0x68)
    board = {"memory": "host", "avr": "atmega328p"}[request.node.callspec.params["opened"]]
    assert (who.board, who.protocol, who.serial) == (board, PROTOCOL_VERSION, 1)
    assert not opened.head.relay_closed
    assert opened.head.light == 0
    assert opened.imu.fault is None


@pytest.mark.parametrize(
    ("ours", "step"), [(PROTOCOL_VERSION + 1, "make -C firmware flash"), (PROTOCOL_VERSION - 1, "Update")]
)
def test_version_mismatch_names_the_side_to_update(monkeypatch, ours, step):
    monkeypatch.setattr("rig.devices.head.link.PROTOCOL_VERSION", ours)
    with simulated_head() as (head, world), pytest.raises(FirmwareMismatch) as caught:
        RigHead(HeadSerial(head), world.clock, mpu6050())
    assert step in caught.value.next_step
    assert (caught.value.evidence["head"], caught.value.evidence["program"]) == (PROTOCOL_VERSION, ours)


def test_port_without_head_raises_device_not_found():
    clock = VirtualClock()
    with pytest.raises(DeviceNotFound) as caught:
        RigHead(ScriptedSerial(clock, ()), clock, mpu6050(), name="/dev/ttyUSB7")
    assert "PORT=/dev/ttyUSB7" in caught.value.next_step
    assert clock.now_ns() < 4e9


def test_opening_waits_for_a_slow_board():
    with simulated_head(noise=NoiseModel.none()) as (head, world):
        head.attach(0x68, SimMpu6050(head.world_at_board_time))
        wire = HeadSerial(head)
        starts_ns = world.clock.now_ns() + 1_700 * MS  # the boot loader of an Arduino whose port was opened
        head.filters.append(lambda _to_head, byte: byte if world.clock.now_ns() > starts_ns else None)
        imu = RigHead(wire, world.clock, mpu6050())
        assert world.clock.now_ns() > starts_ns
        imu.close()


def test_missing_or_wrong_sensor_is_reported():
    with simulated_head() as (head, world):
        with pytest.raises(DeviceSilent, match="does not answer") as caught:
            RigHead(HeadSerial(head), world.clock, mpu6050())
        assert caught.value.evidence["imu_status"] == "absent"
        head.attach(0x68, SimMpu6050(head.world_at_board_time, who_am_i=0x70))
        with pytest.raises(DeviceMismatch, match=r"0x70, expected 0x68.*MPU-6500") as caught:
            RigHead(HeadSerial(head), world.clock, mpu6050())
        assert caught.value.steps == (Do.SET_KEY(key="imu.model", value="mpu6500"),)
        head.detach(0x68)
        head.attach(0x68, clock_chip := SimMpu6050(head.world_at_board_time, who_am_i=0x00))
        with pytest.raises(DeviceMismatch, match=r"0x00, expected 0x68 .*no device"):
            RigHead(HeadSerial(head), world.clock, mpu6050())
        assert clock_chip._registers[0x6B] == 0x40  # nothing was written to it


def sensor_of(model):
    return lambda: head_sensor(ImuConfig(model=model))


@pytest.mark.parametrize(
    ("driver", "who_am_i"), [(driver, one) for driver in DRIVERS.values() for one in driver.KIND.identities]
)
def test_every_sensor_of_a_driver_is_known_to_the_firmware_and_has_its_own_scale(driver, who_am_i):
    kind = driver.KIND
    with simulated_head() as (head, world):
        sensor = resolve_name(kind.simulator)(head.world_at_board_time, who_am_i=who_am_i)
        head.attach(0x68, sensor)
        imu = RigHead(HeadSerial(head), world.clock, sensor_of(kind.key)())
        who = imu.identity
        assert (who.model, who.who_am_i, who.gyro_noise_dps_rthz) == (kind.name, who_am_i, driver.NOISE_DPS_RTHZ)
        sensor.temperature_c = 31.5
        world.clock.sleep(0.1)
        assert imu.temperature_c() == pytest.approx(31.5, abs=0.01)
        imu.close()


def test_only_deadmen_of_the_head_can_be_configured():
    shortest_s, longest_s = DEADMAN_MIN_MS / 1000, DEADMAN_MAX_MS / 1000
    for seconds in (shortest_s, longest_s):
        assert load_config(None, [f"head.deadman_s={seconds}"]).head.deadman_s == seconds
    for seconds in (0.99 * shortest_s, 1.01 * longest_s):
        with pytest.raises(ConfigError):
            load_config(None, [f"head.deadman_s={seconds}"])


# -- outputs -----------------------------------------------------------------------------------------------------


@AVR_NIGHTLY
def test_light_and_power_follow_requests(opened):
    switch_on(opened)
    opened.imu.set_light(0.2)
    opened.clock.sleep(5.0)  # heartbeats are sent in the background
    assert opened.head.light == pytest.approx(0.2, abs=0.005)
    assert opened.head.relay_closed
    assert opened.imu.status.state is HeadState.ACTIVE
    opened.imu.close()
    assert not opened.head.relay_closed
    assert opened.head.light == 0


# -- safety functions -----------------------------------------------------------------------------------------------


def test_silent_computer_switches_outputs_off(opened):
    switch_on(opened)
    opened.imu._cancel()  # the program is killed: no more heartbeats
    last_ns = opened.clock.now_ns()
    opened.clock.sleep(1.0)
    for pin in ("relay", "light"):
        time_ns, value = opened.head.pulses(pin)[-1]
        assert value == 0
        assert time_ns - last_ns <= 255 * MS
    with pytest.raises(HeartbeatLost) as caught:
        opened.imu.check()
    assert caught.value.exit_code == 5
    assert Do.ACKNOWLEDGE() in caught.value.steps
    with pytest.raises(RequestRejected, match="fault is latched"):
        opened.imu.set_power(True)
    opened.imu.acknowledge()
    assert opened.imu.fault is None
    assert not opened.head.relay_closed  # the head never closes the relay by itself
    opened.imu.set_power(True)
    assert opened.head.relay_closed


@pytest.mark.parametrize("deadman_s", [0.25, *(pytest.param(one, marks=pytest.mark.nightly) for one in (0.05, 2.0))])
def test_deadman_has_the_configured_duration(deadman_s):
    with opened_head(noise=NoiseModel.none(), deadman_s=deadman_s) as h:
        h.imu.set_power(True)
        h.imu._cancel()
        last_ns = h.imu._heartbeat_ns
        h.clock.sleep(3.0)
        silent_s = (h.head.pulses("relay")[-1][0] - last_ns) * 1e-9
        assert deadman_s * 0.99 - 0.002 <= silent_s <= deadman_s * 1.01 + 0.001


def test_estop_acts_within_a_millisecond_without_the_computer(opened):
    switch_on(opened)
    opened.clock.sleep(0.1)
    opened.imu._cancel()
    opened.head.estop_open = True
    pressed_ns = opened.clock.now_ns()
    opened.clock.sleep(0.05)
    assert opened.head.pulses("relay")[-1][0] - pressed_ns <= 1.01 * MS
    with pytest.raises(EmergencyStop, match="e-stop"):
        opened.imu.check()
    assert opened.imu.status.faults == HeadFault.ESTOP
    assert opened.imu.fault.evidence["faults"] == "ESTOP"
    with pytest.raises(EmergencyStop):
        opened.imu.acknowledge()
    opened.head.estop_open = False
    opened.clock.sleep(0.05)
    with pytest.raises(EmergencyStop):
        opened.imu.check()  # released, but not acknowledged yet
    opened.imu.acknowledge()
    opened.imu.check()
    assert not opened.head.relay_closed


@AVR_NIGHTLY
def test_restarted_head_reports_it_and_continues_to_measure(opened):
    switch_on(opened)
    opened.clock.sleep(0.5)
    opened.imu.read_samples()
    opened.head.reset(Reset.BROWN_OUT)
    assert not opened.head.relay_closed
    opened.clock.sleep(1.0)
    assert opened.imu.read_samples().lost > 0
    with pytest.raises(HeadRestarted, match="brown-out"):
        opened.imu.check()
    opened.clock.sleep(0.5)
    samples = opened.imu.read_samples()
    assert samples.lost == 0
    assert len(samples.time_ns) == pytest.approx(100, abs=5)
    assert opened.imu.statistics.restarts == 1
    assert opened.head.light == 0
    opened.imu.acknowledge()
    assert opened.imu.fault is None


def test_hanging_firmware_is_restarted_by_its_watchdog(opened):
    switch_on(opened)
    opened.head.hang()
    opened.clock.sleep(1.0)
    assert opened.head.resets == [Reset.WATCHDOG]
    assert not opened.head.relay_closed
    with pytest.raises(HeadRestarted, match="hung"):
        opened.imu.check()


def test_outputs_and_faults_do_not_depend_on_the_sensor(opened):
    opened.head.detach(0x68)
    opened.clock.sleep(2.0)
    with pytest.raises(DeviceSilent):
        opened.imu.read_samples()
    opened.imu.set_power(True)
    opened.head.estop_open = True
    opened.clock.sleep(0.1)
    with pytest.raises(EmergencyStop):
        opened.imu.check()
    opened.head.estop_open = False
    opened.clock.sleep(0.1)
    opened.imu.acknowledge()
