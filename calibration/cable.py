"""Measure the cable budget: the operator rotates the table by hand to both ends, with the torque off.

The servo counts the revolutions itself while its supply is on.
"""

from dataclasses import dataclass

from calibration.procedure import Ask, Evaluation, Measured, Procedure
from rig.bench import Bench
from rig.calibrations import CalibrationResult, Contribution, RejectionCode

NAME = "servo.cable"

MARGIN_DEG = 15.0
"""Margin at either end, because a stopped motion overruns, and an operator notices a taut cable late."""
HAND_DEG = 5.0
"""Standard uncertainty of the angle at which an operator finds the cable taut."""


@dataclass(frozen=True)
class Cable(Procedure):
    """A procedure in which the operator shows both ends of the cable. The servo moves nothing."""

    result_name, devices, valid_days = NAME, ("servo",), 365
    reference = "encoder of the servo"

    def measure(self, bench: Bench, *_: CalibrationResult) -> Measured:
        bench.servo.torque_off()
        ends_deg = []
        for direction in ("counter-clockwise", "clockwise"):
            yield Ask(f"Rotate the table by hand {direction}, seen from above, until the cable is almost taut.")
            ends_deg.append(bench.safety.angle_reference.to_table(bench.servo.read_state().position_deg))
        yield Ask("Rotate the table back by hand until the cable hangs free.")
        return evaluate(*ends_deg, pan=bench.config.table.mode == "pan")


def evaluate(high_deg: float, low_deg: float, *, pan: bool) -> Evaluation:
    """Evaluate the two ends of the cable, table angles in degrees; a ``pan`` table needs no whole revolution."""
    found = Evaluation(name=NAME, residual_unit="°", evidence={"margin_deg": MARGIN_DEG})
    taut = Contribution("angle at which an operator finds the cable taut", "B", HAND_DEG, "°")
    found.estimate("lowest", low_deg, "°", taut)
    found.estimate("highest", high_deg, "°", taut)
    low, high = limits = [round(low_deg + MARGIN_DEG, 1), round(high_deg - MARGIN_DEG, 1)]
    found.proposed = {"table.limits_deg": limits}
    if high_deg < low_deg:
        found.reject(RejectionCode.CABLE_ENDS_SWAPPED, high_deg=high_deg, low_deg=low_deg)
    elif not pan and high - low < 360.0:
        found.reject(RejectionCode.CABLE_TOO_SHORT, margin_deg=MARGIN_DEG, span_deg=high - low)
    else:
        found.reject_if(not low <= 0.0 <= high, RejectionCode.HOME_OUTSIDE_CABLE, low_deg=low, high_deg=high)
    return found
