"""Measure the gyro at rest: its zero, the zero's slope over temperature, its noise, and the random walk of its rate.

The Allan variance of the rate over the time τ, overlapping, from the integrated angle θ (IEEE Std 952, annex C):

    σ²(τ) = Σ (θ(t + 2τ) − 2θ(t + τ) + θ(t))² / (2τ²·n)

White noise of the angle random walk N gives N²/τ, a random walk K of the rate K²·τ/3. Both are fitted together. The
curve has its lowest value at the τ where both are equal. This value, divided by 0.664, is called the bias instability.
Samples of an Allan variance over many τ share their data, so the uncertainties come from a parametric bootstrap: the
fit is repeated on series drawn with the fitted N and K.
"""

from collections.abc import Generator
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from calibration.procedure import Evaluation, Measured, Procedure, require_at_least
from rig.bench import Bench
from rig.calibrations import CalibrationResult, RejectionCode
from rig.charts.xy import MODEL, Axis, Chart, Series
from rig.core.phrases import number, percent
from rig.jobs.desk import Progress

NAME = "imu.noise"

BLOCK_S = 1.0
"""Samples are first averaged over this time: the memory of the sensor's low-pass filter is then below 1 %."""
MIN_MINUTES = 3.0  # shorter: the slow part of the noise, the random walk, is not seen
BOOTSTRAPS = 100  # gives an uncertainty to 7 %
MIN_WARMTH_C = 1.0
"""Smallest change of temperature that determines the slope."""
MAX_ARW_DEG_RTS = 0.02
"""Six times the value in the sensor's datasheet: above it the bench shakes, or the sensor is broken."""
MAX_STEP_SIGMA = 7.0
"""Largest deviation of one block from its neighbours: of 10⁶ blocks of noise none deviates more."""
INSTABILITY = sqrt(2 * np.log(2) / np.pi)
"""0.664, the Allan deviation of flicker noise over its coefficient."""
_DRAIN_S = 0.4  # the FIFO of an MPU-6500 holds 85 samples, 0.42 s at 200 Hz


@dataclass(frozen=True, slots=True)
class RestRecord:
    """The sensor's data at rest, averaged over blocks.

    ``gyro_dps`` float64 (n, 3), about the sensor's axes; ``temperature_c`` float64 (n,); ``lost`` is the number of
    samples that are missing between blocks.
    """

    gyro_dps: NDArray[np.float64]
    temperature_c: NDArray[np.float64]
    block_s: float
    lost: int = 0


def plot(result: CalibrationResult) -> Chart | None:
    """Return a chart of the Allan deviation over the averaging time, measured and fitted."""
    taus, model = result.evidence["tau_s"], result.evidence["allan_deviation_model_dps"]
    return Chart(
        "Allan deviation of the gyro at rest",
        Axis("averaged over, s", log=True),
        Axis("°/s", log=True),
        [
            Series("angle and rate random walk", taus, model, MODEL, dots=False, curve=True),
            Series("measured", taus, result.evidence["allan_deviation_dps"]),
        ],
    )


@dataclass(frozen=True)
class GyroNoise(Procedure):
    """A procedure that records the sensor for some ``minutes`` while the table stands without torque.

    The slope over temperature can be determined only while the sensor warms up, soon after power-on.
    """

    names, title, devices, valid_days, plots = (NAME,), "noise of the gyro", ("imu",), 365, (plot,)
    minutes: float

    def __post_init__(self) -> None:
        require_at_least(MIN_MINUTES, self.minutes, "minutes")

    def measure(self, bench: Bench, *_: CalibrationResult) -> Measured:
        imu, clock = bench.imu, bench.clock
        per_block = round(BLOCK_S * imu.rate_hz)
        waiting = np.empty((0, 3))
        blocks: list[NDArray[np.float64]] = []
        temperatures: list[float] = []
        lost = reported = 0
        imu.read_samples()  # discard the samples since the bench was opened
        needed = round(self.minutes * 60 / BLOCK_S)
        while len(blocks) < needed:
            clock.sleep(_DRAIN_S)
            new = imu.read_samples()
            lost += new.lost
            waiting = np.concatenate([waiting, new.gyro_dps])
            temperature_c = imu.temperature_c()
            while len(waiting) >= per_block:
                blocks.append(waiting[:per_block].mean(axis=0))
                temperatures.append(temperature_c)
                waiting = waiting[per_block:]
            if (share := len(blocks) / needed) * 20 >= reported + 1:
                reported = int(share * 20)
                words = f"{percent(share, 0)} of {self.minutes:g} minutes, {number(temperature_c, '.1f')} °C"
                yield Progress(min(share, 1.0), words)
        rest = RestRecord(np.array(blocks), np.array(temperatures), per_block / imu.rate_hz, lost)
        yield evaluate(rest, column="xyz".index(bench.config.imu.axis))


