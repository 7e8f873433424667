"""Difference of a frame from a plain background, without an empty-table image."""

from typing import Final

import cv2
import numpy as np

from hbr.core.arrays import FloatArray, ImageArray
from hbr.segmentation.background import Mask

#: A pixel differs from the background by at least this many grey levels, and by this share of the object's contrast.
_LEAST_LEVELS: Final = 12.0
_SHARE: Final = 0.25
#: A backdrop is plain if three corners of the frame have the same colour within this many grey levels (two corners are
#: enough if they are darker than `_DARK`),
_ONE_COLOUR: Final = 12.0
_DARK: Final = 40.0
#: and if the smoothest corner differs from the background by at most this, plus its noise.
_SMOOTH: Final = 3.0
_NOISE: Final = 1.5


def plain_difference(small: ImageArray) -> Mask | None:
    """Return where a small image differs from its background, bool (h, w); None if the background is not plain.

    The background of each row is interpolated between its two ends, so that a horizon does not matter.
    """
    height, width = small.shape[:2]
    image = cv2.GaussianBlur(small, (7, 7), 1.3)
    corners = _corners(height, width)
    if not _one_colour([image[corner] for corner in corners]):
        return None
    edge = max(2, width // 32)
    left, right = (
        cv2.blur(np.sort(part, axis=1)[:, part.shape[1] // 2, None].astype(np.float32), (1, 9)).reshape(height, 1, 3)
        for part in (image[:, :edge], image[:, -edge:])
    )
    across = ((np.arange(width, dtype=np.float32) + 0.5) / width)[None, :, None]
    apart = cv2.split(cv2.absdiff(image.astype(np.float32), left + (right - left) * across))
    away = cv2.max(cv2.max(apart[0], apart[1]), apart[2])
    border = np.concatenate([away[:edge].ravel(), away[:, :edge].ravel(), away[:, -edge:].ravel()])
    threshold = max(_LEAST_LEVELS, 4 * float(np.median(border)))
    if not _smooth(corners, away, cv2.absdiff(small, image), edge + 2):
        return None
    # the object's contrast: 5 % of the frame exceed it; every third pixel in each direction is enough
    sample = np.sort(away[::3, ::3], axis=None)
    contrast = float(sample[-(len(sample) // 20 + 1)])
    differs: Mask = away > max(threshold, _SHARE * contrast)
    return differs


def _corners(height: int, width: int) -> list[tuple[slice, slice]]:
    height, width = max(1, height // 8), max(1, width // 8)
    return [(rows, part) for rows in (np.s_[:height], np.s_[-height:]) for part in (np.s_[:width], np.s_[-width:])]


def _one_colour(corners: list[cv2.typing.MatLike]) -> bool:
    """Return whether the corners show one backdrop, and not a wall and a table."""
    colours = np.array([_median(corner.reshape(-1, 3)) for corner in corners])
    same = (np.abs(colours[:, None] - colours).max(axis=2) <= _ONE_COLOUR).sum(axis=1)
    dark = colours.max(axis=1) < _DARK
    return bool((same >= np.where(dark, 2, 3)).any())


def _median(rows: cv2.typing.MatLike) -> FloatArray:
    """Return the median of each column: as np.median, which takes four times as long for few values."""
    columns, middle = np.sort(rows.T, axis=1), len(rows) // 2
    return (columns[:, middle] + columns[:, -middle - 1].astype(np.float64)) / 2


def _smooth(corners: list[tuple[slice, slice]], away: cv2.typing.MatLike, noise: cv2.typing.MatLike, edge: int) -> bool:
    """Return whether the smoothest corner shows no pattern."""
    edge = min(edge, (away.shape[1] - 1) // 2)
    # not at the edges: the background is interpolated from them, so that the difference is always small there
    inner = away[:, edge : -edge or None], noise[:, edge : -edge or None]
    difference, grain = min(
        (float(np.median(inner[0][corner])), float(inner[1][corner].max(axis=2).mean())) for corner in corners
    )
    return difference <= _SMOOTH + _NOISE * grain
