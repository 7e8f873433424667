"""Measure the duration of rotations: pace, wind-up and delay, from rotations over many distances.

A rotation by Δ until the table stands still takes, with the cruise speed v, the ramp a and the delay d (the servo's
answer, the ringing, and the settling time)

    t = |Δ|/v + v/a + d    if |Δ| ≥ v²/a,    otherwise    t = 2·√(|Δ|/a) + d

so that the pace is 1/v and the wind-up v/a.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calibration.procedure import (
    Evaluation,
    Measured,
    Procedure,
    lower_end,
    require_at_least,
    returning,
)
from rig.bench import Bench
from rig.calibrations import CalibrationResult, RejectionCode
from rig.charts.xy import MODEL, Axis, Chart, Series
from rig.core.json_form import plain
from rig.devices.servo import MotionProfile
from rig.motion.turntable import Turntable
from rig.plans.steps import moved

NAME = "servo.motion"

# short ones give the delay, middle ones the ramps, long ones the speed
DISTANCES_DEG = (2.0, 5.0, 10.0, 20.0, 45.0, 90.0, 180.0)
MIN_ROUNDS = 2  # one round has no scatter
TYPICAL_S = 0.04
"""Scatter of a settling time: the period of the control loop."""
NOMINAL_TRUST = 0.3  # smaller: the fit returns the configuration; larger: ramp and delay cannot be separated
MAX_RESIDUAL_S = 0.25
"""Largest residual of a rotation that nothing obstructed: six periods of the control loop."""
PARAMETERS = {"pace": "s/°", "wind_up": "s", "delay": "s"}


@dataclass(frozen=True, slots=True)
class TimedMove:
    """A rotation: its length, and the time until the table stood still."""

    distance_deg: float
    seconds: float


def plot(result: CalibrationResult) -> Chart | None:
    """Return a chart of the time of each rotation over its length, and of the model."""
    if not result.estimates:
        return None
    moves = result.evidence["moves"]
    model = np.array([result.estimates[name].value for name in PARAMETERS])
    lengths = [abs(move["distance_deg"]) for move in moves]
    distance = np.linspace(0.5, max(lengths), 121)
    return Chart(
        "Time until the table stands still",
        Axis("length of the rotation, °", span=(0.0,)),
        Axis("seconds", span=(0.0,)),
        [
            Series("model", distance.tolist(), seconds_of(model, distance).tolist(), MODEL, dots=False, curve=True),
            Series("measured", lengths, [move["seconds"] for move in moves]),
        ],
    )


@dataclass(frozen=True)
class MotionModel(Procedure):
    """A procedure that measures the time of rotations over seven distances in both directions, ``rounds`` times."""

    names, title, devices, valid_days, plots = (NAME,), "duration of rotations", ("servo",), 180, (plot,)
    rounds: int

    def __post_init__(self) -> None:
        require_at_least(MIN_ROUNDS, self.rounds, "rounds")

    def measure(self, bench: Bench, *_: CalibrationResult) -> Measured:
        moves: list[TimedMove] = []
        with Turntable(bench, approach_deg=0.0) as table:
            base_deg = lower_end(bench, table.rest_deg, DISTANCES_DEG[-1])
            with returning(table) as goto:
                ends = (goal for distance in DISTANCES_DEG * self.rounds for goal in (base_deg + distance, base_deg))
                for index, goal_deg in enumerate(ends):
                    before_deg = table.rest_deg
                    move = goto(goal_deg)
                    if abs(goal_deg - before_deg) > 1.0:
                        moves.append(TimedMove(goal_deg - before_deg, move.seconds))
                    yield moved(index, move)
        yield evaluate(moves, MotionProfile(bench.config.table.velocity_dps, bench.config.table.acceleration_dps2))


def evaluate(moves: Sequence[TimedMove], nominal: MotionProfile) -> Evaluation:
    """Fit the model to ``moves`` robustly.

    Steep ramps are too short to be distinguished from the delay: the wind-up of the ``nominal`` profile enters the
    fit as known to 30 %.
    """
    found = Evaluation(name=NAME, residual_unit="s", limit=MAX_RESIDUAL_S)
    wind_up_s = nominal.velocity_dps / nominal.acceleration_dps2
    distance = np.abs([move.distance_deg for move in moves])
    seconds = np.array([move.seconds for move in moves])
    fit = least_squares(
        lambda p: np.append(
            seconds_of(p, distance) - seconds, TYPICAL_S * (p[1] - wind_up_s) / (NOMINAL_TRUST * wind_up_s)
        ),
        x0=(1 / nominal.velocity_dps, wind_up_s, 0.5),
        bounds=((1e-3, 1e-3, 0.0), (1.0, 20.0, 10.0)),
        x_scale=(0.01, 0.3, 0.3),
        loss="soft_l1",
        f_scale=TYPICAL_S,
    )
    # Uncertainties from the scatter of the moves themselves; one that something hindered is rejected.
    residuals = seconds - seconds_of(fit.x, distance)
    scatter = sqrt(float((residuals**2).sum()) / (len(moves) - 3))
    covariance = np.linalg.inv(fit.jac.T @ fit.jac) * scatter**2
    for (name, unit), value, variance in zip(PARAMETERS.items(), fit.x, np.diag(covariance), strict=True):
        found.estimate(name, value, sqrt(float(variance)), unit)
    found.evidence = {"moves": plain(list(moves)), "scatter_s": scatter}
    worst = int(np.argmax(np.abs(residuals)))
    found.residual = abs(float(residuals[worst]))
    found.reject_if(
        found.residual > MAX_RESIDUAL_S,
        RejectionCode.MOVE_HINDERED,
        distance_deg=moves[worst].distance_deg,
        seconds=seconds[worst],
        residual_s=found.residual,
    )
    return found


def seconds_of(p: NDArray[np.float64], distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the times of rotations by ``distance`` degrees, with the values ``p`` of `PARAMETERS`."""
    pace, wind_up, delay = p
    ramps_only = distance * pace < wind_up
    moving = np.where(ramps_only, 2 * np.sqrt(distance * pace * wind_up), distance * pace + wind_up)
    return np.asarray(moving + delay, dtype=np.float64)
