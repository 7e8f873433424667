"""What calibrations found out about a bench: dated facts, their store, and how they take effect."""

from rig.calibrations.apply import put_in_force
from rig.calibrations.result import CalibrationResult, Estimate
from rig.calibrations.store import CalibrationStore, Standing, State, apparatus

__all__ = ["CalibrationResult", "CalibrationStore", "Estimate", "Standing", "State", "apparatus", "put_in_force"]
