"""The samples that a rig head sends: the scales of its sensor, its clock, and the samples until a reader takes them.

The head dates its samples by its own clock. A heartbeat leaves the computer at t0 and is received by the head at u1.
The reply leaves the head at u2 and arrives at t3. Both frames have the same length. If the delays are equal in both
directions, the head's time u = (u1 + u2)/2 is the bench's time t = (t0 + t3)/2. The error is at most half of the time
by which the round trip d = (t3 − t0) − (u2 − u1) exceeds the transmission time of the bytes. Delayed heartbeats have
less weight. The drift of a ceramic resonator is up to 0.5 %.

Decision: docs/decisions/0005.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from math import hypot, sqrt

import numpy as np
from numpy.typing import NDArray

from rig.config import ImuConfig
from rig.config.imus import ImuKind
from rig.core.clock import Clock, seconds_between
from rig.core.errors import ConfigError
from rig.devices import bno055, mpu6050
from rig.devices.head.link import HeadStatistics
from rig.devices.head.protocol import ImuModel, Sample, SetImu
from rig.devices.imu import ImuSamples

MEMORY_S = 2.0  # a reader that pauses for longer reports lost samples
"""Time for which samples are kept for a reader; older ones are lost."""
DRIFT_SIGMA = 3e-3  # a ceramic resonator has 0.5 %, a crystal far less
"""Standard uncertainty of the drift before it is measured."""
STEP_SIGMA_NS = 4_000.0
"""Uncertainty of one heartbeat without delay: the head's clock has steps of 1 µs, on some boards 4 µs."""
ROUND_TRIPS = 48
"""Heartbeats that the estimate uses: a few seconds, in which the temperature of a resonator is constant."""
BAUD_TOLERANCE = 0.95
"""The baud rates at the two ends of a working connection differ by up to 5 %."""
_WRAP = 1 << 32  # the head counts microseconds in 32 bits: 71 minutes


@dataclass(frozen=True, slots=True)
class HeadSensor:
    """A sensor with its settings: its scales, and the request that sets it up.

    ``start_s`` is how long its start may take.
    """

    kind: ImuKind
    setup: SetImu
    rate_hz: float
    range_dps: float
    noise_dps_rthz: float
    lsb_per_dps: float
    lsb_per_g: float
    temperature_c: Callable[[int], float]
    start_s: float


def head_sensor(config: ImuConfig) -> HeadSensor:
    """Return the configured sensor; a BNO055 has its own rate and range.

    Raises `ConfigError`: a head does not support the sensor, or the sensor a setting.
    """
    # It sets its rate and range itself, and takes seconds to start.
    if config.model == "bno055":
        return HeadSensor(
            kind=bno055.Bno055.KIND,
            setup=SetImu(ImuModel.BNO055, config.address, divider=0, filter=1, range=0),
            rate_hz=bno055.RATE_HZ,
            range_dps=bno055.RANGE_DPS,
            noise_dps_rthz=bno055.Bno055.NOISE_DPS_RTHZ,
            lsb_per_dps=bno055.LSB_PER_DPS,
            lsb_per_g=1000.0,
            temperature_c=float,
            start_s=6.0,
        )
    driver = mpu6050.DRIVERS.get(config.model)
    if driver is None:
        raise ConfigError(
            f"A rig head does not support the sensor {config.model!r}.",
            next_step=f"Set imu.model to {', '.join(mpu6050.DRIVERS)} or bno055, or connect the sensor to the "
            "computer's own I2C bus.",
        )
    # The settings of the computer's own driver, as the three numbers that the firmware writes.
    lsb_per_c, zero_c = driver.TEMPERATURE
    registers = mpu6050.settings(config.range_dps, config.rate_hz, config.bandwidth_hz)
    divider, dlpf, full_scale, _ = registers[mpu6050.SMPLRT_DIV]
    lsb_per_dps = mpu6050.LSB_PER_DPS[config.range_dps]
    return HeadSensor(
        kind=driver.KIND,
        setup=SetImu(ImuModel.MPU6050, config.address, divider=divider, filter=dlpf, range=full_scale >> 3),
        rate_hz=1000.0 / (divider + 1),
        range_dps=32767 / lsb_per_dps,
        noise_dps_rthz=driver.NOISE_DPS_RTHZ,
        lsb_per_dps=lsb_per_dps,
        lsb_per_g=mpu6050.LSB_PER_G,
        temperature_c=lambda raw: raw / lsb_per_c + zero_c,
        start_s=0.6,
    )


