"""What the tests of the calibrations share."""

from calibration.procedure import Evaluation
from rig.calibrations import CalibrationResult, RefusalCode


def codes(found: Evaluation | CalibrationResult) -> list[RefusalCode]:
    """Return why a calibration was refused."""
    return [refusal.code for refusal in found.refusals]
