"""The speed of a scan: the fastest at which its views are good enough, and the cause that limits it."""

from dataclasses import dataclass
from enum import StrEnum
from math import hypot, inf, radians
from typing import Final

from rig.config import RigConfig
from rig.core.errors import UsageError
from rig.core.next_steps import Do

GYRO_SHARE: Final = 0.9
"""Share of the gyro's range that a scan uses, because the table vibrates and the scale may be wrong."""
FRAME_SHARE: Final = 0.9
"""Margin with which a frame for each planned angle arrives, because the frame rate is nominal."""
FIT_SIGMA_DEG: Final = 0.05
"""Standard uncertainty of the angle that is left to the trajectory."""


class SpeedLimit(StrEnum):
    """The causes that limit the speed of a scan."""

    SMEAR = "smear"
    FRAME_RATE = "frame-rate"
    TABLE = "table"
    GYRO = "gyro"
    TIME = "time"


@dataclass(frozen=True, slots=True)
class ScanSpeed:
    """A speed in °/s, the cause that limits it, and its number as in `rig.events.events.ScanStarted`."""

    dps: float
    limit: SpeedLimit
    value: float


def smear_px(config: RigConfig, speed_dps: float) -> float:
    """Return the motion at the edge of the region during an exposure, in pixels; the axis is in its middle."""
    width_px = config.camera.width if config.view.roi is None else config.view.roi[2]
    return abs(radians(speed_dps)) * (width_px / 2) * exposure_s(config)


def exposure_s(config: RigConfig) -> float:
    """Return the locked exposure time; raise `UsageError` if it is not locked."""
    if config.camera.exposure_us is None:
        raise UsageError(
            "The exposure time of the camera is not locked, so the smear of views in motion is not known.",
            next_step=(
                "Take views at rest. Or set camera.exposure_us to a number, and",
                Do.CALIBRATE(name="camera-time"),
            ),
        )
    return config.camera.exposure_us * 1e-6


def time_sigma_ms(config: RigConfig) -> float:
    """Return the standard uncertainty of the middle of a frame's exposure."""
    return hypot(config.camera_time.jitter_ms, config.camera_time.uncertainty_ms)


def can_fly(config: RigConfig) -> bool:
    """Return whether views can be taken in motion: the camera's time is calibrated, and its exposure is locked."""
    return config.camera_time.offset_ms is not None and config.camera.exposure_us is not None


def takes_in_motion(config: RigConfig, fly: bool | None, *, tray: bool = False) -> bool:
    """Return whether an enrollment takes its views in one revolution; ``fly`` overrides ``enroll.mode``.

    "auto" means at rest; for a tray it means in motion if that is possible.
    """
    if fly is not None:
        return fly
    low_deg, high_deg = config.table.limits_deg
    possible = low_deg <= 0.0 and high_deg >= 360.0 and can_fly(config)
    return config.enroll.mode == "fly" or (tray and config.enroll.mode == "auto" and possible)


def require_camera_time(config: RigConfig) -> None:
    """Raise `UsageError` unless views can be taken in motion."""
    exposure_s(config)
    if config.camera_time.offset_ms is None:
        raise UsageError(
            "The time of the camera's frames is not calibrated, so their angles in motion are not known.",
            next_step=("Take the views at rest, or", Do.CALIBRATE(name="camera-time")),
        )


def scan_speed(config: RigConfig, gyro_range_dps: float, spacing_deg: float = inf, fps: float = inf) -> ScanSpeed:
    """Return the fastest speed for views every ``spacing_deg``; inf means that the angles of views are not planned."""
    milliseconds = exposure_s(config) * 1e3
    left_deg = max(config.view.max_angle_sigma_deg**2 - FIT_SIGMA_DEG**2, 1e-6) ** 0.5
    sigma_ms = max(time_sigma_ms(config), 1e-3)
    speeds = [
        ScanSpeed(config.table.velocity_dps, SpeedLimit.TABLE, config.table.velocity_dps),
        ScanSpeed(config.view.max_smear_px / smear_px(config, 1.0), SpeedLimit.SMEAR, milliseconds),
        ScanSpeed(GYRO_SHARE * gyro_range_dps, SpeedLimit.GYRO, gyro_range_dps),
        ScanSpeed(left_deg / (sigma_ms * 1e-3), SpeedLimit.TIME, sigma_ms),
        ScanSpeed(FRAME_SHARE * spacing_deg * fps, SpeedLimit.FRAME_RATE, fps),
    ]
    return min(speeds, key=lambda one: one.dps)
