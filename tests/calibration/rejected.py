"""What the tests of the calibrations share."""

from calibration.procedure import Evaluation
from rig.calibrations import CalibrationResult, RejectionCode


def codes(found: Evaluation | CalibrationResult) -> list[RejectionCode]:
    """Return why a calibration was rejected."""
    return [rejection.code for rejection in found.rejections]
