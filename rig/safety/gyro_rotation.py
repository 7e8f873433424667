"""Rotation of the platter between two rests, from the integral of the gyro's rate.

The sensor is mounted on the platter, so it measures the platter's own rotation, after the gears and their backlash. A
gyro measures no direction, only changes, and its bias drifts. Therefore each rotation lies between two rests, and the
rest before it gives the bias. With white noise and constant bias and scale, the uncertainty of a rotation by φ in the
time t is

    σ² = ARW²·t + (σ_bias·t)² + (σ_scale·φ)²,    ARW = noise density / √2 for a one-sided density.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import hypot, inf, isfinite, nan, sqrt
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidatorFunctionWrapHandler, WithJsonSchema, WrapValidator

from rig.core.clock import Clock
from rig.core.errors import ConfigError, DeviceFault, DeviceSilent, NotReady, UsageError
from rig.core.phrases import Worded, filled, signed
from rig.devices.imu import Imu

Axis = Literal["x", "y", "z"]

MEMORY_S = 2.0
"""Longer rests do not improve the bias, because it drifts during them."""
MEANWHILE_S = 0.05  # longer: a stop waits for it
"""Longest time between two looks for a request to stop while the gyro is averaged."""
DRAIN_S, DRAIN_SAMPLES = 0.2, 60
"""Longest time, and largest number, of samples in the sensor's FIFO (170 in the MPU-6050), because reading uses the
bus."""
HUNG_S, HUNG_SAMPLES = 0.15, 20
"""Duration and number of equal samples that show that the sensor hangs."""
FINE_DPS = 550.0
"""Up to this range, a sensor's steps are small enough to show its noise."""
REST_PEAK_DPS = 0.5
"""Largest deviation from the mean rate at rest: eight sigma of the sensor's noise, a ringing of 0.01°."""
AGREED_SIGMAS = 4.0  # 1 in 16,000 moves exceeds it by chance; smaller: good enrollments end; larger: small slips pass
"""Largest difference of encoder and gyro that agrees, in standard deviations, apart from the backlash."""
MAX_BIAS_DPS = 25.0
"""Largest bias of a gyro: ±20 °/s (PS-MPU-6000A, 6.1), and a margin for temperature."""


@dataclass(frozen=True, slots=True)
class Bias:
    """The gyro's rate at rest about the table's axis, with its evidence."""

    rate_dps: float
    sigma_dps: float
    peak_dps: float
    samples: int


class GyroIssue(Worded):
    """The reasons why a rotation by the gyro is not valid."""

    LOST_SAMPLES = "lost-samples", "the sensor lost {limit:.0f} samples"
    OUT_OF_RANGE = "out-of-range", "the rate exceeded the gyro's range of {limit:g} °/s"


@dataclass(frozen=True, slots=True)
class Rotation:
    """One rotation measured by the gyro; it is not valid if there is an ``issue``.

    ``limit`` is the number that belongs to the issue: the lost samples, or the gyro's range in °/s.
    """

    angle_deg: float
    sigma_deg: float
    duration_s: float
    issue: GyroIssue | None = None
    limit: float = 0.0

    @property
    def valid(self) -> bool:
        return self.issue is None

    @property
    def reason(self) -> str:
        """The issue in words; empty if there is none."""
        return "" if self.issue is None else filled(self.issue.words, limit=self.limit)


@dataclass(frozen=True, slots=True)
class Agreement:
    """Rotation by the encoder minus rotation by the gyro, and the largest difference that their uncertainties allow."""

    difference_deg: float
    bound_deg: float

    @property
    def agrees(self) -> bool:
        return abs(self.difference_deg) <= self.bound_deg


def _read(value: Any, read: ValidatorFunctionWrapHandler) -> Any:
    return nan if value is None else read(value)


NumberOrNull = Annotated[float, WrapValidator(_read), WithJsonSchema({"anyOf": [{"type": "number"}, {"type": "null"}]})]
"""A number that may be infinite or nan: it is null in JSON, and null is read as nan."""


@dataclass(frozen=True, slots=True)
class Stillness:
    """Movement that encoder and gyro measured between settling and the end of the exposure."""

    peak_rate_dps: NumberOrNull
    """Largest rate of the platter by the gyro; null if samples of the gyro were lost."""
    encoder_change_deg: float
    """Rotation of the shaft since the table came to rest, by the encoder."""
    platter_change_deg: NumberOrNull
    """Rotation of the platter since the table came to rest, by the gyro; null if it is not known."""
    still: bool
    """Whether these values count as rest."""


