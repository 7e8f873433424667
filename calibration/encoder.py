"""What the encoder reads too much over its turn, by the gyro on the platter.

The magnet of an encoder sits a little off the shaft's axis, and off its plane, so that its reading is wrong by a cosine
and a sine of the angle, and of twice the angle. Whole turns in even steps, upwards, with the play taken up: a step from
the reading φ to ψ, of the rotation G by the gyro, reads

    E = s·G + e(ψ) − e(φ),    e(φ) = Σ aₖ·cos kφ + bₖ·sin kφ,  k = 1, 2

over the servo's own turn: behind a gear it comes round more often than the table does.
"""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from math import ceil, floor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.legs import COVERAGE, Leg, fit
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Estimate
from rig.charts.xy import MODEL, Axis, Chart, Series
from rig.core.errors import LimitExceeded, UsageError
from rig.events.events import Moved, plain
from rig.motion.turntable import Turntable
from rig.plans.capture import moved

NAME = "servo.encoder"
VALID_DAYS = 365

NAMES = ("cos1", "sin1", "cos2", "sin2")
STEPS_PER_TURN = 12
MIN_TURNS = 1
MAX_ERROR_DEG = 2.0
"""Encoders of healthy servos stay far below: more is a magnet that came off, or a platter off its shaft."""
MAX_UNCERTAINTY_DEG = 0.05


@dataclass(frozen=True, slots=True)
class Step:
    """One step: the encoder's position (°, as the servo reads it) where it began and ended, and both rotations."""

    from_deg: float
    to_deg: float
    leg: Leg


def live(bench: Bench, *, turns: int = 2) -> Generator[Moved | CalibrationResult, None, CalibrationResult]:
    """Measure the encoder's error over ``turns`` of the table, in even steps upwards; yields each move, then the fact.

    Raises
    ------
    UsageError
        Fewer than one turn.
    LimitExceeded
        The cable does not reach; before anything moves.
    MotionTimeout, DeviceFault, DeviceSilent
        See `rig.motion.turntable`.
    """
    if turns < MIN_TURNS:
        raise UsageError(f"{turns} turns are too few.", next_step="Give at least one.")
    when_utc, imu, table_config = bench.clock.utc(), bench.config.imu, bench.config.table
    low, high = table_config.limits_deg
    first_deg = low + table_config.approach_deg
    possible = floor((high - first_deg) / 360.0)
    if possible < MIN_TURNS:
        raise LimitExceeded(
            f"The cable leaves {high - low:.0f}°, the procedure needs a whole turn and table.approach_deg.",
            next_step="Where the cable allows it, widen table.limits_deg.",
            evidence={"limits_deg": [low, high]},
        )
    sweep = min(possible, turns)
    sweeps = ceil(turns / sweep)
    middle = max(first_deg, min(-180.0 * sweep, high - 360.0 * sweep))
    # Behind a gear the encoder turns more often than the table: its own turn is what is stepped through.
    step_deg = bench.servo.turn_deg / STEPS_PER_TURN if bench.servo.turn_deg < 360.0 else 360.0 / STEPS_PER_TURN
    steps: list[Step] = []
    with Turntable(bench) as table:
        reference = bench.safety.angle_reference
        start_deg = table.rest_deg
        may_return = True
        try:
            for _ in range(sweeps):
                may_return = False
                yield moved(len(steps), table.goto(middle))
                for index in range(1, STEPS_PER_TURN * sweep + 1):
                    before = reference.to_servo(table.rest_deg)
                    may_return = False
                    move = table.goto(middle + index * step_deg)
                    may_return = True
                    after = reference.to_servo(table.rest_deg)
                    leg = Leg.of(move, imu)
                    # As the servo itself reads: without the correction that is in force.
                    direction = table_config.direction
                    raw = Leg(direction * (after - before), leg.gyro_deg, leg.sigma_deg, leg.trouble)
                    steps.append(Step(before, after, raw))
                    yield moved(len(steps), move)
        finally:
            if may_return:
                table.goto(start_deg)
    fact = from_data(
        steps,
        direction=table_config.direction,
        turn_deg=bench.servo.turn_deg,
        resolution_deg=bench.servo.resolution_deg,
        when_utc=when_utc,
        device=bench.apparatus("servo", "imu"),
    )
    yield fact
    return fact


