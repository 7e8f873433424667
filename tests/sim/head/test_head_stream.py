"""A long stream: no sample is lost, and each sample has the right time, compared with its true number."""

import numpy as np
import pytest
from hypothesis import settings
from numpy.typing import NDArray

from rig.devices.head.head import RigHead
from sim.head.serial_port import HeadSerial
from sim.imu.inertial import Words
from sim.imu.mpu6050 import SMPLRT_DIV, SimMpu6050
from sim.motion import Floats
from sim.noise import NoiseModel
from sim.world import World
from tests.contract.heads import head_of, mpu6050

MINUTES, RATE_HZ = 10, 200


class CountingSensor(SimMpu6050):
    """An MPU-6050 whose gyro x and y of each sample are its number since the last change of its settings."""

    def _quantised(self, gyro: Floats, accel: Floats, die_c: Floats) -> Words:
        words = np.zeros((len(gyro), 7), ">i2")
        numbers = np.arange(self._taken - len(gyro) + 1, self._taken + 1)
        words[:, 2], words[:, 4], words[:, 5] = 16384, numbers & 0x7FFF, numbers >> 15
        return words

    def time_ns(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return when samples were taken."""
        return self._epoch_ns + numbers * (self._internal_clock()[1] * (1 + self._registers[SMPLRT_DIV]))


def stream(kind: str, seconds: float, error: float = 0.01) -> tuple[int, int, float]:
    """Return how many samples came, how many did not, and the largest error of a date (ns).

    ``error`` is that of the sensor's rate; the product specification allows 1 %.
    """
    world = World(noise=NoiseModel.none())
    head = head_of(kind, world, clock_error=-2.5e-3)
    sensor = CountingSensor(head.world_at_board_time)
    sensor.clock_error = error
    head.attach(sensor.address, sensor)
    imu = RigHead(HeadSerial(head), world.clock, mpu6050())
    numbers, times, lost = [], [], 0
    end_ns = world.clock.now_ns() + round(seconds * 1e9)
    while world.clock.now_ns() < end_ns:
        world.clock.sleep(0.25)
        samples = imu.read_samples()
        counts = np.rint(samples.gyro_dps * 131.0).astype(np.int64)
        numbers.append(counts[:, 0] + (counts[:, 1] << 15))
        times.append(samples.time_ns)
        lost += samples.lost
    imu.close()
    head.close()
    number, time_ns = np.concatenate(numbers), np.concatenate(times)
    assert np.array_equal(number, np.arange(number[0], number[0] + number.size))  # none missing, none twice
    assert all(np.diff(time_ns) > 0)
    return number.size, lost, float(np.abs(time_ns - sensor.time_ns(number)).max())


@pytest.mark.timeout(300)
@pytest.mark.parametrize("minutes", [0.3, pytest.param(MINUTES, marks=pytest.mark.nightly)])
def test_stream_at_200_hz_loses_nothing_and_is_dated_within_100_us(minutes):
    count, lost, error_ns = stream("memory", minutes * 60)
    assert lost == 0
    assert count == pytest.approx(minutes * 60 * RATE_HZ * 1.01, rel=1e-3)
    assert error_ns < 100_000


@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    "error", [0.01, -0.008]
)  # with -0.008, one of the first edges arrives as the core falls asleep
def test_binary_dates_its_samples_within_100_us(error):
    nightly = settings.get_current_profile_name() == "nightly"
    _, lost, error_ns = stream("avr", MINUTES * 60 if nightly else 3, error)
    assert lost == 0
    assert error_ns < 100_000
