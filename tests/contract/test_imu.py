"""The contract of every `rig.devices.imu.Imu`; a new driver is tested by an entry in `SENSORS`."""

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass

import numpy as np
import pytest

from rig.core.clock import Clock, SystemClock
from rig.core.errors import DeviceSilent
from rig.devices.bno055 import Bno055
from rig.devices.head.samples import HeadSensor
from rig.devices.imu import Imu
from rig.devices.mpu6050 import Mpu6050, Mpu6500, Mpu9250
from sim.i2c import SimI2cBus
from sim.imu.bno055 import SimBno055
from sim.imu.inertial import SimulatedImu
from sim.imu.mpu6050 import SimMpu6050, SimMpu6500, SimMpu9250
from sim.motion import to_position, to_velocity
from sim.noise import NoiseModel
from sim.world import World
from tests.contract import heads

NIGHTLY = pytest.mark.nightly


@dataclass
class Sensor:
    """An opened IMU in its world; `unplug` pulls its cable; its z axis points up, ``latency_s`` is its filter's lag.

    ``buffer_s`` is the longest time between readings without a lost sample, ``late_s`` is longer than any of its
    buffers, and ``resolution_dps`` is the largest error of its rate without noise.
    """

    imu: Imu
    world: World
    unplug: Callable[[], None]
    latency_s: float
    buffer_s: float
    late_s: float = 60.0
    resolution_dps: float = 0.02

    @property
    def clock(self) -> Clock:
        return self.world.clock


Opened = AbstractContextManager[Sensor]


def on_i2c(
    driver: Callable[..., Imu], device: Callable[[World], SimulatedImu], address: int, latency_s: float, buffer_s: float
) -> Callable[[NoiseModel], Opened]:
    @contextmanager
    def opened(noise: NoiseModel) -> Iterator[Sensor]:
        world = World(noise=noise, seed=1)
        with SimI2cBus(world.clock) as bus:
            bus.attach(address, device(world))
            with closing(driver(bus.path, clock=world.clock, address=address)) as imu:
                yield Sensor(imu, world, lambda: bus.detach(address) and None, latency_s, buffer_s)

    return opened


DELIVERY_S = 0.015
"""Largest delay with which a sensor may deliver a sample."""
LATE_S = 4.0
"""A head's driver keeps 2 s."""


def on_head(
    kind: str, sensor: Callable[[], HeadSensor], latency_s: float, resolution_dps: float = 0.02
) -> Callable[[NoiseModel], Opened]:
    @contextmanager
    def opened(noise: NoiseModel) -> Iterator[Sensor]:
        with heads.opened_head(kind, noise, sensor=sensor) as h:
            yield Sensor(h.imu, h.world, h.unplug, latency_s, 0.3, LATE_S, resolution_dps)

    return opened


@contextmanager
def pseudo_terminal(noise: NoiseModel) -> Iterator[Sensor]:
    with heads.head_on_a_pty(noise) as h:
        yield Sensor(h.imu, h.world, h.unplug, 0.007, 0.3, LATE_S)


class FileSensor(Sensor):
    """An IMU at a device file; its world is in another program."""

    @property
    def clock(self) -> Clock:
        return SystemClock()


@contextmanager
def device_file(noise: NoiseModel) -> Iterator[Sensor]:
    """Open an MPU-6050 with few samples, for an emulated computer."""
    path = os.environ.get("RIG_TEST_I2C", "")
    if not path:
        pytest.skip("`make kernel-test` gives it a device file")
    with closing(Mpu6050(path, clock=SystemClock(), rate_hz=10.0, bandwidth_hz=5)) as imu:
        yield FileSensor(imu, World(), lambda: None, 0.1, 1.0)


SENSORS: dict[str, Callable[[NoiseModel], Opened]] = {
    "mpu6050": on_i2c(Mpu6050, SimMpu6050, 0x68, 0.005, 0.3),
    "mpu6500": on_i2c(Mpu6500, SimMpu6500, 0x68, 0.005, 0.3),
    "mpu9250": on_i2c(Mpu9250, SimMpu9250, 0x68, 0.005, 0.3),
    "bno055": on_i2c(Bno055, SimBno055, 0x28, 0.02, 0.01),
    "device-file": device_file,
    "head": on_head("memory", heads.mpu6050, 0.007),
    "head-mpu6500": on_head("memory", heads.mpu6500, 0.007),
    "head-bno055": on_head("memory", heads.bno055, 0.02, resolution_dps=1 / 16),
    "head-avr": on_head("avr", heads.mpu6050, 0.007),
    "head-pty": pseudo_terminal,
}


MARKS = {"device-file": pytest.mark.kernel, "head-avr": NIGHTLY}


@pytest.fixture(params=[pytest.param(name, marks=MARKS.get(name, ())) for name in SENSORS])
def open_sensor(request: pytest.FixtureRequest) -> Callable[[NoiseModel], Opened]:
    return SENSORS[request.param]


@pytest.fixture
def sensor(open_sensor: Callable[[NoiseModel], Opened]) -> Iterator[Sensor]:
    with open_sensor(NoiseModel.none()) as s:
        yield s


def spin(world: World, dps: float) -> None:
    world.drive(to_velocity(world.clock.now_ns() * 1e-9, world.table_deg(), dps, dps, 1.0))


