"""The table angles of an enrollment."""

from collections.abc import Sequence
from itertools import pairwise
from math import ceil, floor
from typing import Final

from hbr.core.angles import wrap360
from rig.core.errors import LimitExceeded
from rig.core.next_steps import Do

_FLOAT_DEG: Final = 1e-6  # a limit that a float misses by rounding still counts as reached


def even_azimuths(views: int, limits_deg: tuple[float, float], sign: int = -1) -> list[float]:
    """Return the azimuths of ``views`` even steps of a revolution, in the order in which the table takes them.

    The first azimuth is 0 if the cable budget allows a revolution upwards from the table angle 0; otherwise the table
    starts further back. If the limits allow less than a revolution, only the azimuths within them are returned.
    """
    step_deg = 360.0 / views
    low, high = limits_deg
    start_deg = 0.0
    if 360.0 - step_deg > high - low:
        start_deg = ceil(low / step_deg - _FLOAT_DEG) * step_deg
        views = floor((high - start_deg) / step_deg + _FLOAT_DEG) + 1
    elif 360.0 - step_deg > high:
        start_deg = max((high - (360.0 - step_deg)) // step_deg * step_deg, low)
    return [float(wrap360(sign * (start_deg + k * step_deg))) for k in range(views)]


def table_angles(azimuth_deg: Sequence[float], limits_deg: tuple[float, float], sign: int = -1) -> tuple[float, ...]:
    """Return the unwrapped table angle for each planned azimuth: always upwards, and within the limits.

    The table always rotates upwards, so that the backlash stays on one side.

    Raises `LimitExceeded`: the cable budget does not allow this number of views in one direction.
    """
    if not azimuth_deg:
        return ()
    angles = [sign * float(wrap360(azimuth_deg[0]))]
    for before, after in pairwise(azimuth_deg):
        angles.append(angles[-1] + float(wrap360(sign * (after - before))))
    low, high = limits_deg
    revolutions = [
        whole
        for whole in range(int(low // 360) - 1, int(high // 360) + 3)
        if low - _FLOAT_DEG <= angles[0] + 360.0 * whole and angles[-1] + 360.0 * whole <= high + _FLOAT_DEG
    ]
    if not revolutions:
        raise LimitExceeded(
            f"The views need {angles[-1] - angles[0]:.0f}° in one direction. The cable budget does not allow that.",
            next_step=(
                "Increase table.limits_deg if the cable is long enough. Otherwise,",
                Do.ENROLL_AGAIN(),
                "The views are then planned for this bench.",
            ),
            evidence={"from_deg": angles[0], "to_deg": angles[-1], "limits_deg": list(limits_deg)},
        )
    nearest = min(revolutions, key=lambda whole: (abs(angles[0] + 360.0 * whole), whole))
    return tuple(angle + 360.0 * nearest for angle in angles)