class HeadClock:
    """Converts times of the head (µs, wrapping at 2³²) to times of the bench (ns).

    ``transmission_ns`` is the time that the two frames take at the baud rate. It is equal in both directions, so it
    adds no uncertainty.
    """

    def __init__(self, transmission_ns: float) -> None:
        self._transmission_ns = transmission_ns
        self.restart()

    def restart(self) -> None:
        """Drop all round trips: the head's clock started again."""
        self._round_trips: deque[tuple[float, float, float]] = deque(maxlen=ROUND_TRIPS)
        # Of each: its middle on the head's clock in µs and on the bench's in ns, and its delay in ns.
        self._newest_us: int | None = None
        self._origin_us = self._origin_ns = 0.0
        self._fit = np.zeros(2)
        self._covariance = np.diag([np.inf, DRIFT_SIGMA**2])
        self._asymmetry_ns = 0.0

    @property
    def known(self) -> bool:
        return bool(self._round_trips)

    @property
    def drift_ppm(self) -> float:
        """Relative error of the head's clock rate in parts per million; positive if it is too fast."""
        return float(1 / (1 + self._fit[1]) - 1) * 1e6

    @property
    def uncertainty_ns(self) -> float:
        """Standard uncertainty of a time at the newest heartbeat."""
        return hypot(sqrt(self._covariance[0, 0]), self._asymmetry_ns / sqrt(3))

    def unwrap(self, head_us: int) -> int:
        """Return a time of the head without wrapping, counted from the newest known time."""
        if self._newest_us is None:
            self._newest_us = head_us
            return head_us
        ahead = (head_us - self._newest_us + _WRAP // 2) % _WRAP - _WRAP // 2
        time_us = self._newest_us + ahead
        self._newest_us = max(self._newest_us, time_us)
        return time_us

    def add(self, sent_ns: int, received_us: int, answered_us: int, heard_ns: int) -> None:
        """Add one round trip; the head's times are unwrapped."""
        delay_ns = (heard_ns - sent_ns) - (answered_us - received_us) * 1000.0
        middle = (received_us + answered_us) / 2, (sent_ns + heard_ns) / 2
        self._round_trips.append((*middle, max(delay_ns, 0.0)))
        self._origin_us, self._origin_ns = middle
        head_us, host_ns, delays = np.array(self._round_trips).T
        x = (head_us - self._origin_us) * 1e3
        y = host_ns - self._origin_ns - x
        # A connection that is faster than its baud rate does not transmit byte by byte (a pseudo-terminal): then the
        # transmission time in the shortest round trip is not known.
        shortest = float(delays.min())
        transmission_ns = self._transmission_ns if shortest >= BAUD_TOLERANCE * self._transmission_ns else 0.0
        delay_ns_beyond = np.maximum(delays - transmission_ns, 0.0)
        # The whole delay may be in one direction: the error is uniform within ± half of the delay.
        weight = 1 / (STEP_SIGMA_NS**2 + delay_ns_beyond**2 / 12)
        information = np.array([[weight.sum(), weight @ x], [weight @ x, weight @ x**2 + DRIFT_SIGMA**-2]])
        self._covariance = np.linalg.inv(information)
        self._fit = self._covariance @ np.array([weight @ y, weight @ (x * y)])
        self._asymmetry_ns = float(delay_ns_beyond.min()) / 2  # the delay of the best round trip may be in all of them

    def to_host(self, head_us: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the bench's times (ns) of unwrapped times of the head."""
        ahead_ns = (head_us - self._origin_us) * 1e3
        offset, drift = self._fit
        return round(self._origin_ns) + np.rint(ahead_ns * (1 + drift) + offset).astype(np.int64)


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
        # The index counts the sensor's samples, so that every lost one appears as a gap.
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
        time_ns = self._timing.to_host(np.array([time_us for time_us, _ in taken], np.int64))
        gyro = np.array([(s.gyro_x, s.gyro_y, s.gyro_z) for _, s in taken], float).reshape(-1, 3)
        return ImuSamples(time_ns, gyro / self._sensor.lsb_per_dps, lost)

    def _miss(self, count: int) -> None:
        self._lost += count
        self._statistics.lost += count