def test_samples_come_once_in_order_at_the_rate_of_the_identity(sensor: Sensor) -> None:
    assert sensor.imu.identity.model
    assert 0 < sensor.imu.identity.gyro_noise_dps_rthz < 0.1
    assert sensor.imu.range_dps >= 125
    sensor.imu.read_samples()
    start_ns = sensor.clock.now_ns()
    parts = []
    for pause_s in (0.0, 0.001, 0.3, 0.02, 0.1, 0.25):
        sensor.clock.sleep(pause_s)
        parts.append(sensor.imu.read_samples())
    time_ns = np.concatenate([p.time_ns for p in parts])
    assert all(p.gyro_dps.shape == (p.time_ns.size, 3) and p.lost == 0 for p in parts)
    assert all(p.time_ns.dtype == np.int64 and p.gyro_dps.dtype == np.float64 for p in parts)
    assert all(np.diff(time_ns) > 0)
    assert all(time_ns <= sensor.clock.now_ns())
    elapsed_s = (sensor.clock.now_ns() - start_ns) * 1e-9
    assert time_ns.size == pytest.approx(elapsed_s * sensor.imu.rate_hz, abs=DELIVERY_S * sensor.imu.rate_hz + 1)


@pytest.mark.parametrize("dps", [-100.0, 20.0, *(pytest.param(dps, marks=NIGHTLY) for dps in (-1.0, 0.0, 100.0))])
def test_counter_clockwise_is_positive(sensor: Sensor, dps: float) -> None:
    spin(sensor.world, dps)
    sensor.clock.sleep(0.1)
    sensor.imu.read_samples()
    start_ns = sensor.clock.now_ns()
    sensor.clock.sleep(0.2)
    rates = sensor.imu.read_samples().gyro_dps
    elapsed_s = (sensor.clock.now_ns() - start_ns) * 1e-9
    assert len(rates) == pytest.approx(elapsed_s * sensor.imu.rate_hz, abs=DELIVERY_S * sensor.imu.rate_hz + 1)
    assert rates == pytest.approx(np.tile([0, 0, dps], (len(rates), 1)), abs=sensor.resolution_dps)


@pytest.mark.parametrize("angle_deg", [-90.0, *(pytest.param(angle, marks=NIGHTLY) for angle in (5.0, 37.0, 180.0))])
def test_integral_between_two_rests_is_the_rotation(sensor: Sensor, angle_deg: float) -> None:
    sensor.imu.read_samples()
    sensor.world.drive(to_position(sensor.clock.now_ns() * 1e-9, 0.0, 0.0, angle_deg, 90.0, 300.0))
    rotated = 0.0
    for _ in range(30):
        sensor.clock.sleep(0.1)
        samples = sensor.imu.read_samples()
        assert samples.lost == 0
        rotated += samples.gyro_dps[:, 2].sum() / sensor.imu.rate_hz
    assert rotated == pytest.approx(angle_deg, abs=0.02)


def test_sample_times_are_those_of_the_rotation(sensor: Sensor) -> None:
    sensor.imu.read_samples()
    sensor.clock.sleep(0.1)
    begun_ns = sensor.clock.now_ns()
    spin(sensor.world, 50.0)
    sensor.clock.sleep(0.1)
    samples = sensor.imu.read_samples()
    first = samples.time_ns[np.argmax(samples.gyro_dps[:, 2] > 25.0)]
    assert 0 <= (first - begun_ns) * 1e-9 + 1 / sensor.imu.rate_hz <= sensor.latency_s + 2 / sensor.imu.rate_hz


def test_late_read_reports_lost_samples(sensor: Sensor) -> None:
    sensor.imu.read_samples()
    start_ns = sensor.clock.now_ns()
    sensor.clock.sleep(sensor.late_s)
    late = sensor.imu.read_samples()
    elapsed_s = (sensor.clock.now_ns() - start_ns) * 1e-9
    assert late.lost > 0
    assert late.lost + late.time_ns.size == pytest.approx(
        elapsed_s * sensor.imu.rate_hz, rel=0.02, abs=DELIVERY_S * sensor.imu.rate_hz + 1
    )
    sensor.clock.sleep(0.1)
    assert sensor.imu.read_samples().lost == 0


def test_gravity_points_up_with_its_norm(sensor: Sensor) -> None:
    sensor.clock.sleep(0.1)
    assert sensor.imu.read_gravity_g() == pytest.approx([0, 0, 1], abs=0.01)
    assert 10 < sensor.imu.temperature_c() < 50


def test_noise_is_below_the_density_of_the_identity(
    open_sensor: Callable[[NoiseModel], Opened],
) -> None:
    with open_sensor(NoiseModel()) as sensor:
        rates = []
        for _ in range(round(3.0 / sensor.buffer_s)):
            sensor.clock.sleep(sensor.buffer_s)
            rates.append(sensor.imu.read_samples().gyro_dps)
        sigma = np.concatenate(rates).std(axis=0)
        white = sensor.imu.identity.gyro_noise_dps_rthz * np.sqrt(sensor.imu.rate_hz / 2)
        assert all(sigma > 0.3 * white)
        assert all(sigma < 1.3 * white)


def test_pulled_cable_is_an_error_and_closing_twice_is_harmless(sensor: Sensor) -> None:
    sensor.unplug()
    for reading in (sensor.imu.read_samples, sensor.imu.read_gravity_g, sensor.imu.temperature_c):
        with pytest.raises(DeviceSilent) as caught:
            reading()
        assert caught.value.next_step
    sensor.imu.close()
    sensor.imu.close()