def evaluate(rest: RestRecord, *, column: int, seed: int = 0) -> Evaluation:
    """Fit the noise of the vertical gyro, ``column`` of the sensor's axes; ``seed`` is that of the bootstrap."""
    found = Evaluation(name=NAME, residual_unit="σ")
    rate = rest.gyro_dps[:, column]
    seconds = rate.size * rest.block_s
    _check_rest(found, rest, column)
    warmed = float(np.ptp(rest.temperature_c)) >= MIN_WARMTH_C
    trend = rest.temperature_c if warmed else np.zeros(rate.size)
    fitted = np.array(_fit(rate, rest.block_s, trend))
    drawn = np.array(
        [_fit(series, rest.block_s, trend) for series in _bootstrap(fitted, rest.block_s, rate.size, seed)]
    )
    # Removing the trend also removes a part of the random walk. The bootstrap measures this part, and the fit is
    # corrected.
    lack = np.divide(fitted, drawn.mean(axis=0), out=np.ones(2), where=fitted > 0)
    arw, walk = (fitted * lack).tolist()
    drawn *= lack**2
    arw_sigma, walk_sigma = drawn.std(axis=0, ddof=1).tolist()
    longest_s = seconds / 4
    instability = _instability(arw, walk, longest_s)
    instability_sigma = float(np.std([_instability(n, k, longest_s) for n, k in drawn.tolist()], ddof=1))
    found.reject_if(arw > MAX_ARW_DEG_RTS, RejectionCode.GYRO_NOISY, arw=arw, limit=MAX_ARW_DEG_RTS)
    found.estimate("angle_random_walk", arw, arw_sigma, "°/√s")
    found.estimate("rate_random_walk", walk, walk_sigma, "°/s/√s")
    found.estimate("bias_instability", instability, instability_sigma, "°/s")
    found.estimate("bias", rate.mean(), sqrt(arw**2 / seconds + walk**2 * rate.size * rest.block_s / 3), "°/s")
    if warmed:
        found.estimate("bias_slope", *_slope(rate, rest.temperature_c, arw, walk, rest.block_s), "°/s/°C")
    steady = rate - _slope(rate, trend)[0] * trend
    taus, deviation, freedom = allan(steady, rest.block_s)
    model = np.sqrt(arw**2 / taus + walk**2 * taus / 3)
    found.residual = float(np.max(np.abs(np.log(deviation / model)) * np.sqrt(freedom / 2)))
    found.evidence = {
        "minutes": seconds / 60,
        "temperature_c": [float(rest.temperature_c.min()), float(rest.temperature_c.max())],
        "lost_samples": rest.lost,
        "bias_dps": rest.gyro_dps.mean(axis=0).tolist(),
        "tau_s": taus.tolist(),
        "allan_deviation_dps": deviation.tolist(),
        "allan_deviation_model_dps": model.tolist(),
    }
    return found


