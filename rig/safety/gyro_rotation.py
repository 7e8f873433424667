"""How far the table really turned between two rests: the gyro's integral beside the encoder's difference.

The sensor rides on the platter, so its rate about the vertical is the platter's own, behind the gears and their play.
A gyro knows no direction, only changes, and its zero wanders: every rotation lies between two rests, and the rest
before it gives the bias. The uncertainty of a rotation by φ in the time t (white noise, constant bias and scale) is

    σ² = ARW²·t + (σ_bias·t)² + (σ_scale·φ)²,    ARW = noise density / √2 for a one-sided density.
"""

from dataclasses import dataclass
from math import hypot, inf, isfinite, sqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rig.core.clock import Clock
from rig.core.errors import ConfigError, DeviceFault, DeviceSilent, NotReady, UsageError
from rig.devices.imu import Imu

Axis = Literal["x", "y", "z"]

MEMORY_S = 2.0
"""Rests longer than this teach the bias nothing more: it wanders meanwhile."""
DRAIN_S, DRAIN_SAMPLES = 0.2, 60
"""How long, and how many, samples may wait in the sensor's FIFO (the MPU-6050 holds 170): a drain costs bus time."""
HUNG_S, HUNG_SAMPLES = 0.15, 20
"""How long, and how many, equal samples are no coincidence any more."""
FINE_DPS = 550.0
"""Up to this range a sensor's steps are small enough that its noise shows in them."""
REST_PEAK_DPS = 0.5
"""A table at rest stays within this of its mean rate: eight sigma of the sensor's noise, a ringing of 0.01°."""
MAX_BIAS_DPS = 25.0
"""No gyro at rest shows more: ±20 °/s (PS-MPU-6000A, 6.1), and some warmth."""


@dataclass(frozen=True, slots=True)
class Bias:
    """The gyro's rate at rest about the table's axis, with the evidence for it."""

    rate_dps: float
    sigma_dps: float
    peak_dps: float
    samples: int


@dataclass(frozen=True, slots=True)
class Rotation:
    """What the gyro says about one move; ``reason`` tells why it is not ``valid``."""

    angle_deg: float
    sigma_deg: float
    duration_s: float
    valid: bool
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Agreement:
    """Encoder minus gyro, and the difference that their uncertainties allow."""

    difference_deg: float
    bound_deg: float

    @property
    def agrees(self) -> bool:
        return abs(self.difference_deg) <= self.bound_deg


@dataclass(frozen=True, slots=True)
class Stillness:
    """What encoder and gyro saw between settling and the end of the exposure.

    ``peak_rate_dps`` is infinite where the gyro's samples are not complete; ``platter_change_deg`` is the platter's own
    turn, by the gyro, ``encoder_change_deg`` the shaft's.
    """

    peak_rate_dps: float
    encoder_change_deg: float
    platter_change_deg: float
    still: bool


def compare(
    encoder_deg: float, gyro: Rotation, *, encoder_sigma_deg: float, backlash_deg: float = 0.0, k: float = 4.0
) -> Agreement:
    """Compare a rotation by the encoder with the gyro's.

    The encoder sits on the shaft and does not see the play of the gears: up to ``backlash_deg`` on top of ``k``
    standard deviations is no disagreement.

    Raises
    ------
    UsageError
        When the gyro's rotation is not valid.
    """
    if not gyro.valid:
        raise UsageError(
            f"there is no valid rotation to compare with: {gyro.reason}", next_step="Look at `valid` before comparing."
        )
    return Agreement(encoder_deg - gyro.angle_deg, k * hypot(gyro.sigma_deg, encoder_sigma_deg) + backlash_deg)


def finite(value: float) -> float | None:
    """Return ``value`` as evidence, to three digits; None where it is unknown, as JSON has no infinity."""
    return round(value, 3) if isfinite(value) else None


