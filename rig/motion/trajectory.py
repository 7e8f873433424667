"""The platter's angle at any time of a motion, from encoder readings and gyro samples together.

The gyro measures the platter's rate every few milliseconds, but its integral drifts. The encoder does not drift, but it
is read some thirty times per second, and the backlash is between it and the platter. With the integral G of the gyro's
rate since the first sample, a reading E at the time t obeys

    E(t) = θ₀ + (1 + s)·G(t + τ) − β·t + c·α(t + τ) + o + noise

where s is the error of the gyro's scale, β that of its bias, τ the delay of its samples, and o the backlash that the
shaft has run through. The platter is not rigid on its shaft: while it is accelerated by α, it stays behind by c·α, with
c one over the square of its natural frequency. The parameters follow by weighted least squares over all readings of the
motion. Prior knowledge enters as further readings: the bias that was measured at rest, and the uncertainty of the
scale. The platter's angle is the same sum without c·α and o. Angles are those that the encoder shows when the platter
is driven upwards. Views at rest are taken in this state, because the table approaches each angle from below.

Decision: docs/decisions/0019.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

DELAY_S: Final = (0.004, 0.004)
"""Delay of a gyro's samples, and its standard uncertainty: a low-pass filter of 42 Hz takes 4.8 ms (MPU-6050)."""
BIAS_DRIFT_DPS: Final = 0.003
"""Change of the bias between its rest and a motion."""
COMPLIANCE_S2: Final = 3e-4
"""How far the platter may stay behind an acceleration: a natural frequency of 9 Hz or more (1 σ)."""
READ_TIME_S: Final = 0.0004
"""Standard uncertainty of the time of an encoder reading: it is taken somewhere within its transaction."""
ACCELERATION_DPS2: Final = 400.0
"""Largest acceleration of the platter that is expected where no sample was taken."""
OUTLIER: Final = 4.0  # as `rig.safety.gyro_rotation.AGREED_SIGMAS`
"""Readings that deviate by more standard uncertainties weigh less."""
# larger: a slip is stored in the azimuths of views; smaller: encoder noise and backlash end good motions
SLIP_DEG: Final = 0.25
SLIP_READINGS: Final = 5  # one wrong reading is noise of the bus; more of them: a short slip goes unnoticed
"""Number of successive readings with a large deviation that shows a slip of the platter or a wrong sensor."""
FEWEST_READINGS: Final = 4  # the fit has four unknown parameters: angle, bias, scale, delay


@dataclass(frozen=True, slots=True)
class PlatterMotion:
    """Angle, its standard uncertainty (°), and rate (°/s) of the platter at some times, float64 (n,) each."""

    angle_deg: Floats
    sigma_deg: Floats
    rate_dps: Floats


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The platter's angle as a function of time; `TrajectoryRecorder.fit` makes it."""

    residual_deg: float
    """The largest mean deviation of `SLIP_READINGS` encoder readings in a row."""
    start_ns: int
    end_ns: int
    """Times of the first and the last gyro sample."""
    _values: Floats
    _covariance: Floats
    _time_s: Floats
    _rate_dps: Floats
    _integral_deg: Floats
    _gaps: Floats
    _drift_deg: float

    @property
    def consistent(self) -> bool:
        """Whether encoder and gyro measured the same motion, apart from their known errors."""
        return self.residual_deg <= SLIP_DEG

    def at(self, times_ns: ArrayLike) -> PlatterMotion:
        """Return the platter's motion at some times, int64 (n,); outside the samples the uncertainty grows fast."""
        t: Floats = (np.atleast_1d(np.asarray(times_ns, np.int64)) - self.start_ns).astype(np.float64) * 1e-9
        delay_s = self._values[3]
        at_s = t + delay_s
        rate = np.interp(at_s, self._time_s, self._rate_dps)
        outside_s = np.maximum(at_s - self._time_s[-1], 0) - np.maximum(self._time_s[0] - at_s, 0)
        design = _design(at_s, t, self._time_s, self._rate_dps, self._integral_deg, self._gaps)
        angle = design @ self._values + rate * outside_s + np.interp(at_s, self._time_s, self._integral_deg)
        angle -= design[:, 3] * delay_s  # the integral is already at the delayed time
        nearest = np.searchsorted(self._time_s, at_s).clip(1, len(self._time_s) - 1)
        inside_s = np.minimum(np.abs(self._time_s[nearest] - at_s), np.abs(at_s - self._time_s[nearest - 1]))
        unknown = ACCELERATION_DPS2 / 4 * np.square(np.where(outside_s == 0, inside_s, outside_s))
        variance = np.einsum("ij,jk,ik->i", design, self._covariance, design) + self._drift_deg**2 + unknown**2
        variance += np.square(rate * READ_TIME_S)  # the same error applies to all readings
        return PlatterMotion(angle, np.sqrt(variance), rate * (1 + self._values[2]) - self._values[1])


def _design(at_s: Floats, t: Floats, time_s: Floats, rate: Floats, integral: Floats, gaps: Floats) -> Floats:
    """Return the derivatives of the angle by θ₀, β, s, τ and the unknown rotation in each gap, (n, 4 + gaps)."""
    here = np.interp(at_s, time_s, integral)
    steps = (at_s[:, None] > gaps).astype(float)
    return np.column_stack([np.ones_like(t), -t, here, np.interp(at_s, time_s, rate), steps])