def allan(
    rate: NDArray[np.float64], period_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return τ (s), the overlapping Allan deviation, and its degrees of freedom, over octaves of τ.

    ``rate``, float64 (n,), is evenly spaced by ``period_s``.
    """
    angle = np.concatenate([[0.0], np.cumsum(rate)]) * period_s
    spans = 2 ** np.arange(int(np.log2(rate.size / 4)) + 1)
    second = [angle[2 * m :] - 2 * angle[m:-m] + angle[: -2 * m] for m in spans]
    taus = np.asarray(spans * period_s, dtype=np.float64)
    variance = np.array([(d**2).mean() for d in second]) / (2 * taus**2)
    # Degrees of freedom of an overlapping estimate under white frequency noise (NIST SP 1065, table 5).
    n = rate.size
    freedom: NDArray[np.float64] = (3 * (n - 1) / (2 * spans) - 2 * (n - 2) / n) * 4 * spans**2 / (4 * spans**2 + 5)
    return taus, np.sqrt(variance), np.maximum(freedom, 1.0)


def _fit(rate: NDArray[np.float64], period_s: float, trend: NDArray[np.float64]) -> tuple[float, float]:
    """Return angle random walk and rate random walk by weighted, non-negative least squares on the Allan variance.

    The part of the rate that follows ``trend`` is removed first.
    """
    slope, _ = _slope(rate, trend)
    rate = rate - slope * trend
    taus, deviation, freedom = allan(rate, period_s)
    weights = np.sqrt(freedom / 2) / deviation**2
    n2, k2 = nnls(np.column_stack([1 / taus, taus / 3]) * weights[:, None], deviation**2 * weights)[0]
    return sqrt(n2), sqrt(k2)


def _bootstrap(
    fitted: NDArray[np.float64], period_s: float, size: int, seed: int
) -> Generator[NDArray[np.float64], None, None]:
    arw, walk = fitted
    rng = np.random.default_rng(seed)
    for _ in range(BOOTSTRAPS):
        white, steps = rng.standard_normal((2, size))
        yield arw / sqrt(period_s) * white + walk * sqrt(period_s) * np.cumsum(steps)


def _instability(arw: float, walk: float, longest_s: float) -> float:
    """Return the lowest Allan deviation within ``longest_s``, over 0.664."""
    tau = min(sqrt(3) * arw / walk if walk else longest_s, longest_s)
    return sqrt(arw**2 / tau + walk**2 * tau / 3) / INSTABILITY


def _slope(
    rate: NDArray[np.float64],
    temperature_c: NDArray[np.float64],
    arw: float = 1.0,
    walk: float = 0.0,
    block_s: float = 1.0,
) -> tuple[float, float]:
    """Return the slope of the zero over temperature, °/s/°C, and its standard uncertainty.

    Generalised least squares: over spans in which white noise and random walk are equally strong, the differences of
    neighbouring means are nearly independent.
    """
    tau = sqrt(3) * arw / walk if walk else np.inf
    span = int(np.clip(tau / block_s, 1, rate.size // 8))
    count = rate.size // span
    means = np.column_stack([rate, temperature_c])[: count * span].reshape(count, span, 2).mean(axis=1)
    steps = np.diff(means, axis=0)
    norm = float((steps[:, 1] ** 2).sum())
    if norm == 0:
        return 0.0, np.inf
    slope = float((steps[:, 0] * steps[:, 1]).sum()) / norm
    seconds = span * block_s
    return slope, sqrt((2 * arw**2 / seconds + 2 * walk**2 * seconds / 3) / norm)


def _check_rest(found: Evaluation, rest: RestRecord, column: int) -> None:
    """Reject a record with jumps of the rate, or with lost samples."""
    steps = np.diff(rest.gyro_dps[:, column])
    typical = 1.4826 * float(np.median(np.abs(steps)))
    jumps = np.flatnonzero(np.abs(steps) > MAX_STEP_SIGMA * max(typical, 1e-9))
    if jumps.size:
        at_s = (int(jumps[0]) + 1) * rest.block_s
        found.reject(RejectionCode.RATE_JUMPED, at_s=at_s, jump_dps=abs(steps[jumps[0]]))
    found.reject_if(rest.lost, RejectionCode.SAMPLES_LOST, lost=rest.lost)
