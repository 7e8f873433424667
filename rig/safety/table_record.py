"""The stored state of one bench's table: its angle, the revolutions of its cable, and the latched fault."""

from dataclasses import replace
from math import isclose

from rig.config import TableConfig
from rig.core.errors import StateNotStored
from rig.devices.servo import Servo
from rig.safety.angle_reference import TOLERANCE_DEG, AngleFinding, AngleReference, SavedAngleCheck, check_saved_angle
from rig.safety.saved_state import BenchState, LatchedFault, SavedTable, StateStore


class TableRecord:
    """The stored state of a table: compared with its servo, and updated.

    Parameters
    ----------
    servo
        Only read.
    config
        Direction, zero and encoder calibration of the table.
    store
        Store in which the state survives the process.
    """

    def __init__(self, servo: Servo, config: TableConfig, store: StateStore) -> None:
        self._servo = servo
        self._config = config
        self._store = store
        self._state = store.load()
        shift_deg = self._state.table.shift_deg if self._state.table else 0.0
        self.angle_reference = AngleReference(config, shift_deg, servo.revolution_deg)
        self.doubt: SavedAngleCheck | None = None
        """Why the table's angle is uncertain; None if it is certain."""
        self.findings: list[str] = []
        """What the comparisons showed, for the operator."""

    @property
    def fault(self) -> LatchedFault | None:
        return self._state.fault

    @property
    def damage(self) -> str:
        """The reason why the stored state could not be read; empty if it could."""
        return self._state.damage

    def check_angle(self) -> bool:
        """Compare the servo's position with the stored one; return whether the table's angle is certain."""
        state, condition = self._servo.read_state(), self._servo.read_condition()
        check = check_saved_angle(
            self._state.table, self._servo.identity, state.position_deg, condition, self._servo.revolution_deg
        )
        self.angle_reference.shift_deg = check.shift_deg
        if check.finding is not AngleFinding.NEVER_REFERENCED and self._settings_changed():
            check = replace(check, finding=AngleFinding.SETTINGS_CHANGED)
        elif check.certain and self.beyond_limits(table_deg := self.angle_reference.to_table(state.position_deg)):
            check = replace(check, finding=AngleFinding.BEYOND_LIMITS, table_deg=table_deg)
        self.doubt = None if check.certain else check
        if check.certain and check.finding is not AngleFinding.UNCHANGED and str(check) not in self.findings:
            self.findings.append(str(check))
        return check.certain

    def beyond_limits(self, table_deg: float) -> bool:
        """Return whether an angle at rest exceeds the cable budget by more than a shaft relaxes."""
        low_deg, high_deg = self._config.limits_deg
        return not low_deg - TOLERANCE_DEG <= table_deg <= high_deg + TOLERANCE_DEG

    def _settings_changed(self) -> bool:
        """Return whether the same positions stood for other table angles when the state was stored."""
        saved = self._state.table
        if saved is None:
            return False
        return (saved.zero_deg, saved.direction) != (self._config.zero_deg, self._config.direction) or not isclose(
            saved.gear_ratio * self._servo.revolution_deg, 360.0
        )

    def set_angle(self, table_deg: float) -> None:
        """Set the table's present angle to ``table_deg``, and store it."""
        position_deg = self._servo.read_state().position_deg
        self.angle_reference.set_angle(position_deg, table_deg)
        self.save_position(position_deg)
        self.doubt = None

    def save_position(self, position_deg: float | None = None, path_deg: tuple[float, float] | None = None) -> None:
        """Store the servo's position (by default the present one), and the range of a motion that begins."""
        if position_deg is None:
            position_deg = self._servo.read_state().position_deg
        identity = self._servo.identity
        table = SavedTable(
            model_number=identity.model_number,
            bus_id=identity.bus_id,
            firmware=identity.firmware,
            position_deg=position_deg,
            shift_deg=self.angle_reference.shift_deg,
            path_deg=path_deg,
            zero_deg=self._config.zero_deg,
            direction=self._config.direction,
            gear_ratio=360.0 / self._servo.revolution_deg,
        )
        self._save(self._state.model_copy(update={"table": table, "damage": ""}))

    def save_fault(self, fault: LatchedFault | None) -> None:
        """Store the latched fault; it stays latched in this process even if the disk cannot be written."""
        state = self._state.model_copy(update={"fault": fault, "damage": ""})
        latched = False
        try:
            self._store.latch(fault)
            latched = fault is not None
            self._save(state)
        except StateNotStored:
            if not latched:
                raise
        finally:
            if fault is not None:
                self._state = state

    def _save(self, state: BenchState) -> None:
        if state != self._state:
            self._store.save(state)
            self._state = state
