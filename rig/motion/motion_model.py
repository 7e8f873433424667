"""Duration of moves and views."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from rig.config import RigConfig
from rig.devices.servo import MotionProfile
from rig.motion.move import motion_seconds
from rig.motion.turntable import FIRST_REST_S

SETTLING_MS: Final = 220.0
"""Time of a move for ringing and for the bus; before and after it, the table is quiet for ``table.quiet_s``."""
FRAMES: Final = 1.5
"""Frames from the table's rest until one was exposed completely."""


@dataclass(frozen=True, slots=True)
class MotionModel:
    """The duration of moves and views, from the table's motion profile and the camera's frame rate."""

    config: RigConfig

    def move_s(self, distance_deg: float) -> float:
        """Return the duration of a move until the table is at rest; downwards it includes the approach from below."""
        table = self.config.table
        profile = MotionProfile(table.velocity_dps, table.acceleration_dps2)
        seconds = (SETTLING_MS + 2e3 * table.quiet_s) / 1e3 + motion_seconds(distance_deg, profile)
        if distance_deg < 0:
            seconds += motion_seconds(table.approach_deg, profile) + 2 * table.poll_s
        return seconds

    def park_s(self, from_deg: float) -> float:
        """Return the duration of the way back to 0 after views in motion, where the table need not be quiet."""
        table = self.config.table
        return motion_seconds(from_deg, MotionProfile(table.velocity_dps, table.acceleration_dps2))

    @property
    def view_s(self) -> float:
        """Return the duration of a view: the time until a frame arrives."""
        return FRAMES / self.config.camera.fps

    def views_s(self, angles_deg: Sequence[float]) -> float:
        """Return the duration of the moves along these table angles, with a view at each but the first."""
        return sum(self.move_s(b - a) + self.view_s for a, b in pairwise(angles_deg))

    def enrollment_s(self, start_deg: float, angles_deg: Sequence[float], *, in_motion: bool = False) -> float:
        """Return the duration of views at these table angles, from ``start_deg`` and back home.

        With ``in_motion`` all are taken in one revolution at `table.velocity_dps`; a long exposure makes it slower.
        """
        if not angles_deg:
            return 0.0
        if in_motion:
            first_deg = angles_deg[0]
            before_s = self.move_s(first_deg - start_deg) if first_deg != start_deg else 0.0
            return FIRST_REST_S + before_s + 2 * self.view_s + self.move_s(360.0) + self.park_s(first_deg + 360.0)
        return FIRST_REST_S + self.views_s([start_deg, *angles_deg]) + self.move_s(-angles_deg[-1])