def compare(encoder_deg: float, gyro: Rotation, *, encoder_sigma_deg: float, backlash_deg: float = 0.0) -> Agreement:
    """Compare a rotation by the encoder with the gyro's.

    The encoder is on the shaft and does not measure the gears' backlash: a difference of up to ``backlash_deg`` plus
    `AGREED_SIGMAS` standard deviations agrees.

    Raises `UsageError`: the gyro's rotation is not valid.
    """
    if not gyro.valid:
        raise UsageError(
            f"The gyro's rotation is not valid: {gyro.reason}.", next_step="Check `valid` before comparing."
        )
    return Agreement(
        encoder_deg - gyro.angle_deg, AGREED_SIGMAS * hypot(gyro.sigma_deg, encoder_sigma_deg) + backlash_deg
    )


def finite(value: float) -> float | None:
    """Return ``value`` rounded to three digits, as evidence; None if it is infinite, which JSON cannot express."""
    return round(value, 3) if isfinite(value) else None


class GyroRotationMeter:
    """Measures rotations of the table by its gyro.

    Call `rest` while the table stands still, then `begin`, move, call `update` every few hundredths of a second, and
    call `end` when `peak_dps` shows that the table stands still again. A rotation counts from the previous `end`: if
    the platter slips on its shaft between two moves, the next rotation includes the slip, unless samples were lost.

    ``axis`` and ``sign`` are the sensor's vertical axis, and +1 if it points up, so that counter-clockwise is positive.
    ``scale`` is the true rate divided by the measured one; without calibration its uncertainty ``scale_sigma`` is the
    spread of new parts.
    """

    def __init__(
        self, imu: Imu, clock: Clock, *, axis: Axis = "z", sign: int = 1, scale: float = 1.0, scale_sigma: float = 0.01
    ) -> None:
        if axis not in ("x", "y", "z") or sign not in (-1, 1) or not (scale > 0 and scale_sigma >= 0):
            raise ConfigError(
                f"The mounting of the gyro is not possible: axis {axis!r}, sign {sign}, scale {scale}, "
                f"uncertainty {scale_sigma}.",
                next_step="Set axis x, y or z, sign 1 or -1, a positive scale, and an uncertainty of at least 0.",
            )
        # The sensor's axes and scale, and the uncertainty of its samples.
        self._imu = imu
        self._clock = clock
        self._column = "xyz".index(axis)
        self._to_table = sign * scale
        self._scale_sigma = scale_sigma
        self.arw = imu.identity.gyro_noise_dps_rthz / sqrt(2)
        """The angle random walk by the datasheet, in °/√s."""
        self._saturated_dps = imu.range_dps
        # The memory of the last samples, and the integral since the last rest.
        self._time_ns: NDArray[np.int64] = np.empty(0, np.int64)
        self._rate_dps: NDArray[np.float64] = np.empty(0)
        self._drain_s = min(DRAIN_S, DRAIN_SAMPLES / imu.rate_hz)
        self._drained_ns = clock.now_ns()
        self._resting_ns = clock.now_ns()
        self._moving = False
        self._newest_dps, self._repeated = np.zeros(3), 0
        self._issue: GyroIssue | None = None
        self._issue_limit = 0.0
        self._restart()
        self.bias: Bias | None = None
        self.taps: list[Callable[[NDArray[np.int64], NDArray[np.float64]], object]] = []
        """Called with times and rates (°/s, about the table's axis, with the bias) of new samples."""

    def rest(self, duration_s: float = 0.5, meanwhile: Callable[[], object] = lambda: None) -> Bias:
        """Measure the bias during the present rest; wait until it has lasted ``duration_s``.

        ``meanwhile`` is called many times a second while it waits.

        A slow and steady rotation looks like a bias, so the caller must know from the encoder that the table stands
        still. A rotation that was begun and not ended (its move was interrupted) is dropped.

        Raises `NotReady`: the table moves or shakes. The bias in use stays as it was, and the rest begins again.
        `DeviceSilent`: the sensor delivers too few samples. `UsageError`: ``duration_s`` is not above 0, or above half
        of `MEMORY_S`.
        """
        if not 0 < duration_s <= MEMORY_S / 2:
            raise UsageError(
                f"A rest of {duration_s:g} s is not possible.", next_step=f"Give up to {MEMORY_S / 2:g} s, above 0."
            )
        # An interrupted rotation has no end: what was measured of it counts for nothing.
        if self._moving:
            self._drain()
            self._moving, self._resting_ns = False, self._clock.now_ns()
            self._restart()
        # Its mean is the bias, if nothing shakes and no part has this bias.
        rate = self._wait_for_rest(duration_s, meanwhile)
        mean = float(rate.mean())
        peak = float(np.abs(rate - mean).max())
        if peak > REST_PEAK_DPS or abs(mean) > MAX_BIAS_DPS:
            self._resting_ns = self._clock.now_ns()
            raise NotReady(
                f"The table is not at rest: the gyro measures {signed(mean, 2)} °/s on average, with deviations up to "
                f"{peak:.2f} °/s.",
                next_step="Wait until the table stands still. If it shakes, use a steadier bench.",
                evidence={"mean_dps": mean, "peak_dps": peak, "peak_limit_dps": REST_PEAK_DPS},
            )
        if self.bias is None:  # before the first bias, there was nothing to measure a rotation with
            self._restart()
        self.bias = Bias(mean, self._noise(rate) / sqrt(rate.size / self._imu.rate_hz), peak, rate.size)
        return self.bias

    def begin(self) -> None:
        """Start to measure a rotation, before the table moves.

        Raises `NotReady`: the bias is not known yet.
        """
        self._known_bias()
        self._drain()
        self._moving = True

    @property
    def bias_of_table(self) -> tuple[float, float]:
        """The bias about the table's axis and its standard uncertainty in °/s, in the unit of `taps`."""
        bias = self._known_bias()
        return self._to_table * bias.rate_dps, abs(self._to_table) * bias.sigma_dps

    def _known_bias(self) -> Bias:
        if self.bias is None:
            raise NotReady("The gyro's bias is not known.", next_step="Measure it at rest first.")
        return self.bias

    def update(self, *, now: bool = False) -> None:
        """Collect the sensor's new samples, unless it was done very recently and ``now`` is false."""
        if now or self._clock.now_ns() - self._drained_ns >= self._drain_s * 1e9:
            self._drain()

    def end(self) -> Rotation:
        """Return the rotation since the last `end` (or first `rest`); the table stands still again.

        Raises `NotReady`: no rotation was begun.
        """
        if not self._moving or self.bias is None:
            raise NotReady("No rotation was begun.", next_step="Call `begin` before the move.")
        self._drain()
        rotation = self.since_rest()
        # The next rotation counts from here, so that a slip between two moves is part of it.
        self._moving = False
        self._resting_ns = self._clock.now_ns()
        self._restart()
        return rotation

    @property
    def newest_ns(self) -> int:
        """Time of the newest collected sample; 0 if there is none."""
        return int(self._time_ns[-1]) if self._time_ns.size else 0

    def since_rest(self, until_ns: int | None = None) -> Rotation:
        """Return the rotation since the last `end`, from the samples collected so far (those until ``until_ns``).

        Raises `NotReady`: the bias is not known yet.
        """
        bias = self._known_bias()
        count, sum_dps = self._count, self._sum_dps
        if until_ns is not None:
            # The memory also has samples from before the rest, which are not in the sum.
            first = max(int(np.searchsorted(self._time_ns, until_ns, side="right")), self._rate_dps.size - self._count)
            later = self._rate_dps[first:]
            count, sum_dps = count - later.size, sum_dps - float(later.sum())
        duration_s = count / self._imu.rate_hz
        angle_deg = self._to_table * (sum_dps / self._imu.rate_hz - bias.rate_dps * duration_s)
        drift_deg = abs(self._to_table) * hypot(self.arw * sqrt(duration_s), bias.sigma_dps * duration_s)
        sigma_deg = hypot(drift_deg, self._scale_sigma * angle_deg)
        return Rotation(angle_deg, sigma_deg, duration_s, self._issue, self._issue_limit)

    def peak_dps(self, window_s: float = 0.1) -> float:
        """Return the largest rate of the table (without bias) in the last ``window_s``, which shows whether it settled.

        Infinite if the bias is unknown, if samples are missing in the window, or if the newest one is too old.
        """
        self._drain()
        recent = self._rate_dps[-max(round(window_s * self._imu.rate_hz), 1) :]
        filled = recent.size >= max(window_s * self._imu.rate_hz - 0.5, 1)
        if self.bias is None or not filled or self._drained_ns - self._time_ns[-1] > max(window_s, DRAIN_S) * 1e9:
            return inf
        return float(abs(self._to_table) * np.abs(recent - self.bias.rate_dps).max())

    def _drain(self) -> None:
        new = self._imu.read_samples()
        self._drained_ns = self._clock.now_ns()
        self._check_repetition(new.gyro_dps)
        rate = new.gyro_dps[:, self._column]
        for tap in self.taps:
            tap(new.time_ns, self._to_table * rate)
        if new.lost:  # an integral across missing samples is not valid
            self._time_ns, self._rate_dps = self._time_ns[:0], self._rate_dps[:0]
        self._time_ns = np.concatenate([self._time_ns, new.time_ns])
        self._rate_dps = np.concatenate([self._rate_dps, rate])
        kept = self._time_ns > self._drained_ns - MEMORY_S * 1e9
        self._time_ns, self._rate_dps = self._time_ns[kept], self._rate_dps[kept]
        if new.lost and not self._moving:
            self._restart()  # samples are collected rarely while the table stands still
        elif new.lost:
            self._issue, self._issue_limit = GyroIssue.LOST_SAMPLES, new.lost
        self._sum_dps += float(rate.sum())
        self._count += rate.size
        if rate.size and np.abs(rate).max() >= self._saturated_dps:
            self._issue, self._issue_limit = GyroIssue.OUT_OF_RANGE, self._saturated_dps

    def _check_repetition(self, gyro_dps: NDArray[np.float64]) -> None:
        """Raise `DeviceFault` if the sensor repeats one sample (other than zeros): noise would change it."""
        if not len(gyro_dps) or self._saturated_dps > FINE_DPS:  # with coarse steps, a still sensor repeats itself
            return
        # How many equal samples end this reading, and those before it?
        newest = gyro_dps[-1]
        others = np.flatnonzero((gyro_dps != newest).any(axis=1))
        continues = not others.size and np.array_equal(newest, self._newest_dps)
        self._repeated = (
            len(gyro_dps) - (int(others[-1]) + 1 if others.size else 0) + (self._repeated if continues else 0)
        )
        self._newest_dps = newest
        # A simulated sensor without noise repeats zeros.
        if newest.all() and self._repeated >= max(HUNG_S * self._imu.rate_hz, HUNG_SAMPLES):
            ends = float(np.abs(newest).max()) >= self._saturated_dps
            raise DeviceFault(
                f"The gyro stays at the end of its range of {self._saturated_dps:.0f} °/s."
                if ends
                else f"The gyro hangs: its last {self._repeated} samples are equal.",
                next_step="Switch the sensor's supply off and on, then open the bench again.",
                evidence={"samples": self._repeated, "gyro_dps": [round(float(rate), 3) for rate in newest]},
            )

    def _restart(self) -> None:
        self._sum_dps, self._count = 0.0, 0
        self._issue, self._issue_limit = None, 0.0

    def _wait_for_rest(self, duration_s: float, meanwhile: Callable[[], object]) -> NDArray[np.float64]:
        """Return the rates of at least ``duration_s`` since the rest began or samples were lost."""
        needed = max(round(duration_s * self._imu.rate_hz), 2)
        deadline_ns = self._clock.now_ns() + round((2 * duration_s + 1.0) * 1e9)
        while True:
            self._drain()
            rate = self._rate_dps[self._time_ns > self._resting_ns]
            if rate.size >= needed:
                return rate
            if self._clock.now_ns() > deadline_ns:
                raise DeviceSilent(
                    f"The gyro delivered only {rate.size} samples in {2 * duration_s + 1:g} s.",
                    next_step="Check its cable and supply, then open the bench again.",
                    evidence={"samples": rate.size, "needed": needed},
                )
            left_s = min((needed - rate.size + 0.5) / self._imu.rate_hz, self._drain_s)
            while left_s > 0:
                meanwhile()
                self._clock.sleep(min(left_s, MEANWHILE_S))
                left_s -= MEANWHILE_S

    def _noise(self, rate: NDArray[np.float64]) -> float:
        """Return the angle random walk in °/√s: the datasheet's value, or the measured one if that is larger."""
        return max(self.arw, float(rate.std()) / sqrt(self._imu.rate_hz))
