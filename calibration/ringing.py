"""Measure how the platter rings after a stop, by its own gyro: frequency and damping.

After the end of the servo's profile, the rate of the platter is a decaying oscillation, and the rest of the motion of a
shaft that lags behind its profile by the time τ, about the gyro's bias:

    r(t) = exp(−ζωt)·(A·cos(ω_d·t) + B·sin(ω_d·t)) + C·exp(−t/τ) + c,    ω_d = ω·√(1 − ζ²)

All stops have the same ω, ζ and τ, and each its own A, B, C and c, which follow by linear least squares. The
uncertainties come from fits without one of the stops (jackknife). `rig.motion.shaper` uses the result.

It also needs the angle at which friction holds the shaft, to a few thousandths of a degree. Readings at rest are
rounded to a count. In a slow motion the shaft passes many counts, and the mean of the readings is finer: it stays
behind its profile by this angle, and by its speed times τ.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calibration.procedure import Evaluation, Measured, Procedure, lower_end, returning
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Contribution, RejectionCode
from rig.charts.xy import MODEL, Axis, Chart, Series
from rig.motion.move import motion_seconds
from rig.motion.traces import MoveTrace
from rig.motion.turntable import Turntable
from rig.plans.steps import moved

NAME = "table.ringing"

Floats = NDArray[np.float64]

TARGETS_DEG = (20.0, 6.0, 20.0, 0.0)  # a start and a stop at full acceleration, with a pause between them
"""Where the table stops in turn: each profile leaves some frequencies without ringing, so there are two distances."""
LISTEN_S = 2.0  # longer: more noise; shorter: the slowest ringing does not die down
CREEPS = 2  # more: the calibration takes longer; fewer: the friction is known to 0.003° instead of 0.002°
"""How many times the table moves slowly up and down."""
CREEP_DPS, CREEP_DEG, CREEP_POLL_S = 3.0, 6.0, 0.005  # faster: fewer readings; slower: some shafts stick and slip
"""Speed, distance and time between readings of the slow motions."""
STEADY_DEG, ENDS_DEG = 2.5, 0.5
"""The shaft follows evenly from this angle after the start of a slow motion, until this one before its end."""
DELAY_S = 0.02  # shorter: the frequency of a well damped platter is 1 % too low
"""Time after the end of the profile from which the rate is fitted: the gyro's own filter is past it."""
HZ, DAMPING = np.geomspace(3.0, 40.0, 80), np.array([0.01, 0.02, 0.04, 0.08, 0.15, 0.25, 0.4])
LAGS_S = (0.02, 0.045, 0.1)
"""Where the fit begins."""
MAX_RESIDUAL = 3.0
"""Largest scatter about the fit, in that of its end: more is a second oscillation, or a hand."""
CLEAR_PEAK, MIN_PEAK = 6.0, 2.0  # of noise alone, the fits that seem certain have less than 1
"""Rates after a stop, in the scatter of the end: a smaller one is no ringing if its frequency is not certain, or in any
case."""
MAX_UNCERTAINTY, MAX_OF_DAMPING = 0.02, 0.25
"""Largest relative uncertainty of the frequency, at least this share of the damping ratio: with twice as much, a shaped
motion rings by a tenth."""


@dataclass(frozen=True, slots=True)
class Stop:
    """The rate of the platter after the end of a profile: times in seconds and rates in °/s, (n,)."""

    time_s: Floats
    rate_dps: Floats

    @classmethod
    def of(cls, trace: MoveTrace) -> "Stop":
        """Return the stop of a move, from the end of its profile on."""
        begun_ns, goal_deg, profile = trace.goals[-1]
        end_ns = begun_ns + round(motion_seconds(goal_deg - trace.from_deg, profile) * 1e9)
        time_ns, rate_dps = trace.gyro()
        after = (time_ns > end_ns) & (time_ns < end_ns + LISTEN_S * 1e9)
        return cls(((time_ns[after] - end_ns) * 1e-9).astype(np.float64), rate_dps[after])

    def since(self, delay_s: float) -> "Stop":
        return Stop(self.time_s[self.time_s >= delay_s], self.rate_dps[self.time_s >= delay_s])


