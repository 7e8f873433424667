"""A long stream: no sample is lost, and each sample has the right time, compared with its true number."""

import struct

import numpy as np
import pytest
from hypothesis import settings

from rig.devices.head.head import RigHead
from sim.head.board import SimHead
from sim.head.serial_port import HeadSerial
from sim.noise import NoiseModel
from sim.world import World
from tests.contract.heads import head_of, mpu6050

MINUTES, RATE_HZ = 10, 200
INT_ENABLE, USER_CTRL, PWR_MGMT_1, FIFO_COUNTH, FIFO_R_W, WHO_AM_I = 0x38, 0x6A, 0x6B, 0x72, 0x74, 0x75
FRAME = struct.Struct(">7h")


class CountingSensor:
    """The parts of an MPU-6050 that a head uses; gyro x and y of each sample are its number."""

    def __init__(self, head: SimHead, error: float) -> None:
        self._head = head
        self._registers = bytearray(128)
        self._registers[PWR_MGMT_1] = 0x40
        self._pointer, self._pointed = 0, True
        self.period_ns = round(1e9 / RATE_HZ / (1 + error))
        self.epoch_ns = self._read = 0
        self._rest = b""

    def _taken(self) -> int:
        return (self._head.now_ns - self.epoch_ns) // self.period_ns

    def next_edge_ns(self, after_ns: int) -> int | None:
        if not self._registers[INT_ENABLE] & 1:
            return None
        return self.epoch_ns + max((after_ns - self.epoch_ns) // self.period_ns + 1, 1) * self.period_ns

    def start(self, reading: bool) -> None:
        self._pointed = reading

    def stop(self) -> None: ...

    def write(self, data: bytes) -> int:
        for byte in data:
            if not self._pointed:
                self._pointer, self._pointed = byte, True
                continue
            self._registers[self._pointer] = byte
            if self._pointer == PWR_MGMT_1:
                self.epoch_ns = self._head.now_ns
            if self._pointer == USER_CTRL and byte & 0x04:
                self._read = self._taken()
            self._pointer += 1
        return len(data)

    def read(self, count: int) -> bytes:
        if self._pointer == FIFO_R_W:
            while len(self._rest) < count:
                self._read += 1
                self._rest += FRAME.pack(0, 0, 16384, 0, self._read & 0x7FFF, self._read >> 15, 0)
            answer, self._rest = self._rest[:count], self._rest[count:]
            return answer
        if self._pointer == FIFO_COUNTH:
            self._registers[FIFO_COUNTH : FIFO_COUNTH + 2] = (14 * (self._taken() - self._read)).to_bytes(2, "big")
        if self._pointer == WHO_AM_I:
            return b"\x68"
        answer = bytes(self._registers[self._pointer : self._pointer + count])
        self._pointer += count
        return answer


def stream(kind: str, seconds: float, error: float = 0.01) -> tuple[int, int, float]:
    """Return how many samples came, how many did not, and the largest error of a date (ns).

    ``error`` is that of the sensor's rate; the product specification allows 1 %.
    """
    world = World(noise=NoiseModel.none())
    head = head_of(kind, world, clock_error=-2.5e-3)
    sensor = CountingSensor(head, error)
    head.attach(0x68, sensor)
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
    return number.size, lost, float(np.abs(time_ns - (sensor.epoch_ns + number * sensor.period_ns)).max())


@pytest.mark.timeout(300)
@pytest.mark.parametrize("minutes", [0.5, pytest.param(MINUTES, marks=pytest.mark.nightly)])
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
