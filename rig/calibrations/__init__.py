"""Calibration results of a bench: their files, and the settings that they apply."""

from rig.calibrations.apply import apply_results
from rig.calibrations.rejection import Rejection, RejectionCode
from rig.calibrations.result import CalibrationResult, Estimate
from rig.calibrations.store import BenchCalibration, CalibrationStatus, CalibrationStore, apparatus

__all__ = [
    "BenchCalibration",
    "CalibrationResult",
    "CalibrationStatus",
    "CalibrationStore",
    "Estimate",
    "Rejection",
    "RejectionCode",
    "apparatus",
    "apply_results",
]