def plot(result: CalibrationResult) -> Chart | None:
    """Return a chart of the rate after the first stop, measured and fitted."""
    if "frequency" not in result.estimates:
        return None
    shown = result.evidence["stop"]
    return Chart(
        f"Ringing after a stop: {result.estimates['frequency']}, damping {result.estimates['damping']}",
        Axis("seconds after the servo's profile", span=(0.0,)),
        Axis("°/s"),
        [
            Series("model", shown["time_s"], shown["model_dps"], MODEL, dots=False, curve=True),
            Series("measured", shown["time_s"], shown["rate_dps"]),
        ],
    )


@dataclass(frozen=True)
class Ringing(Procedure):
    """A procedure that stops the table ``stops`` times, and listens to the platter."""

    result_name, devices, valid_days, plots = NAME, ("servo", "imu"), 180, (plot,)
    reference = "clock of the computer, by the times of the gyro's samples"
    stops: int

    def measure(self, bench: Bench, *_: CalibrationResult) -> Measured:
        stops, held_deg = [], []
        with Turntable(
            bench, approach_deg=0.0, ringing_hz=0.0, quiet_dps=10.0, velocity_dps=CREEP_DPS, poll_s=CREEP_POLL_S
        ) as table:
            base_deg = lower_end(bench, table.rest_deg, max(TARGETS_DEG))
            creeps = []
            with returning(table) as goto:
                goto(base_deg)
                for target_deg in (base_deg + CREEP_DEG, base_deg) * CREEPS:
                    goto(target_deg)
                    creeps.append(table.moves[-1])
            bench.clock.sleep(LISTEN_S)  # until a platter with little damping is at rest
        with Turntable(bench, approach_deg=0.0, ringing_hz=0.0, quiet_dps=10.0) as table, returning(table) as goto:
            goto(base_deg)
            for index in range(self.stops):
                move = goto(base_deg + TARGETS_DEG[index % len(TARGETS_DEG)])
                for _round in range(round(LISTEN_S / 0.2)):  # less than a sensor's FIFO holds
                    bench.clock.sleep(0.2)
                    table.collect_gyro()
                stops.append(Stop.of(table.moves[-1]))
                goal_deg = table.moves[-1].readings[-1][2]  # the servo's own, rounded to a count as well
                held_deg.append(abs((move.commanded_deg if goal_deg is None else goal_deg) - table.angle_deg()))
                yield moved(index, move)
            goto(base_deg)
            bench.clock.sleep(LISTEN_S)
        return evaluate(stops, float(np.mean(held_deg)), creeps)


def _held_deg(creeps: Sequence[MoveTrace], lag_s: float) -> float | None:
    """Return the angle at which friction holds the shaft, by slow motions; None if the servo reports no profile."""
    found = []
    for trace in creeps:
        _, goal_deg, profile = trace.goals[-1]
        behind_deg = [
            abs(at_deg - encoder_deg)
            for _, encoder_deg, at_deg, _ in trace.readings
            if at_deg is not None and abs(at_deg - trace.from_deg) > STEADY_DEG and abs(goal_deg - at_deg) > ENDS_DEG
        ]
        if not behind_deg:
            return None
        found.append(float(np.mean(behind_deg)) - profile.velocity_dps * lag_s)
    return float(np.mean(found)) if found else None