@dataclass(eq=False)
class TrajectoryRecorder:
    """Collects encoder readings (times and table angles) and gyro samples of a motion."""

    resolution_deg: float
    backlash_deg: float
    scale_sigma: float
    arw: float
    bias_dps: float = 0.0
    bias_sigma_dps: float = 0.1
    readings: list[tuple[int, float]] = field(default_factory=list)
    _time_ns: list[Times] = field(default_factory=list)
    _rate: list[Floats] = field(default_factory=list)

    def add_reading(self, time_ns: int, angle_deg: float) -> None:
        """Add a reading of the encoder, as a table angle."""
        self.readings.append((time_ns, angle_deg))

    def add_samples(self, time_ns: Times, rate_dps: Floats) -> None:
        """Add samples of the gyro's rate about the table's axis (n,), with its bias; missing samples leave a gap."""
        if len(time_ns):
            self._time_ns.append(time_ns)
            self._rate.append(rate_dps)

    def fit(self) -> Trajectory | None:
        """Return the trajectory so far; None if there are too few readings or samples."""
        if len(self.readings) < FEWEST_READINGS or not self._time_ns:
            return None
        time_ns = np.concatenate(self._time_ns)
        rate: Floats = np.concatenate(self._rate) - self.bias_dps
        if len(time_ns) < FEWEST_READINGS:
            return None
        # Integrate the gyro's rate, and find the gaps in its samples.
        start_ns = int(time_ns[0])
        time_s: Floats = ((time_ns - start_ns) * 1e-9).astype(np.float64)
        steps_s = np.diff(time_s)
        integral = np.concatenate([[0.0], np.cumsum(steps_s * (rate[1:] + rate[:-1]) / 2)])
        missing = steps_s > 2.5 * np.median(steps_s)
        gaps: Floats = (time_s[:-1] + time_s[1:])[missing] / 2
        # Select the encoder readings that the backlash does not hide.
        encoder_t = np.array([(t - start_ns) * 1e-9 for t, _ in self.readings])
        encoder_deg = np.array([angle for _, angle in self.readings])
        played, used = backlash_states(encoder_deg, self.backlash_deg)
        used &= (encoder_t >= time_s[0]) & (encoder_t <= time_s[-1])
        if used.sum() < FEWEST_READINGS:
            return None
        t, e, o = encoder_t[used], encoder_deg[used], played[used]
        # Prior knowledge: the mean and the standard uncertainty of each parameter.
        mean = np.concatenate(
            [[0.0, 0.0, 0.0, DELAY_S[0]], np.zeros(len(gaps)), [0.0, -self.backlash_deg / 2, -self.backlash_deg / 4]]
        )
        known = np.concatenate(
            [
                [1e4, np.hypot(self.bias_sigma_dps, BIAS_DRIFT_DPS), self.scale_sigma, DELAY_S[1]],
                ACCELERATION_DPS2 / 8 * np.square(steps_s[missing]) + 0.02,
                [COMPLIANCE_S2, self.backlash_deg / 2, self.backlash_deg / 2],
            ]
        )
        # Fit, with less weight for outliers each time; the delay changes the times of the readings.
        rates = np.abs(np.interp(t, time_s, rate))
        acceleration = np.gradient(rate, time_s)
        noise = np.hypot(self.resolution_deg / 2, rates * READ_TIME_S)
        values, weight = mean.copy(), 1 / noise
        for _ in range(4):
            at_s = t + values[3]
            platter = _design(at_s, t, time_s, rate, integral, gaps)
            design = np.column_stack([platter, np.interp(at_s, time_s, acceleration), o == -1, o == 0])
            base = np.interp(at_s, time_s, integral) - design[:, 3] * values[3]
            rows = np.vstack([design * weight[:, None], np.diag(1 / known)])
            right = np.concatenate([(e - base) * weight, mean / known])
            normal = rows.T @ rows
            values = np.linalg.solve(normal, rows.T @ right)
            residual = e - base - design @ values
            weight = 1 / (noise * np.maximum(1, np.abs(residual) / (OUTLIER * noise)))
        # Scale the covariance by the scatter, and find the largest mean deviation of readings in a row.
        freedom = max(len(t) - 4, 1)
        birge = max(1.0, float(np.square(residual * weight).sum()) / freedom)
        run = min(SLIP_READINGS, len(residual))
        worst = float(np.abs(np.convolve(residual, np.full(run, 1 / run), "valid")).max())
        shown = 4 + len(gaps)
        return Trajectory(
            worst,
            start_ns,
            int(time_ns[-1]),
            values[:shown],
            (np.linalg.inv(normal) * birge)[:shown, :shown],
            time_s,
            rate,
            integral,
            gaps,
            self.arw * float(np.sqrt(time_s[-1])) / 2,
        )


def backlash_states(encoder_deg: Floats, backlash_deg: float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the direction in which the shaft drives the platter at each reading, and which readings can be used.

    +1: upwards; −1: downwards; 0: not known yet, because the shaft has not rotated by the backlash since the beginning.
    While the shaft runs through its backlash, the platter is anywhere between, and a reading cannot be used.
    """
    slack_deg = backlash_deg + 0.2
    states, used = np.zeros(len(encoder_deg), np.int64), np.ones(len(encoder_deg), np.bool_)
    state, low, high = 0, encoder_deg[0], encoder_deg[0]
    for i, angle in enumerate(encoder_deg.tolist()):
        low, high = min(low, angle), max(high, angle)
        if state <= 0 and angle - low > slack_deg:
            state, high = 1, angle
        elif state >= 0 and high - angle > slack_deg:
            state, low = -1, angle
        if state == 1:
            low = angle if angle > high - 0.15 else low
            used[i] = angle > high - 0.15
        elif state == -1:
            high = angle if angle < low + 0.15 else high
            used[i] = angle < low + 0.15
        else:
            used[i] = max(angle - encoder_deg[0], encoder_deg[0] - angle) < 0.15
        states[i] = state
    return states, used
