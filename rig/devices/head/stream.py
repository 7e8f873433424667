"""The samples that a rig head sends, until a reader takes them."""

from collections import deque
from dataclasses import dataclass
from math import hypot, sqrt

import numpy as np

from rig.core.clock import Clock, seconds_between
from rig.devices.head.protocol import Sample, SampleFlag
from rig.devices.head.sensors import HeadSensor
from rig.devices.head.timing import HeadClock
from rig.devices.imu import ImuSamples

MEMORY_S = 2.0
"""Time for which samples are kept for a reader; older ones are lost."""


@dataclass(slots=True)
class HeadStatistics:
    """Counts since the head was opened.

    ``lost`` are samples that never reached a reader, ``dropped`` those of them for which the head had no room.
    """

    lost: int = 0
    dropped: int = 0
    reconnects: int = 0
    restarts: int = 0


class SampleStream:
    """Buffers samples, counts the missing ones, and dates them on the bench's clock."""

    def __init__(self, sensor: HeadSensor, clock: Clock, timing: HeadClock, statistics: HeadStatistics) -> None:
        self.newest: Sample | None = None
        self.newest_ns = clock.now_ns()
        """When the newest sample arrived, on the bench's clock."""
        self._sensor = sensor
        self._clock = clock
        self._timing = timing
        self._statistics = statistics
        self._samples: deque[tuple[int, Sample]] = deque(maxlen=round(MEMORY_S * sensor.rate_hz))
        self._next_index: int | None = None
        self._lost = 0

    def restart(self) -> None:
        """Drop the samples that are dated by a clock that no longer runs."""
        self._miss(len(self._samples))
        self._samples.clear()
        self._next_index = None

    def add(self, sample: Sample) -> None:
        """Add a sample that arrived, and count those that are missing before it."""
        time_us = self._timing.unwrap(sample.time_us)
        if self._next_index is not None:
            self._miss((sample.index - self._next_index) % (1 << 16))
        elif self.newest is not None:  # the first sample after a restart of the head or of the connection
            gap_s = seconds_between(self.newest_ns, self._clock.now_ns())
            self._miss(max(round(gap_s * self._sensor.rate_hz) - 1, 1))
        if len(self._samples) == self._samples.maxlen:
            self._miss(1)
        self._samples.append((time_us, sample))
        if self.newest is not None and self._next_index is not None:
            self._statistics.dropped += (sample.dropped - self.newest.dropped) % 256
        self._next_index = (sample.index + 1) % (1 << 16)
        self.newest, self.newest_ns = sample, self._clock.now_ns()

    def take(self) -> ImuSamples:
        """Return the samples since the last call."""
        taken = list(self._samples)
        self._samples.clear()
        lost, self._lost = self._lost, 0
        time_ns, sigma_ns = self._timing.to_host(np.array([time_us for time_us, _ in taken], np.int64))
        gyro = np.array([(s.gyro_x, s.gyro_y, s.gyro_z) for _, s in taken], float).reshape(-1, 3)
        if not all(s.flags & SampleFlag.EDGE for _, s in taken):
            # The head polled the sensor: the sample may be from any time within a period.
            sigma_ns = hypot(sigma_ns, 1e9 / self._sensor.rate_hz / sqrt(12))
        return ImuSamples(time_ns, gyro / self._sensor.lsb_per_dps, lost, round(sigma_ns))

    def _miss(self, count: int) -> None:
        self._lost += count
        self._statistics.lost += count