class GyroRotationMeter:
    """Rotations of the table by its gyro.

    Use: `rest` while the table stands, `begin`, move and call `update` every few hundredths of a second, and when
    `peak_dps` says that it stands again, `end`. A rotation counts from the `end` before it: a platter that is pushed
    on its shaft while the table stands shows in the next one, unless samples were lost meanwhile.

    Parameters
    ----------
    imu
        On the platter.
    clock
        The bench's clock.
    axis, sign
        Which of the sensor's axes is vertical, and +1 where it points up, so that counter-clockwise counts positive.
    scale
        True rate over measured rate, from a calibration.
    scale_sigma
        Standard uncertainty of ``scale``: the spread of new parts when there was no calibration.
    """

    def __init__(
        self,
        imu: Imu,
        clock: Clock,
        *,
        axis: Axis = "z",
        sign: int = 1,
        scale: float = 1.0,
        scale_sigma: float = 0.01,
    ) -> None:
        if axis not in ("x", "y", "z") or sign not in (-1, 1) or not (scale > 0 and scale_sigma >= 0):
            raise ConfigError(
                f"no such mounting of the gyro: axis {axis!r}, sign {sign}, scale {scale}, scale_sigma {scale_sigma}",
                next_step="Give axis x, y or z, sign 1 or -1, a positive scale and an uncertainty not below 0.",
            )
        self._imu = imu
        self._clock = clock
        self._column = "xyz".index(axis)
        self._to_table = sign * scale
        self._scale_sigma = scale_sigma
        self._arw = imu.identity.gyro_noise_dps_rthz / sqrt(2)
        self._saturated_dps = imu.range_dps
        self._time_ns: NDArray[np.int64] = np.empty(0, np.int64)
        self._rate_dps: NDArray[np.float64] = np.empty(0)
        self._drain_s = min(DRAIN_S, DRAIN_SAMPLES / imu.rate_hz)
        self._drained_ns = clock.now_ns()
        self._resting_ns = clock.now_ns()
        self._moving = False
        self._newest_dps, self._repeated = np.zeros(3), 0
        self._restart()
        self.bias: Bias | None = None

    def rest(self, duration_s: float = 0.5) -> Bias:
        """Measure the bias over the samples of the present rest, waiting until they fill ``duration_s``.

        A slow and steady rotation looks just like a bias: that the table stands, the encoder must say. A rotation that
        was begun and not ended (its move was broken off) is dropped.

        Raises
        ------
        NotReady
            When the table moves (or shakes): the bias in use stays as it was, and the rest begins anew.
        DeviceSilent
            When the sensor delivers too few samples.
        UsageError
            When ``duration_s`` is not above 0, or above half of `MEMORY_S`.
        """
        if not 0 < duration_s <= MEMORY_S / 2:
            raise UsageError(
                f"a rest of {duration_s:g} s cannot be judged", next_step=f"Give up to {MEMORY_S / 2:g} s, above 0."
            )
        if self._moving:
            self._drain()
            self._moving, self._resting_ns = False, self._clock.now_ns()
            self._restart()
        rate = self._wait_for_rest(duration_s)
        mean = float(rate.mean())
        peak = float(np.abs(rate - mean).max())
        if peak > REST_PEAK_DPS or abs(mean) > MAX_BIAS_DPS:
            self._resting_ns = self._clock.now_ns()
            raise NotReady(
                f"the table is not at rest: the gyro shows {mean:+.2f} °/s on average, up to {peak:.2f} °/s from it",
                next_step="Wait until the table stands still; a standing table that shakes needs a steadier bench.",
                evidence={"mean_dps": mean, "peak_dps": peak, "peak_limit_dps": REST_PEAK_DPS},
            )
        if self.bias is None:
            self._restart()
        self.bias = Bias(mean, self._noise(rate) / sqrt(rate.size / self._imu.rate_hz), peak, rate.size)
        return self.bias

    def begin(self) -> None:
        """Start measuring a rotation, while the table still stands.

        Raises
        ------
        NotReady
            When no bias is known yet.
        """
        if self.bias is None:
            raise NotReady("the gyro's bias is not known", next_step="Measure it at rest first.")
        self._drain()
        self._moving = True

    def update(self) -> None:
        """Collect what the sensor has measured; cheap to call often."""
        if self._clock.now_ns() - self._drained_ns >= self._drain_s * 1e9:
            self._drain()

    def end(self) -> Rotation:
        """Return the rotation since the last `end` (or first `rest`); the table stands again.

        Raises
        ------
        NotReady
            When none was begun.
        """
        if not self._moving or self.bias is None:
            raise NotReady("no rotation was begun", next_step="Call `begin` before the move.")
        self._drain()
        rotation = self.since_rest()
        self._moving = False
        self._resting_ns = self._clock.now_ns()
        self._restart()
        return rotation

    @property
    def newest_ns(self) -> int:
        """Time of the newest sample collected; 0 where there is none."""
        return int(self._time_ns[-1]) if self._time_ns.size else 0

    def since_rest(self, until_ns: int | None = None) -> Rotation:
        """Return the rotation since the last `end`, by the samples collected so far (those until ``until_ns``).

        Raises
        ------
        NotReady
            When no bias is known yet.
        """
        if self.bias is None:
            raise NotReady("the gyro's bias is not known", next_step="Measure it at rest first.")
        count, sum_dps = self._count, self._sum_dps
        if until_ns is not None:
            later = self._rate_dps[np.searchsorted(self._time_ns, until_ns, side="right") :]
            count, sum_dps = count - later.size, sum_dps - float(later.sum())
        duration_s = count / self._imu.rate_hz
        angle_deg = self._to_table * (sum_dps / self._imu.rate_hz - self.bias.rate_dps * duration_s)
        drift_deg = abs(self._to_table) * hypot(self._arw * sqrt(duration_s), self.bias.sigma_dps * duration_s)
        sigma_deg = hypot(drift_deg, self._scale_sigma * angle_deg)
        return Rotation(angle_deg, sigma_deg, duration_s, not self._trouble, self._trouble)

    def peak_dps(self, window_s: float = 0.1) -> float:
        """Return the largest rate of the table (without bias) in the last ``window_s``: what settling is judged by.

        Infinite while the bias is unknown, or the window not filled by samples, or the newest of them too old: what is
        unknown is not at rest.
        """
        self._drain()
        recent = self._rate_dps[-max(round(window_s * self._imu.rate_hz), 1) :]
        filled = recent.size >= max(window_s * self._imu.rate_hz - 0.5, 1)
        if self.bias is None or not filled or self._drained_ns - self._time_ns[-1] > max(window_s, DRAIN_S) * 1e9:
            return inf
        return float(abs(self._to_table) * np.abs(recent - self.bias.rate_dps).max())

    # -- inside ---------------------------------------------------------------------------------------------------

    def _drain(self) -> None:
        new = self._imu.read_samples()
        self._drained_ns = self._clock.now_ns()
        self._refuse_repetition(new.gyro_dps)
        rate = new.gyro_dps[:, self._column]
        if new.lost:
            self._time_ns, self._rate_dps = self._time_ns[:0], self._rate_dps[:0]
        self._time_ns = np.concatenate([self._time_ns, new.time_ns])
        self._rate_dps = np.concatenate([self._rate_dps, rate])
        kept = self._time_ns > self._drained_ns - MEMORY_S * 1e9
        self._time_ns, self._rate_dps = self._time_ns[kept], self._rate_dps[kept]
        if new.lost and not self._moving:
            self._restart()  # a table that stands is looked at seldom
        elif new.lost:
            self._trouble = f"the sensor lost {new.lost} samples"
        self._sum_dps += float(rate.sum())
        self._count += rate.size
        if rate.size and np.abs(rate).max() >= self._saturated_dps:
            self._trouble = f"the rate went beyond the gyro's range of {self._saturated_dps:g} °/s"

    def _refuse_repetition(self, gyro_dps: NDArray[np.float64]) -> None:
        """Raise `DeviceFault` where the sensor repeats one sample: noise alone would change it (exact zeros aside)."""
        if not len(gyro_dps) or self._saturated_dps > FINE_DPS:
            return
        newest = gyro_dps[-1]
        others = np.flatnonzero((gyro_dps != newest).any(axis=1))
        went_on = not others.size and np.array_equal(newest, self._newest_dps)
        self._repeated = (
            len(gyro_dps) - (int(others[-1]) + 1 if others.size else 0) + (self._repeated if went_on else 0)
        )
        self._newest_dps = newest
        if newest.all() and self._repeated >= max(HUNG_S * self._imu.rate_hz, HUNG_SAMPLES):
            ends = float(np.abs(newest).max()) >= self._saturated_dps
            raise DeviceFault(
                f"the gyro stands at the end of its range of {self._saturated_dps:.0f} °/s"
                if ends
                else f"the gyro hangs: its last {self._repeated} samples are one and the same",
                next_step="Take its supply away for a moment, then open the bench again.",
                evidence={"samples": self._repeated, "gyro_dps": [round(float(rate), 3) for rate in newest]},
            )

    def _restart(self) -> None:
        self._sum_dps, self._count, self._trouble = 0.0, 0, ""

    def _wait_for_rest(self, duration_s: float) -> NDArray[np.float64]:
        """Return the rates of at least ``duration_s`` since the rest began (or samples were lost)."""
        needed = max(round(duration_s * self._imu.rate_hz), 2)
        give_up_ns = self._clock.now_ns() + round((2 * duration_s + 1.0) * 1e9)
        while True:
            self._drain()
            rate = self._rate_dps[self._time_ns > self._resting_ns]
            if rate.size >= needed:
                return rate
            if self._clock.now_ns() > give_up_ns:
                raise DeviceSilent(
                    f"the gyro delivered {rate.size} samples in {2 * duration_s + 1:g} s",
                    next_step="Check its cable and supply, then open the bench again.",
                    evidence={"samples": rate.size, "needed": needed},
                )
            self._clock.sleep(min((needed - rate.size + 0.5) / self._imu.rate_hz, self._drain_s))

    def _noise(self, rate: NDArray[np.float64]) -> float:
        """Return the angle random walk in °/√s: the datasheet's, or what the samples show when that is more."""
        return max(self._arw, float(rate.std()) / sqrt(self._imu.rate_hz))
