"""Measure the encoder's error over its revolution, with the gyro on the platter.

The magnet of an encoder sits a little off the shaft's axis and plane, so that the reading is wrong by a cosine and a
sine of the angle, and of twice the angle. The table makes whole revolutions in even steps, upwards, with the backlash
taken up. A step from the reading φ to ψ with the rotation G by the gyro reads

    E = s·G + e(ψ) − e(φ),    e(φ) = Σ aₖ·cos kφ + bₖ·sin kφ,  k = 1, 2

over the servo's own revolution: behind a gear the encoder repeats more often than the table.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor

import numpy as np
from numpy.typing import NDArray

from calibration.legs import COVERAGE, Leg, fit, reasons, reject_slipped_leg
from calibration.procedure import Evaluation, Measured, Procedure, returning, too_little_room
from rig.bench import Bench
from rig.calibrations import CalibrationResult, RejectionCode
from rig.charts.xy import MODEL, Axis, Chart, Series
from rig.core.json_form import plain
from rig.motion.turntable import Turntable
from rig.plans.steps import moved

NAME = "servo.encoder"

NAMES = ("cos1", "sin1", "cos2", "sin2")
STEPS_PER_REVOLUTION = 12  # the second harmonic needs five; more average the scatter of single rests
MIN_REVOLUTIONS = 1
MAX_ERROR_DEG = 2.0
"""Far above the error of intact encoders: more means that the magnet or the platter came off the shaft."""
MAX_UNCERTAINTY_DEG = 0.05  # half of an encoder count: less is not seen in the table's angle


@dataclass(frozen=True, slots=True)
class Step:
    """One step: the encoder's position (°, as the servo reads it) at its start and end, and both rotations."""

    from_deg: float
    to_deg: float
    leg: Leg


def plot(result: CalibrationResult) -> Chart | None:
    """Return a chart of the encoder's error over its revolution: the fit, and the values of the steps."""
    if not result.estimates:
        return None
    revolution_deg = result.evidence["turn_deg"]
    steps = [step for step in result.evidence["steps"] if not step["leg"]["invalid"]]
    values = np.array([result.estimates[name].value for name in NAMES])
    sigma = np.array([result.estimates[name].uncertainty for name in NAMES])
    phi = np.linspace(0.0, revolution_deg, 121)
    basis = _basis(phi, revolution_deg)
    encoder = np.array([step["leg"]["encoder_deg"] for step in steps])
    gyro = np.array([step["leg"]["gyro_deg"] for step in steps])
    # Over whole revolutions the encoder's error is zero, so the difference is the gyro's scale.
    error = np.cumsum(encoder - gyro * encoder.sum() / gyro.sum())
    sense = np.sign(steps[0]["to_deg"] - steps[0]["from_deg"]) * np.sign(encoder[0])
    to = np.array([step["to_deg"] for step in steps])
    seen = sense * error
    seen += float(np.mean(_basis(to, revolution_deg) @ values - seen))
    curve, band = basis @ values, 2 * np.sqrt(basis**2 @ sigma**2)
    low, high = (curve - band).tolist(), (curve + band).tolist()
    return Chart(
        "Error of the encoder over its revolution",
        Axis("position of the encoder, °", span=(0.0, revolution_deg)),
        Axis("error of the reading, °"),
        [
            Series("two harmonics", phi.tolist(), curve.tolist(), MODEL, False, True, low=low, high=high),
            Series("steps, summed up", np.mod(to, revolution_deg).tolist(), seen.tolist()),
        ],
    )


