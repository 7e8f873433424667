"""Calibration results of a bench: their files, and the settings that they apply."""

from rig.calibrations.rejection import CalibrationRejection, RejectionCode
from rig.calibrations.result import CalibrationResult, Contribution, Estimate
from rig.calibrations.store import BenchCalibration, CalibrationStatus, CalibrationStore, apparatus, apply_results

__all__ = [
    "BenchCalibration",
    "CalibrationRejection",
    "CalibrationResult",
    "CalibrationStatus",
    "CalibrationStore",
    "Contribution",
    "Estimate",
    "RejectionCode",
    "apparatus",
    "apply_results",
]