def evaluate(stops: Sequence[Stop], held_deg: float = 0.0, creeps: Sequence[MoveTrace] = ()) -> Evaluation:
    """Fit frequency, damping and lag to the rates after ``stops``, and the friction to slow motions.

    ``held_deg`` is the distance from its goal at which the shaft rested; it counts if the slow motions say nothing.
    """
    found = Evaluation(name=NAME, residual_unit="σ", limit=MAX_RESIDUAL)
    used = [stop.since(DELAY_S) for stop in stops]
    hz, damping, lag_s = fitted = _fit(used)
    parts = [_parts(stop, *fitted) for stop in used]
    squares = np.square(_residuals(used, *fitted))
    noise_dps = sqrt(float(squares[np.concatenate([stop.time_s for stop in used]) > 0.8 * LISTEN_S].mean()))
    found.residual = residual = sqrt(float(squares.mean())) / noise_dps
    # the ringing of stops that ring: some distances, and stops downwards, leave little
    peak_dps = float(np.quantile([np.abs(ringing).max() for ringing, _, _ in parts], 0.75))
    tail_dps = float(np.median([np.abs(tail).max() for _, tail, _ in parts]))
    found.evidence = {"stops": len(stops), "noise_dps": noise_dps, "peak_dps": peak_dps, "tail_dps": tail_dps}
    if peak_dps < MIN_PEAK * noise_dps:
        return found.reject(RejectionCode.NO_RINGING, peak_dps=peak_dps, noise_dps=noise_dps)
    without = np.array([_fit([*used[:i], *used[i + 1 :]], fitted) for i in range(len(used))])
    sigma = np.sqrt((len(used) - 1) * without.var(axis=0))
    limit_hz = max(MAX_UNCERTAINTY, MAX_OF_DAMPING * damping) * hz
    if peak_dps < CLEAR_PEAK * noise_dps and sigma[0] > limit_hz:
        return found.reject(RejectionCode.NO_RINGING, peak_dps=peak_dps, noise_dps=noise_dps)
    lags = tail_dps > CLEAR_PEAK * noise_dps  # else its time is that of noise
    for index, (name, unit) in enumerate((("frequency", "Hz"), ("damping", ""), *((("lag", "s"),) if lags else ()))):
        scatter = Contribution("scatter of the stops (jackknife)", "A", float(sigma[index]), unit)
        found.estimate(name, fitted[index], unit, scatter)
    first = used[0]
    found.evidence["stop"] = {
        "time_s": first.time_s.round(4).tolist(),
        "rate_dps": first.rate_dps.round(3).tolist(),
        "model_dps": (first.rate_dps - _residuals([first], *fitted)).round(3).tolist(),
    }
    by_creeps = _held_deg(creeps, lag_s) if lags else None
    found.proposed = {
        "table.ringing_hz": round(hz, 3),
        "table.ringing_damping": round(damping, 4),
        "table.lag_s": round(lag_s, 4) if lags else 0.0,
        "table.held_deg": round(held_deg if by_creeps is None else by_creeps, 4),
    }
    found.reject_if(residual > MAX_RESIDUAL, RejectionCode.RINGING_UNCLEAR, residual=residual)
    found.reject_if(
        sigma[0] > limit_hz,
        RejectionCode.RINGING_UNCERTAIN,
        hz=hz,
        uncertainty_hz=float(sigma[0]),
        limit_hz=limit_hz,
    )
    return found


def _fit(stops: Sequence[Stop], start: tuple[float, float, float] | None = None) -> tuple[float, float, float]:
    """Return frequency, damping and lag; without a start, from the best of a grid."""
    if start is None:
        grid = [(float(hz), float(damping), lag_s) for hz in HZ for damping in DAMPING for lag_s in LAGS_S]
        start = min(grid, key=lambda at: float(np.square(_residuals(stops[:2], *at)).sum()))
    solved = least_squares(
        lambda p: _residuals(stops, *p),
        start,
        bounds=((1.0, 0.001, 0.005), (80.0, 0.9, 0.3)),
        x_scale=(start[0], 0.05, 0.02),
    )
    hz, damping, lag_s = solved.x.tolist()
    return hz, damping, lag_s


def _residuals(stops: Sequence[Stop], hz: float, damping: float, lag_s: float) -> Floats:
    """Return the deviations of all rates from the model with the best amplitudes and biases."""
    return np.concatenate([stop.rate_dps - sum(_parts(stop, hz, damping, lag_s)) for stop in stops])


def _parts(stop: Stop, hz: float, damping: float, lag_s: float) -> tuple[Floats, Floats, Floats]:
    """Return the parts of a stop's rate by the model: the ringing, the shaft's own motion, and the bias."""
    t = stop.time_s
    swing = np.exp(2 * pi * hz * complex(-damping, sqrt(1 - damping**2)) * t)
    design = np.column_stack([swing.real, swing.imag, np.exp(-t / lag_s), np.ones_like(t)])
    amounts = np.linalg.lstsq(design, stop.rate_dps, rcond=None)[0]
    return design[:, :2] @ amounts[:2], design[:, 2] * amounts[2], design[:, 3] * amounts[3]
