"""Where the table stands: the servo counts its own turns, but only as long as it has its supply."""

from dataclasses import dataclass
from math import cos, radians, sin

from hbr.core.angles import wrap180
from rig.config import TableConfig
from rig.devices.servo import ServoCondition, ServoIdentity
from rig.safety.saved_state import SavedTable

TOLERANCE_DEG = 2.0
"""How far a shaft may relax when its torque goes, and the encoder's noise."""
HAND_DEG = 180.0
"""How far a hand turns a table without thinking of its cable; more is rather a servo that lost count."""
OVERSHOOT_DEG = 5.0
"""How far beyond its way a motion may have come that was broken off."""


@dataclass(frozen=True, slots=True)
class SavedAngleCheck:
    """What is to be added to the servo's positions, or why that is in ``doubt``; ``findings`` for the operator."""

    shift_deg: float
    doubt: str = ""
    findings: tuple[str, ...] = ()


class AngleReference:
    """Converts between the servo's positions and the table's angles.

    The table's angle is ``direction · (position − error + shift − zero)``, degrees, unwrapped; the error is what the
    encoder reads too much at that position of its turn, by calibration, the shift what the servo forgot (whole turns)
    or a person declared (`declare`). ``turn_deg`` is the table's angle of one turn of the encoder.
    """

    def __init__(self, config: TableConfig, shift_deg: float = 0.0, turn_deg: float = 360.0) -> None:
        self._config = config
        self._turn_deg = turn_deg
        self.shift_deg = shift_deg

    def calibrate(self, config: TableConfig) -> None:
        """Take over what a calibration says about the encoder; what a person declared stays."""
        self._config = self._config.model_copy(update={"encoder_harmonics_deg": config.encoder_harmonics_deg})

    def to_table(self, position_deg: float) -> float:
        true_deg = position_deg - self._error_deg(position_deg)
        return self._config.direction * (true_deg + self.shift_deg - self._config.zero_deg)

    def to_servo(self, table_deg: float) -> float:
        true_deg = self._config.direction * table_deg + self._config.zero_deg - self.shift_deg
        position_deg = true_deg
        for _ in range(3):  # the error changes by a hundredth of the angle at most
            position_deg = true_deg + self._error_deg(position_deg)
        return position_deg

    def _error_deg(self, position_deg: float) -> float:
        a1, b1, a2, b2 = self._config.encoder_harmonics_deg
        turn = radians(position_deg * 360.0 / self._turn_deg)
        return a1 * cos(turn) + b1 * sin(turn) + a2 * cos(2 * turn) + b2 * sin(2 * turn)

    def declare(self, position_deg: float, table_deg: float) -> None:
        """Take it from a person that the table stands at ``table_deg`` where the servo reads ``position_deg``."""
        self.shift_deg += self._config.direction * (table_deg - self.to_table(position_deg))

    def with_turns(self, position_deg: float, turns: int) -> float:
        """Return the table's angle at ``position_deg`` with the cable wound up by ``turns`` whole turns."""
        return float(wrap180(self.to_table(position_deg))) + 360.0 * turns


def check_saved_angle(
    saved: SavedTable | None,
    identity: ServoIdentity,
    position_deg: float,
    condition: ServoCondition,
    turn_deg: float = 360.0,
) -> SavedAngleCheck:
    """Compare what a servo says after a pause with what was written down before.

    ``turn_deg`` is the angle after which its encoder reads the same again.

    As long as the servo keeps its supply, it counts its turns itself, and a hand that turned the table meanwhile is
    counted too. Without supply only the angle within the turn remains: where it is the one written down, so are the
    turns. All else is in doubt, and only a person who looks at the cable can tell.
    """
    if saved is None:
        return SavedAngleCheck(0.0, "nobody has told yet how its cable lies")
    shift_deg = saved.shift_deg
    found, written = f"{position_deg:.1f}°", f"{saved.position_deg:.1f}°"
    if (identity.model_number, identity.bus_id) != (saved.model_number, saved.bus_id):
        return SavedAngleCheck(shift_deg, "another servo is connected than the last time")
    if identity.firmware != saved.firmware:
        return SavedAngleCheck(shift_deg, f"the servo's firmware was {saved.firmware} and is {identity.firmware} now")
    turned_deg = position_deg - saved.position_deg
    turns = round(turned_deg / turn_deg)
    same_within_turn = abs(turned_deg - turn_deg * turns) <= TOLERANCE_DEG
    if saved.path_deg is not None:
        low_deg, high_deg = saved.path_deg
        if condition.power_lost:
            return SavedAngleCheck(shift_deg, "the servo lost its supply in the middle of a motion")
        if not low_deg - OVERSHOOT_DEG <= position_deg <= high_deg + OVERSHOOT_DEG:
            return SavedAngleCheck(
                shift_deg, f"a motion was cut off, and the servo stands at {found}, which was not on its way"
            )
        finding = f"the last program was cut off in the middle of a motion; the servo kept its turns (at {found})"
        return SavedAngleCheck(shift_deg, findings=(finding,))
    if condition.power_lost:
        if not same_within_turn:
            return SavedAngleCheck(
                shift_deg,
                f"the servo was without supply and the table was turned meanwhile (at {found}, left at {written})",
            )
        if turns:
            finding = f"the servo was without supply and forgot {abs(turns)} of its turns; they were written down"
            return SavedAngleCheck(shift_deg - turn_deg * turns, findings=(finding,))
        return SavedAngleCheck(shift_deg)
    if abs(turned_deg) > min(HAND_DEG, turn_deg / 2):
        return SavedAngleCheck(shift_deg, f"the servo stands at {found}, it was left at {written}")
    if abs(turned_deg) > TOLERANCE_DEG:
        finding = f"the table was turned by hand, with the servo counting (at {found}, left at {written})"
        return SavedAngleCheck(shift_deg, findings=(finding,))
    return SavedAngleCheck(shift_deg)
