"""How long the table takes: pace, wind-up and delay, from moves over many distances.

A move by Δ until the table is at rest takes, with the cruise speed v, the ramp a and the delay d (the servo's answer,
the ringing, and being sure that it is over)

    t = |Δ|/v + v/a + d        where |Δ| ≥ v²/a,        else        t = 2·√(|Δ|/a) + d

so that the pace is 1/v and the wind-up v/a.
"""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calibration.backlash import plain_approach
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Estimate
from rig.charts.xy import MODEL, Axis, Chart, Series
from rig.core.errors import LimitExceeded, UsageError
from rig.devices.servo import MotionProfile
from rig.events.events import Moved, plain
from rig.motion.turntable import Turntable
from rig.plans.capture import moved

NAME = "servo.motion"
VALID_DAYS = 180

DISTANCES_DEG = (2.0, 5.0, 10.0, 20.0, 45.0, 90.0, 180.0)
MIN_ROUNDS = 2
TYPICAL_S = 0.04
"""Scatter of a settle time: the period of the control loop."""
NOMINAL_TRUST = 0.3
MAX_RESIDUAL_S = 0.25
"""A move that is off by more was hindered: six periods of the control loop."""


@dataclass(frozen=True, slots=True)
class Timed:
    """A move: its length, and the time until the table was at rest."""

    distance_deg: float
    seconds: float


def live(bench: Bench, *, rounds: int = 3) -> Generator[Moved | CalibrationResult, None, CalibrationResult]:
    """Time moves over seven distances, both ways, ``rounds`` times; yields each move, then the fact.

    Raises
    ------
    UsageError
        Too few rounds.
    LimitExceeded
        The cable leaves no room; before anything moves.
    MotionTimeout, DeviceFault, DeviceSilent
        See `rig.motion.turntable`.
    """
    if rounds < MIN_ROUNDS:
        raise UsageError(f"{rounds} rounds are too few.", next_step=f"Give at least {MIN_ROUNDS}.")
    when_utc = bench.clock.utc()
    low, high = bench.config.table.limits_deg
    moves: list[Timed] = []
    with plain_approach(bench), Turntable(bench) as table:
        start_deg = table.rest_deg
        base_deg = start_deg if start_deg + DISTANCES_DEG[-1] <= high else start_deg - DISTANCES_DEG[-1]
        if base_deg < low:
            raise LimitExceeded(
                f"The cable leaves {high - low:.0f}°, the procedure needs {DISTANCES_DEG[-1]:g}°.",
                next_step="Where the cable allows it, widen table.limits_deg.",
                evidence={"limits_deg": [low, high]},
            )
        may_return = True
        try:
            for index, goal_deg in enumerate(
                goal for _ in range(rounds) for distance in DISTANCES_DEG for goal in (base_deg + distance, base_deg)
            ):
                may_return = False
                before_deg = table.rest_deg
                move = table.goto(goal_deg)
                may_return = True
                if abs(goal_deg - before_deg) > 1.0:
                    moves.append(Timed(goal_deg - before_deg, move.seconds))
                yield moved(index, move)
        finally:
            if may_return:
                table.goto(start_deg)
    nominal = MotionProfile(bench.config.table.velocity_dps, bench.config.table.acceleration_dps2)
    fact = from_data(moves, nominal, when_utc=when_utc, device=bench.apparatus("servo"))
    yield fact
    return fact


def predicted_s(fact: CalibrationResult, distance_deg: float) -> float:
    """Return the time that a move by ``distance_deg`` takes until the table is at rest."""
    model = np.array([fact.estimates[name].value for name in ("pace", "wind_up", "delay")])
    return float(_seconds(model, np.array([abs(distance_deg)]))[0])


def from_data(
    moves: Sequence[Timed], nominal: MotionProfile, *, when_utc: datetime, device: Mapping[str, Any]
) -> CalibrationResult:
    """Fit the model to ``moves`` robustly and judge it.

    Steep ramps are over before they can be timed, and wind-up and delay told apart: the ``nominal`` profile says what
    the wind-up may be, to 30 %.
    """
    wind_up_s = nominal.velocity_dps / nominal.acceleration_dps2
    distance = np.abs([move.distance_deg for move in moves])
    seconds = np.array([move.seconds for move in moves])
    fit = least_squares(
        lambda p: np.append(
            _seconds(p, distance) - seconds, TYPICAL_S * (p[1] - wind_up_s) / (NOMINAL_TRUST * wind_up_s)
        ),
        x0=(1 / nominal.velocity_dps, wind_up_s, 0.5),
        bounds=((1e-3, 1e-3, 0.0), (1.0, 20.0, 10.0)),
        x_scale=(0.01, 0.3, 0.3),
        loss="soft_l1",
        f_scale=TYPICAL_S,
    )
    residuals = seconds - _seconds(fit.x, distance)
    scatter = sqrt(float((residuals**2).sum()) / (len(moves) - 3))
    covariance = np.linalg.inv(fit.jac.T @ fit.jac) * scatter**2
    estimates = {
        name: Estimate(float(value), sqrt(float(variance)), unit)
        for name, value, variance, unit in zip(
            ("pace", "wind_up", "delay"), fit.x, np.diag(covariance), ("s/°", "s", "s"), strict=True
        )
    }
    worst = int(np.argmax(np.abs(residuals)))
    residual = abs(float(residuals[worst]))
    refusals = []
    if residual > MAX_RESIDUAL_S:
        refusals.append(
            f"The move by {moves[worst].distance_deg:.0f}° took {seconds[worst]:.2f} s, {residual:.2f} s off the "
            "others: something hindered it, or shook the bench. Look at cable and platter, and calibrate again."
        )
    return CalibrationResult(
        name=NAME,
        estimates=estimates,
        residual=residual,
        limit=MAX_RESIDUAL_S,
        residual_unit="s",
        refusals=tuple(refusals),
        settings={} if refusals else {"table.settle_s": round(estimates["delay"].value, 3)},
        valid_days=VALID_DAYS,
        when_utc=when_utc,
        device=device,
        evidence={"moves": plain(list(moves)), "scatter_s": scatter},
    )


def plot(fact: CalibrationResult) -> Chart | None:
    """Return the time of each move over its length, and the model."""
    if not fact.estimates:
        return None
    moves = fact.evidence["moves"]
    model = np.array([fact.estimates[name].value for name in ("pace", "wind_up", "delay")])
    lengths = [abs(move["distance_deg"]) for move in moves]
    distance = np.linspace(0.5, max(lengths), 121)
    return Chart(
        "Time until the table is at rest",
        Axis("length of the move, °", span=(0.0,)),
        Axis("seconds", span=(0.0,)),
        [
            Series("model", distance.tolist(), _seconds(model, distance).tolist(), MODEL, dots=False, curve=True),
            Series("measured", lengths, [move["seconds"] for move in moves]),
        ],
    )


def _seconds(p: NDArray[np.float64], distance: NDArray[np.float64]) -> NDArray[np.float64]:
    pace, wind_up, delay = p
    ramps_only = distance * pace < wind_up
    moving = np.where(ramps_only, 2 * np.sqrt(distance * pace * wind_up), distance * pace + wind_up)
    return np.asarray(moving + delay, dtype=np.float64)
