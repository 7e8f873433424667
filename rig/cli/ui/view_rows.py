"""The rows and columns of an enrollment on the terminal."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from rig.core.phrases import angle_words, percent
from rig.events.events import Moved
from rig.views.capture import ViewEvidence

WIDE, NARROW = 88, 60
"""Width of a terminal, in characters, that fits all columns of a table, and most of them."""


@dataclass(frozen=True, slots=True)
class ViewRow:
    """An image of an enrollment, accepted or rejected."""

    number: int
    move: Moved | None
    evidence: ViewEvidence
    result: str
    accepted: bool

    @property
    def imu(self) -> str:
        """The table angle by the gyro, with its uncertainty."""
        if self.move is None or self.move.rotation_imu_deg is None:
            return "–"
        angle_deg = self.move.encoder_deg - self.move.rotation_encoder_deg + self.move.rotation_imu_deg
        sigma = "" if self.move.imu_sigma_deg is None else f" ± {self.move.imu_sigma_deg:.2f}"
        return f"{angle_words(angle_deg, 2).removesuffix('°')}{sigma}°"

    @property
    def angle(self) -> str:
        """The table angle of a view in motion with its uncertainty, by encoder and gyro together."""
        if self.evidence.motion is None:
            return "–" if self.move is None else angle_words(self.move.encoder_deg, 2)
        motion = self.evidence.motion
        return f"{angle_words(motion.angle_deg, 2).removesuffix('°')} ± {motion.angle_sigma_deg:.2f}°"

    @property
    def motion(self) -> str:
        """The table's speed, and how far the edge of the region moved during the exposure."""
        motion = self.evidence.motion
        return "at rest" if motion is None else f"{motion.speed_dps:.0f} °/s, {motion.smear_px:.1f} px"


Columns = tuple[tuple[str, int, Callable[[ViewRow], str]], ...]

COLUMNS: Final[Columns] = (
    ("view", 0, lambda row: str(row.number)),
    ("asked", NARROW, lambda row: "–" if row.move is None else angle_words(row.move.commanded_deg, 2)),
    ("encoder", 0, lambda row: "–" if row.move is None else angle_words(row.move.encoder_deg, 2)),
    ("IMU", NARROW, lambda row: row.imu),
    ("sharpness", NARROW, lambda row: f"{row.evidence.sharpness:.1f}"),
    ("brightness", WIDE, lambda row: f"{row.evidence.mean_level:.0f}"),
    ("saturated", WIDE, lambda row: percent(row.evidence.saturated_share, 0)),
)
"""Columns of an enrollment's table: heading, width that the terminal needs to show it, and cell."""

COLUMNS_IN_MOTION: Final[Columns] = (
    COLUMNS[0],
    ("table angle", 0, lambda row: row.angle),
    ("speed and smear", NARROW, lambda row: row.motion),
    *COLUMNS[4:],
)
"""The columns if views are taken in motion."""
