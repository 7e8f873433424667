"""A finished move of the table, and the arithmetic of moves."""

from dataclasses import dataclass
from math import ceil, floor, sqrt

from rig.core.clock import seconds_between
from rig.devices.servo import MotionProfile
from rig.safety.gyro_rotation import Agreement, Rotation


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
