"""A function that the tests of the calibrations share."""

from calibration.procedure import Evaluation
from rig.calibrations import CalibrationResult, RejectionCode


def codes(found: Evaluation | CalibrationResult) -> list[RejectionCode]:
    """Return the codes of the rejections of a calibration."""
    return [rejection.code for rejection in found.rejections]
