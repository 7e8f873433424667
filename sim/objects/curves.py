"""Curves that describe bodies. A point is a tuple of numbers, such as (radius, height) or (x, y, z, thickness)."""

import numpy as np
from numpy.typing import NDArray

Curve = tuple[tuple[float, ...], ...]
_ROUNDS = 4  # each round doubles the points: 16 for each corner


def smooth(*corners: tuple[float, ...]) -> Curve:
    """Return the curve through ``corners`` with rounded edges (Chaikin's corner cutting); its ends do not move."""
    points = np.array(corners, dtype=np.float64)
    for _ in range(_ROUNDS):
        cut = np.stack([0.75 * points[:-1] + 0.25 * points[1:], 0.25 * points[:-1] + 0.75 * points[1:]], axis=1)
        points = np.concatenate([points[:1], cut.reshape(-1, points.shape[1]), points[-1:]])
    return tuple(tuple(float(x) for x in point) for point in points)


def evenly(curve: Curve, step: float, *, dimensions: int) -> NDArray[np.float64]:
    """Return ``curve`` resampled at steps of about ``step``, (n, d); the first ``dimensions`` numbers are positions."""
    points = np.array(curve, dtype=np.float64)
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points[:, :dimensions], axis=0), axis=1))])
    even = np.linspace(0.0, s[-1], max(int(np.ceil(s[-1] / step)), 1) + 1)
    return np.column_stack([np.interp(even, s, column) for column in points.T])
