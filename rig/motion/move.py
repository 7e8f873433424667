"""A finished move of the table, and the duration of moves and views."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, floor, sqrt
from typing import Final

from rig.config import RigConfig
from rig.core.clock import seconds_between
from rig.devices.servo import MotionProfile
from rig.safety.gyro_rotation import Agreement, Rotation

FIRST_REST_S: Final = 0.6
"""Time over which the gyro is averaged for its first bias."""


@dataclass(frozen=True, slots=True)
class Move:
    """A finished motion between two rests; table angles in degrees, unwrapped."""

    commanded_deg: float
    encoder_deg: float
    rotation_encoder_deg: float
    gyro: Rotation
    agreement: Agreement | None
    started_ns: int
    settled_ns: int
    by_gyro: bool = False

    @property
    def agrees(self) -> bool:
        """Whether encoder and gyro agree; also true if the gyro measured nothing valid."""
        return self.agreement is None or self.agreement.agrees

    @property
    def rotation_deg(self) -> float:
        """The best measurement of the rotation.

        It is the encoder's, unless the gyro on the platter contradicts it, or ``table.orientation`` selects the gyro.
        """
        return self.gyro.angle_deg if self.by_gyro or not self.agrees else self.rotation_encoder_deg

    @property
    def seconds(self) -> float:
        return seconds_between(self.started_ns, self.settled_ns)


def motion_seconds(distance_deg: float, profile: MotionProfile) -> float:
    """Return the duration of a trapezoid (or triangle) profile over ``distance_deg``."""
    distance, v, a = abs(distance_deg), profile.velocity_dps, profile.acceleration_dps2
    if distance < v * v / a:
        return 2 * sqrt(distance / a)
    return distance / v + v / a


def equivalent_within(target_deg: float, rest_deg: float, limits_deg: tuple[float, float]) -> float | None:
    """Return an angle within the cable's limits that shows the same as ``target_deg``; None if there is none.

    ``target_deg`` itself if it is within the limits, else the angle, whole revolutions away, nearest to ``rest_deg``.
    """
    low, high = limits_deg
    if low <= target_deg <= high:
        return target_deg
    revolutions = range(ceil((low - target_deg) / 360), floor((high - target_deg) / 360) + 1)
    # clamped: a sum can be rounded to an angle just beyond a limit
    angles_deg = (min(max(target_deg + 360 * k, low), high) for k in revolutions)
    return min(angles_deg, key=lambda angle_deg: abs(angle_deg - rest_deg), default=None)


SETTLING_MS, SHAPED_MS = 170.0, 120.0
"""Time of a move for ringing and for the bus; before and after it, the table is quiet for ``table.quiet_s``. The second
is that of a shaped move (`rig.motion.shaper`), which takes longer itself."""
FRAMES: Final = 1.5
"""Frames from the table's rest until one was exposed completely."""


@dataclass(frozen=True, slots=True)
class MotionTimes:
    """The duration of moves and views, from the table's motion profile and the camera's frame rate."""

    config: RigConfig

    def move_s(self, distance_deg: float) -> float:
        """Return the duration of a move until the table is at rest; downwards it includes the approach from below."""
        table = self.config.table
        profile = MotionProfile(table.velocity_dps, table.acceleration_dps2)
        seconds = ((SHAPED_MS if table.ringing_hz else SETTLING_MS) + 2e3 * table.quiet_s) / 1e3 + motion_seconds(
            distance_deg, profile
        )
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

    def left_s(self, angles_deg: Sequence[float], done: int, *, in_motion: bool = False) -> float:
        """Return the remaining time of an enrollment at these table angles, of which the first views are ``done``.

        It lasts until the table is back at 0. Views ``in_motion`` are reported after their revolution.
        """
        if not done or not angles_deg:
            return self.enrollment_s(angles_deg[0] if angles_deg else 0.0, angles_deg, in_motion=in_motion)
        if in_motion:
            return self.park_s(angles_deg[0] + 360.0)
        return self.views_s(angles_deg[done - 1 :]) + self.move_s(-angles_deg[-1])

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