@dataclass(frozen=True)
class Encoder(Procedure):
    """A procedure that measures the encoder's error over ``revolutions`` of the table, in even steps upwards."""

    result_name, devices, valid_days, plots = NAME, ("servo", "imu"), 365, (plot,)
    reference = "whole revolutions of the platter, divided by the gyro"
    revolutions: int

    def measure(self, bench: Bench, *_: CalibrationResult) -> Measured:
        config, revolution_deg = bench.config.table, bench.servo.revolution_deg
        low, high = config.limits_deg
        first_deg = low + config.approach_deg
        possible = floor((high - first_deg) / 360.0)
        if possible < MIN_REVOLUTIONS:
            raise too_little_room(bench, "a whole revolution and table.approach_deg")
        sweep = min(possible, self.revolutions)
        middle = max(first_deg, min(-180.0 * sweep, high - 360.0 * sweep))
        # Behind a gear the encoder repeats more often than the table: the steps divide its own revolution.
        step_deg = revolution_deg / STEPS_PER_REVOLUTION if revolution_deg < 360.0 else 360.0 / STEPS_PER_REVOLUTION
        steps: list[Step] = []
        with Turntable(bench) as table, returning(table) as goto:
            reference = bench.safety.angle_reference
            for _sweep in range(ceil(self.revolutions / sweep)):
                yield moved(len(steps), goto(middle))
                for index in range(1, STEPS_PER_REVOLUTION * sweep + 1):
                    before = reference.to_servo(table.rest_deg)
                    move = goto(middle + index * step_deg)
                    after = reference.to_servo(table.rest_deg)
                    leg = Leg.of(move, bench.config.imu)
                    # The servo's own reading, without the correction in force.
                    raw = Leg(config.direction * (after - before), leg.gyro_deg, leg.sigma_deg, leg.invalid)
                    steps.append(Step(before, after, raw))
                    yield moved(len(steps), move)
        resolution_deg = bench.servo.resolution_deg
        return evaluate(steps, direction=config.direction, revolution_deg=revolution_deg, resolution_deg=resolution_deg)


def evaluate(steps: Sequence[Step], *, direction: int, revolution_deg: float, resolution_deg: float) -> Evaluation:
    """Fit the harmonics to consecutive ``steps`` over whole revolutions.

    ``direction`` is that of the table relative to the servo, ``revolution_deg`` the table's angle of one revolution of
    the encoder, ``resolution_deg`` that of one count.
    """
    evidence = {"steps": plain(list(steps)), "turn_deg": revolution_deg}
    found = Evaluation(name=NAME, residual_unit="°", evidence=evidence)
    used = [step for step in steps if not step.leg.invalid]
    if len(used) < STEPS_PER_REVOLUTION:
        why = reasons([step.leg for step in steps])
        return found.reject(RejectionCode.TOO_FEW_STEPS, used=len(used), needed=STEPS_PER_REVOLUTION, reasons=why)
    gyro = np.array([step.leg.gyro_deg for step in used])
    basis = _basis(np.array([s.to_deg for s in used]), revolution_deg) - _basis(
        np.array([s.from_deg for s in used]), revolution_deg
    )
    fitted = fit([s.leg for s in used], np.column_stack([gyro, direction * basis]), resolution_deg)
    found.residual = abs(float(fitted.residuals_deg[fitted.worst]))
    found.limit = COVERAGE * float(fitted.residual_sigma_deg[fitted.worst])
    for number, name in enumerate(NAMES, 1):  # the first parameter is the gyro's scale
        found.estimate(name, fitted.values[number], "°", *fitted.budget(number, "°"))
    found.proposed = {"table.encoder_harmonics_deg": [round(float(value), 4) for value in fitted.values[1:]]}

    largest = float(np.abs(_basis(np.linspace(0.0, revolution_deg, 361), revolution_deg) @ fitted.values[1:]).max())
    reject_slipped_leg(found, steps.index(used[fitted.worst]) + 1)
    found.reject_above(MAX_ERROR_DEG, RejectionCode.ENCODER_ERROR_TOO_LARGE, error_deg=largest)
    uncertainty = max(one.uncertainty for one in found.estimates.values())
    found.reject_above(MAX_UNCERTAINTY_DEG, RejectionCode.ENCODER_UNCERTAIN, uncertainty_deg=uncertainty)
    return found


def _basis(position_deg: NDArray[np.float64], revolution_deg: float) -> NDArray[np.float64]:
    """Return cosine and sine of the first two harmonics, float64 (n, 4)."""
    angle = np.radians(position_deg * 360.0 / revolution_deg)
    return np.column_stack([np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)])