def from_data(
    steps: Sequence[Step],
    *,
    direction: int,
    turn_deg: float,
    resolution_deg: float,
    when_utc: datetime,
    device: Mapping[str, Any],
) -> CalibrationResult:
    """Fit the harmonics to ``steps`` and judge them.

    Parameters
    ----------
    steps
        Consecutive ones, over whole turns.
    direction
        Of the table against the servo.
    turn_deg
        The table's angle of one turn of the encoder.
    resolution_deg
        Angle of one encoder count.
    when_utc, device
        Kept with the fact.
    """
    used = [step for step in steps if not step.leg.trouble]
    refusals: list[str] = []
    estimates: dict[str, Estimate] = {}
    harmonics: tuple[float, ...] = ()
    residual = limit = None
    if len(used) < STEPS_PER_TURN:
        troubles = "".join(f"; {step.leg.trouble}" for step in steps if step.leg.trouble)
        refusals.append(f"Only {len(used)} steps can be used, {STEPS_PER_TURN} are needed{troubles}.")
    else:
        gyro = np.array([step.leg.gyro_deg for step in used])
        basis = _basis(np.array([s.to_deg for s in used]), turn_deg) - _basis(
            np.array([s.from_deg for s in used]), turn_deg
        )
        fitted = fit([s.leg for s in used], np.column_stack([gyro, direction * basis]), resolution_deg)
        residual = abs(float(fitted.residuals_deg[fitted.worst]))
        limit = COVERAGE * float(fitted.residual_sigma_deg[fitted.worst])
        harmonics = tuple(round(float(value), 4) for value in fitted.values[1:])
        estimates = {
            name: Estimate(float(value), float(sigma), "°")
            for name, value, sigma in zip(NAMES, fitted.values[1:], fitted.sigma[1:], strict=True)
        }
        largest = float(np.abs(_basis(np.linspace(0.0, turn_deg, 361), turn_deg) @ fitted.values[1:]).max())
        if residual > limit:
            refusals.append(
                f"Step {fitted.worst + 1} is off by {residual:.2f}°, above {limit:.2f}°: the platter slipped or was "
                "touched. Tighten it, keep hands off, and calibrate again."
            )
        if largest > MAX_ERROR_DEG:
            refusals.append(
                f"The encoder seems wrong by up to {largest:.1f}°, above {MAX_ERROR_DEG:g}°: no sound one is. Look for "
                "a platter that is loose on its shaft, or a sensor that shifts."
            )
        if (uncertainty := float(fitted.sigma[1:].max())) > MAX_UNCERTAINTY_DEG:
            refusals.append(
                f"The harmonics are uncertain by {uncertainty:.3f}°, more than {MAX_UNCERTAINTY_DEG:g}°: give more "
                "--turns, and keep vibration off the bench."
            )
    return CalibrationResult(
        name=NAME,
        estimates=estimates,
        residual=residual,
        limit=limit,
        residual_unit="°",
        refusals=tuple(refusals),
        settings={} if refusals else {"table.encoder_harmonics_deg": list(harmonics)},
        valid_days=VALID_DAYS,
        when_utc=when_utc,
        device=device,
        evidence={"steps": plain(list(steps)), "turn_deg": turn_deg},
    )


def plot(fact: CalibrationResult) -> Chart | None:
    """Return the encoder's error over its turn, as fitted and as the steps show it."""
    if not fact.estimates:
        return None
    turn_deg = fact.evidence["turn_deg"]
    steps = [step for step in fact.evidence["steps"] if not step["leg"]["trouble"]]
    values = np.array([fact.estimates[name].value for name in NAMES])
    sigma = np.array([fact.estimates[name].uncertainty for name in NAMES])
    phi = np.linspace(0.0, turn_deg, 121)
    basis = _basis(phi, turn_deg)
    encoder = np.array([step["leg"]["encoder_deg"] for step in steps])
    gyro = np.array([step["leg"]["gyro_deg"] for step in steps])
    # Whole turns: over them the error is nil, and what is left is the gyro's scale.
    error = np.cumsum(encoder - gyro * encoder.sum() / gyro.sum())
    sense = np.sign(steps[0]["to_deg"] - steps[0]["from_deg"]) * np.sign(encoder[0])
    to = np.array([step["to_deg"] for step in steps])
    seen = sense * error
    seen += float(np.mean(_basis(to, turn_deg) @ values - seen))
    fit, band = basis @ values, 2 * np.sqrt(basis**2 @ sigma**2)
    return Chart(
        "Error of the encoder over its revolution",
        Axis("position of the encoder, °", span=(0.0, turn_deg)),
        Axis("reads too much, °"),
        [
            Series(
                "two harmonics",
                phi.tolist(),
                fit.tolist(),
                MODEL,
                dots=False,
                curve=True,
                low=(fit - band).tolist(),
                high=(fit + band).tolist(),
            ),
            Series("steps, summed up", np.mod(to, turn_deg).tolist(), seen.tolist()),
        ],
    )


def _basis(position_deg: NDArray[np.float64], turn_deg: float) -> NDArray[np.float64]:
    """Return cosine and sine of the first two harmonics, float64 (n, 4)."""
    turn = np.radians(position_deg * 360.0 / turn_deg)
    return np.column_stack([np.cos(turn), np.sin(turn), np.cos(2 * turn), np.sin(2 * turn)])
