"""The table's angle from the servo's position, and whether it can still be trusted after a pause.

The servo counts its own revolutions, but only as long as it has its supply. `TableRecord` is the stored state: angle,
revolutions of the cable, latched fault.

Decision: docs/decisions/0004.
"""

from dataclasses import dataclass, replace
from math import cos, isclose, radians, sin
from typing import Final

from hbr.core.angles import wrap180
from rig.config import TableConfig
from rig.core.errors import StateNotStored
from rig.core.phrases import Worded, filled
from rig.devices.servo import Servo, ServoCondition, ServoIdentity
from rig.safety.saved_state import BenchState, LatchedFault, SavedTable, StateStore

TOLERANCE_DEG = 2.0  # larger: a small slip is trusted; smaller: a usual rest needs the operator
"""How far a shaft may relax when its torque goes off, including the encoder's noise."""
HAND_DEG = 180.0
"""Largest change that counts as a rotation by hand; after a larger one, the servo has probably lost its count."""
OVERSHOOT_DEG = 5.0
"""How far an interrupted motion may overshoot its path."""


class AngleFinding(Worded):
    """Result of comparing the servo's position with the stored one."""

    UNCHANGED = "unchanged", "the table is where it was"
    ROTATED_BY_HAND = (
        "rotated-by-hand",
        "the table was rotated by hand while the servo counted (now {now:.1f}°, before {before:.1f}°)",
    )
    REVOLUTIONS_RESTORED = (
        "revolutions-restored",
        "the servo lost its supply and {lost} of its revolutions; they were restored from the stored state",
    )
    MOTION_INTERRUPTED = (
        "motion-interrupted",
        "the last program was interrupted during a motion; the servo kept its count (now {now:.1f}°)",
    )
    NEVER_REFERENCED = "never-referenced", "it was never set on this bench"
    OTHER_SERVO = "other-servo", "another servo is connected than last time"
    OTHER_FIRMWARE = "other-firmware", "the servo's firmware changed from {before_firmware} to {firmware}"
    POWER_LOST_IN_MOTION = "power-lost-in-motion", "the servo lost its supply during a motion"
    NOT_ON_PATH = (
        "not-on-path",
        "a motion was interrupted, and the servo is at {now:.1f}°, which is not on its path",
    )
    ROTATED_WITHOUT_POWER = (
        "rotated-without-power",
        "the table was rotated while the servo had no supply (now {now:.1f}°, before {before:.1f}°)",
    )
    POSITION_CHANGED = "position-changed", "the servo is at {now:.1f}°, but it was left at {before:.1f}°"
    SETTINGS_CHANGED = (
        "settings-changed",
        "table.zero_deg, table.direction or servo.gear_ratio was changed since the angle was stored",
    )
    BEYOND_LIMITS = "beyond-limits", "the table is at {table:.1f}°, beyond its cable budget"


_CERTAIN: Final = frozenset(
    {
        AngleFinding.UNCHANGED,
        AngleFinding.ROTATED_BY_HAND,
        AngleFinding.REVOLUTIONS_RESTORED,
        AngleFinding.MOTION_INTERRUPTED,
    }
)


@dataclass(frozen=True, slots=True)
class SavedAngleCheck:
    """Result of `check_saved_angle`: the finding, and the numbers of its text.

    ``shift_deg`` must be added to the servo's positions. ``table_deg`` is the table's angle if it is beyond the limits.
    """

    finding: AngleFinding
    shift_deg: float
    position_deg: float
    saved_position_deg: float = 0.0
    firmware: int = 0
    saved_firmware: int = 0
    lost_revolutions: int = 0
    table_deg: float = 0.0

    @property
    def certain(self) -> bool:
        """Whether the angle is certain; otherwise the operator must look at the cable."""
        return self.finding in _CERTAIN

    def __str__(self) -> str:
        return filled(
            self.finding.words,
            now=self.position_deg,
            before=self.saved_position_deg,
            firmware=self.firmware,
            before_firmware=self.saved_firmware,
            lost=self.lost_revolutions,
            table=self.table_deg,
        )


