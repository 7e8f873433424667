"""Measure the scale of the gyro about the table's axis, against whole revolutions of the servo's encoder.

A whole revolution ends on the encoder count where it began, so that the ratio contains neither the encoder's harmonic
error nor the eccentricity of its magnet. Equal numbers of revolutions in both directions cancel an even drift of the
bias:

    s = Σ w·E·G / Σ w·G²,    w = 1/σ²,    σ² = σ_gyro² + σ_encoder²

with the rotations E by the encoder and G by the gyro, without a scale. The tilt of the sensor relative to the axis (a
factor of its cosine) and the error of its sample clock are part of s. Whole revolutions do not distinguish a scale from
a platter that slips by the same share on every leg.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor, hypot, sqrt

import numpy as np
from numpy.typing import NDArray

from calibration.legs import COVERAGE, Leg, fit, reasons, reject_slipped_leg
from calibration.procedure import Evaluation, Measured, Procedure, returning, too_little_room
from rig.bench import Bench
from rig.calibrations import CalibrationResult, RejectionCode
from rig.charts.xy import MEASURED, MODEL, OTHER, Axis, Chart, Series
from rig.core.json_form import plain
from rig.motion.turntable import Turntable
from rig.plans.steps import moved
from rig.safety.gyro_rotation import DRAIN_S, MEMORY_S

NAME = "imu.scale"

MIN_LEGS = 2
"""Smallest number of legs in each direction, so that they can contradict each other."""
MAX_LEG_REVOLUTIONS = 2
"""Longest leg; longer ones do not help, because the bias from the rest before drifts."""
PLAUSIBLE = (0.9, 1.1)
"""±3 % from part to part, ±2 % over temperature (PS-MPU-6000A, 6.1), a mounting tilted by up to 15°."""
MAX_UNCERTAINTY = 0.001
"""Uncertainty with which a rotation by 90° is known to a tenth of a degree."""


def plot(result: CalibrationResult) -> Chart | None:
    """Return a chart of the ratio of encoder to gyro for each leg, and of the scale."""
    legs = [(i + 1, leg) for i, leg in enumerate(result.evidence["legs"]) if not leg["invalid"] and leg["gyro_deg"]]
    if not legs or not result.estimates:
        return None
    scale = result.estimates["scale"]
    percent = [(i, 100 * (leg["encoder_deg"] / leg["gyro_deg"] - 1), leg["encoder_deg"] > 0) for i, leg in legs]
    ends, level = [legs[0][0], legs[-1][0]], 100 * (scale.value - 1)
    low, high = [level - 200 * scale.uncertainty] * 2, [level + 200 * scale.uncertainty] * 2
    return Chart(
        "Scale of the gyro, from whole revolutions",
        Axis("leg", whole=True),
        Axis("encoder beyond gyro, %"),
        [
            Series(f"scale {scale.value:.5f}", ends, [level] * 2, MODEL, False, True, low=low, high=high),
            *(
                Series(
                    words, [i for i, _, up in percent if up is way], [p for _, p, up in percent if up is way], colour
                )
                for words, way, colour in (("upwards", True, MEASURED), ("downwards", False, OTHER))
            ),
        ],
    )


@dataclass(frozen=True)
class GyroScale(Procedure):
    """A procedure that measures the gyro's scale by at least ``revolutions`` whole revolutions."""

    result_name, devices, plots = NAME, ("servo", "imu"), (plot,)
    reference = "whole revolutions of the servo's encoder"
    valid_days = 180
    """Half a year, to notice a loose sensor; the scale changes by mounting and temperature, not by use."""
    revolutions: int

    def measure(self, bench: Bench, *_: CalibrationResult) -> Measured:
        low_deg, high_deg = bench.config.table.limits_deg
        # Downwards the table overshoots its goal and comes back, so that every rest has the backlash on the same side.
        low_deg += bench.config.table.approach_deg
        possible = floor((high_deg - low_deg) / 360)
        if possible < 1:
            raise too_little_room(bench, "a whole revolution and table.approach_deg")
        leg_revolutions = min(possible, MAX_LEG_REVOLUTIONS, self.revolutions // (2 * MIN_LEGS))
        first_deg = (low_deg + high_deg - 360.0 * leg_revolutions) / 2
        ends_deg = first_deg, first_deg + 360.0 * leg_revolutions
        each_way = max(ceil(self.revolutions / leg_revolutions / 2), MIN_LEGS)
        legs: list[Leg] = []
        with Turntable(bench, trust_gyro=False) as table, returning(table) as goto:
            for index in range(1 + 2 * each_way):
                _rest(table, bench)
                move = goto(ends_deg[index % 2])
                if index:  # the first rotation runs through the backlash
                    legs.append(Leg.of(move, bench.config.imu))
                yield moved(index, move)
        return evaluate(legs, resolution_deg=bench.servo.resolution_deg)


def evaluate(legs: Sequence[Leg], *, resolution_deg: float) -> Evaluation:
    """Fit the scale to ``legs``.

    ``legs`` are whole revolutions, alternately up and down; each begins at the rest where the previous one ended. A
    rest lies anywhere within ``resolution_deg``, the angle of one encoder count.
    """
    found = Evaluation(name=NAME, residual_unit="°", evidence={"legs": plain(list(legs))})
    used = [leg for leg in legs if not leg.invalid]
    encoder = np.array([leg.encoder_deg for leg in used])
    gyro = np.array([leg.gyro_deg for leg in used])
    # A leg has two rests, each uniform within a count: variance 2·count²/12. Neighbouring legs share a rest with
    # opposite signs, so that its error counts twice in the ratio: the variance is twice as large.
    sigma = np.hypot([leg.sigma_deg for leg in used], resolution_deg / sqrt(3))
    up = encoder > 0
    upwards, downwards = int(up.sum()), int((~up).sum())
    if min(upwards, downwards) < MIN_LEGS:
        return found.reject(
            RejectionCode.TOO_FEW_REVOLUTIONS, up=upwards, down=downwards, needed=MIN_LEGS, reasons=reasons(legs)
        )
    if not PLAUSIBLE[0] < (ratio := float(np.median(gyro / encoder))) < PLAUSIBLE[1]:
        return found.reject(RejectionCode.GYRO_IMPLAUSIBLE, ratio=ratio)
    fitted = fit(used, gyro[:, None], resolution_deg)
    value, unit = float(fitted.values[0]), "true °/s per °/s read"
    uncertainty = found.estimate("scale", value, unit, *fitted.budget(0, unit)).uncertainty
    residuals = np.abs(encoder - value * gyro)
    worst = int(np.argmax(residuals / sigma))
    found.residual, found.limit = float(residuals[worst]), COVERAGE * float(sigma[worst])
    found.proposed = {NAME: value, f"{NAME}_uncertainty": uncertainty}
    (value_up, sigma_up), (value_down, sigma_down) = (_ratio(encoder[way], gyro[way], sigma[way]) for way in (up, ~up))
    found.evidence |= {"scale_up": value_up, "scale_down": value_down}

    reject_slipped_leg(found, legs.index(used[worst]) + 1)
    found.reject_if(
        abs(value_up - value_down) > COVERAGE * hypot(sigma_up, sigma_down),
        RejectionCode.DIRECTIONS_DIFFER,
        up=value_up,
        down=value_down,
    )
    found.reject_above(MAX_UNCERTAINTY, RejectionCode.SCALE_UNCERTAIN, uncertainty=uncertainty)
    return found


def _rest(table: Turntable, bench: Bench) -> None:
    """Wait at rest as long as the gyro needs for its bias, the largest part of its uncertainty."""
    for _ in range(round(MEMORY_S / DRAIN_S)):
        bench.clock.sleep(DRAIN_S)
        table.check_still()


def _ratio(encoder: NDArray[np.float64], gyro: NDArray[np.float64], sigma: NDArray[np.float64]) -> tuple[float, float]:
    """Return the slope of encoder over gyro, a line through the origin, and its standard uncertainty."""
    weight = 1 / sigma**2
    norm = float((weight * gyro**2).sum())
    return float((weight * encoder * gyro).sum()) / norm, 1 / sqrt(norm)
