"""Angles on the circle, in degrees."""

from typing import overload

import numpy as np

from hbr.core.arrays import FloatArray


@overload
def wrap360(angle_deg: float) -> float: ...
@overload
def wrap360(angle_deg: FloatArray) -> FloatArray: ...
def wrap360(angle_deg: float | FloatArray) -> float | FloatArray:
    """Return an angle in degrees as the same direction in [0, 360)."""
    # the remainder of a tiny negative angle is rounded to 360.0
    if not isinstance(angle_deg, np.ndarray):  # floats are a hundred times faster than arrays of one number
        remainder = float(angle_deg) % 360.0
        return 0.0 if remainder == 360.0 else remainder
    wrapped = np.mod(angle_deg, 360.0)
    return np.where(wrapped == 360.0, 0.0, wrapped)


@overload
def wrap180(angle_deg: float) -> float: ...
@overload
def wrap180(angle_deg: FloatArray) -> FloatArray: ...
def wrap180(angle_deg: float | FloatArray) -> float | FloatArray:
    """Return an angle in degrees as the same direction in [-180, 180)."""
    return wrap360(angle_deg + 180.0) - 180.0


@overload
def revolutions_between(a_deg: float, b_deg: float) -> float: ...
@overload
def revolutions_between(a_deg: FloatArray, b_deg: FloatArray | float) -> FloatArray: ...
def revolutions_between(a_deg: float | FloatArray, b_deg: float | FloatArray) -> float | FloatArray:
    """Return the distance of two directions in revolutions, 0..0.5 (Δ of the Hough score)."""
    difference_deg: float | FloatArray = a_deg - b_deg
    if isinstance(difference_deg, np.ndarray):
        return size_deg(difference_deg) / 360.0
    return abs(wrap180(difference_deg)) / 360.0


def size_deg(difference_deg: FloatArray) -> FloatArray:
    """Return the absolute differences of directions, 0..180, in degrees."""
    # same result as wrap180 in a third of the time: the nearest whole revolution is subtracted without rounding
    size: FloatArray = np.abs(difference_deg - 360.0 * np.rint(difference_deg / 360.0))
    return size