class AngleReference:
    """Converts between the servo's positions and the table's angles.

    The table's angle is ``direction · (position − error + shift − zero)``, degrees, unwrapped. The error is the
    encoder's error at that position, from calibration. The shift is the whole revolutions that the servo lost, or the
    angle that the operator set (`set_angle`). ``revolution_deg`` is the table's rotation for one revolution of the
    encoder.
    """

    def __init__(self, config: TableConfig, shift_deg: float = 0.0, revolution_deg: float = 360.0) -> None:
        self._config = config
        self._revolution_deg = revolution_deg
        self.shift_deg = shift_deg

    def calibrate(self, config: TableConfig) -> None:
        """Use the encoder's calibration in ``config``; the shift stays."""
        self._config = self._config.model_copy(update={"encoder_harmonics_deg": config.encoder_harmonics_deg})

    def to_table(self, position_deg: float) -> float:
        true_deg = position_deg - self._error_deg(position_deg)
        return self._config.direction * (true_deg + self.shift_deg - self._config.zero_deg)

    def to_servo(self, table_deg: float) -> float:
        true_deg = self._config.direction * table_deg + self._config.zero_deg - self.shift_deg
        position_deg = true_deg
        for _ in range(3):  # converges quickly: the error changes by at most a hundredth of the angle
            position_deg = true_deg + self._error_deg(position_deg)
        return position_deg

    def _error_deg(self, position_deg: float) -> float:
        a1, b1, a2, b2 = self._config.encoder_harmonics_deg
        rotate = radians(position_deg * 360.0 / self._revolution_deg)
        return a1 * cos(rotate) + b1 * sin(rotate) + a2 * cos(2 * rotate) + b2 * sin(2 * rotate)

    def set_angle(self, position_deg: float, table_deg: float) -> None:
        """Set the shift so that the servo's ``position_deg`` is the table angle ``table_deg``."""
        self.shift_deg += self._config.direction * (table_deg - self.to_table(position_deg))

    def with_revolutions(self, position_deg: float, revolutions: int) -> float:
        """Return the table angle at ``position_deg`` if the cable is wound up by ``revolutions``."""
        return float(wrap180(self.to_table(position_deg))) + 360.0 * revolutions


def check_saved_angle(
    saved: SavedTable | None,
    identity: ServoIdentity,
    position_deg: float,
    condition: ServoCondition,
    revolution_deg: float = 360.0,
) -> SavedAngleCheck:
    """Compare the servo's position after a pause with the stored one.

    As long as the servo has its supply, it counts its revolutions, even if the table is rotated by hand. Without supply
    only the angle within the revolution remains. If it is the stored angle, the stored number of revolutions is also
    valid. In all other cases the operator must look at the cable. ``revolution_deg`` is the period of the encoder.
    """
    if saved is None:
        return SavedAngleCheck(AngleFinding.NEVER_REFERENCED, 0.0, position_deg)
    moved_deg = position_deg - saved.position_deg
    revolutions = round(moved_deg / revolution_deg)
    same_within_revolution = abs(moved_deg - revolution_deg * revolutions) <= TOLERANCE_DEG
    lost = 0
    finding = AngleFinding.UNCHANGED
    # Another servo first: then no number of the saved one counts.
    if (identity.model_number, identity.bus_id) != (saved.model_number, saved.bus_id):
        finding = AngleFinding.OTHER_SERVO
    elif identity.firmware != saved.firmware:
        finding = AngleFinding.OTHER_FIRMWARE
    elif saved.path_deg is not None:
        # The last program ended during a motion: the servo may be anywhere on the path.
        low_deg, high_deg = saved.path_deg
        on_path = low_deg - OVERSHOOT_DEG <= position_deg <= high_deg + OVERSHOOT_DEG
        if condition.power_lost:
            finding = AngleFinding.POWER_LOST_IN_MOTION
        else:
            finding = AngleFinding.MOTION_INTERRUPTED if on_path else AngleFinding.NOT_ON_PATH
    elif condition.power_lost:
        if not same_within_revolution:
            finding = AngleFinding.ROTATED_WITHOUT_POWER
        elif revolutions:
            finding, lost = AngleFinding.REVOLUTIONS_RESTORED, revolutions
    # The supply was kept, at rest: the servo's own count is trusted.
    elif abs(moved_deg) > min(HAND_DEG, revolution_deg / 2):
        finding = AngleFinding.POSITION_CHANGED
    elif abs(moved_deg) > TOLERANCE_DEG:
        finding = AngleFinding.ROTATED_BY_HAND
    return SavedAngleCheck(
        finding,
        saved.shift_deg - revolution_deg * lost,
        position_deg,
        saved.position_deg,
        identity.firmware,
        saved.firmware,
        abs(lost),
    )


class TableRecord:
    """The stored state of a table: compared with its servo, and updated."""

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
        # The servo may be certain of its angle, and the table not: with other settings, the stored positions mean other
        # angles, and beyond the limits the cable is at risk.
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
            latched = fault is not None  # then it survives, also if the state cannot be written
            self._save(state)
        except StateNotStored:
            if not latched:
                raise
        finally:
            if fault is not None:
                self._state = state

    def _save(self, state: BenchState) -> None:
        if state != self._state:  # a write waits for the disk
            self._store.save(state)
            self._state = state
