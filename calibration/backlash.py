"""Measure the backlash between servo shaft and platter, and the sense and ratio of the servo, with the platter's gyro.

The table rotates up and down alternately. At each reversal the shaft first rotates through the backlash while the
platter stands still. Therefore the gyro measures less than the encoder by the full backlash b, for any length of the
leg:

    E = s·G + b·sign(E)

with the rotations E by the encoder and G by the gyro. Short legs determine b, long legs the ratio s, which must be near
1: another ratio means a wrong gear ratio, a negative one a wrong direction.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.legs import COVERAGE, Leg, fit, reasons, reject_slipped_leg
from calibration.procedure import (
    Evaluation,
    Measured,
    Procedure,
    lower_end,
    returning,
)
from rig.bench import Bench
from rig.calibrations import CalibrationResult, RejectionCode
from rig.charts.xy import MODEL, Axis, Chart, Series
from rig.core.json_form import plain
from rig.motion.turntable import Turntable
from rig.plans.steps import moved

NAME = "servo.backlash"

# The short legs are mostly backlash, the long ones mostly ratio: together they separate both.
SHORT_DEG, LONG_DEG = 6.0, 60.0
MIN_REVERSALS = 6  # three in each direction: fewer do not show a scatter
RATIO = (0.9, 1.1)
"""Range of ratios of a sound gyro and the right gear ratio (see `calibration.gyro_scale.PLAUSIBLE`)."""
MAX_BACKLASH_DEG = 2.0
"""Eight times the backlash of an XL430's gears: more is a loose horn or coupling."""
MAX_UNCERTAINTY_DEG = 0.03  # a third of an encoder count: less is not seen in the table's angle


def plot(result: CalibrationResult) -> Chart | None:
    """Return a chart of the rotation that each reversal lost beyond the fitted ratio: the backlash."""
    if "backlash" not in result.estimates:
        return None
    backlash, ratio = result.estimates["backlash"], result.estimates["ratio"].value
    legs = [(i + 1, leg) for i, leg in enumerate(result.evidence["legs"]) if not leg["invalid"]]
    lost = [(leg["encoder_deg"] - ratio * leg["gyro_deg"]) * np.sign(leg["encoder_deg"]) for _, leg in legs]
    ends = [legs[0][0], legs[-1][0]]
    low, high = backlash.value - 2 * backlash.uncertainty, backlash.value + 2 * backlash.uncertainty
    return Chart(
        "Backlash of the gears",
        Axis("reversal", whole=True),
        Axis("encoder beyond gyro, °", span=(0.0,)),
        [
            Series(
                f"backlash {backlash}", ends, [backlash.value] * 2, MODEL, False, True, low=[low] * 2, high=[high] * 2
            ),
            Series("measured", [i for i, _ in legs], lost),
        ],
    )


@dataclass(frozen=True)
class Backlash(Procedure):
    """A procedure that measures the backlash by ``reversals`` of the table around its present angle."""

    result_name, devices, valid_days, plots = NAME, ("servo", "imu"), 90, (plot,)
    reference = "encoder of the servo"
    reversals: int

    def measure(self, bench: Bench, *_: CalibrationResult) -> Measured:
        legs: list[Leg] = []
        # Without the usual approach from one side, because the backlash is measured.
        with Turntable(bench, trust_gyro=False, approach_deg=0.0) as table:
            base_deg = lower_end(bench, table.rest_deg, LONG_DEG)
            with returning(table) as goto:
                yield moved(0, goto(base_deg + LONG_DEG))
                yield moved(1, goto(base_deg))
                for index in range(self.reversals):
                    # Two short legs, then two long ones, so that a drifting bias of the gyro affects both equally.
                    length_deg = SHORT_DEG if index // 2 % 2 == 0 else LONG_DEG
                    move = goto(base_deg + (length_deg if index % 2 == 0 else 0.0))
                    legs.append(Leg.of(move, bench.config.imu))
                    yield moved(2 + index, move)
        return evaluate(legs, resolution_deg=bench.servo.resolution_deg)


def evaluate(legs: Sequence[Leg], *, resolution_deg: float) -> Evaluation:
    """Fit backlash and ratio to ``legs``.

    ``legs`` go alternately up and down, by more than one length. ``resolution_deg`` is the angle of one encoder count.
    """
    found = Evaluation(name=NAME, residual_unit="°", evidence={"legs": plain(list(legs))})
    used = [leg for leg in legs if not leg.invalid]
    if len(used) < MIN_REVERSALS:
        return found.reject(
            RejectionCode.TOO_FEW_REVERSALS, used=len(used), needed=MIN_REVERSALS, reasons=reasons(legs)
        )
    encoder = np.array([leg.encoder_deg for leg in used])
    gyro = np.array([leg.gyro_deg for leg in used])
    # Encoder = ratio · gyro + backlash · direction: one linear fit to short and long legs.
    fitted = fit(used, np.column_stack([gyro, np.sign(encoder)]), resolution_deg)
    (ratio, backlash), worst = fitted.values, fitted.worst
    found.residual = abs(float(fitted.residuals_deg[worst]))
    found.limit = COVERAGE * float(fitted.residual_sigma_deg[worst])
    backlash_sigma = found.estimate("backlash", backlash, "°", *fitted.budget(1, "°")).uncertainty
    unit = "° of the encoder per ° read"
    found.estimate("ratio", ratio, unit, *fitted.budget(0, unit))
    # The rotation by which encoder and platter may differ without a fault: the backlash and its uncertainty.
    margin_deg = max(float(backlash), 0.0) + COVERAGE * backlash_sigma
    found.proposed = {"table.backlash_deg": round(margin_deg, 3)}

    # The gear first, then single legs, then what the backlash itself must keep.
    if ratio < 0:
        found.reject(RejectionCode.WRONG_DIRECTION, ratio=ratio)
    else:
        found.reject_if(
            not RATIO[0] < ratio < RATIO[1], RejectionCode.WRONG_GEAR_RATIO, ratio=ratio, table_deg=1 / ratio
        )
    reject_slipped_leg(found, legs.index(used[worst]) + 1)
    found.reject_above(MAX_BACKLASH_DEG, RejectionCode.BACKLASH_TOO_LARGE, backlash_deg=backlash)
    found.reject_if(backlash < -COVERAGE * backlash_sigma, RejectionCode.BACKLASH_NEGATIVE, backlash_deg=backlash)
    found.reject_above(MAX_UNCERTAINTY_DEG, RejectionCode.BACKLASH_UNCERTAIN, uncertainty_deg=backlash_sigma)
    return found
