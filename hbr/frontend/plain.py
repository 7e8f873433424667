"""The object before a plain background that no reference shows."""

from typing import Final

import cv2
import numpy as np

from hbr.arrays import ImageArray
from hbr.frontend.background import Mask

#: A pixel differs when it does by this many grey levels, or by this share of what the object differs.
_LEAST_LEVELS: Final = 12.0
_SHARE: Final = 0.25
#: A background is plain where no more than this share of it is off by so many grey levels.
_ROUGH: Final = 0.25
_ROUGH_LEVELS: Final = 20.0


def plain_difference(small: ImageArray) -> Mask | None:
    """Where a small image differs from its background, bool (h, w); None where its border is not plain.

    The background of a row is what lies between its two ends, which a horizon does not disturb.
    """
    height, width = small.shape[:2]
    image = cv2.GaussianBlur(small, (7, 7), 1.3)
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
    if not (_even(left, right) or _quiet(away[:, edge + 2 : -edge - 2])):
        return None
    # the object's own contrast: what a twentieth of the frame exceeds, of every third pixel each way
    sample = np.sort(away[::3, ::3], axis=None)
    contrast = float(sample[-(len(sample) // 20 + 1)])
    differs: Mask = away > max(threshold, _SHARE * contrast)
    return differs


def _even(left: cv2.typing.MatLike, right: cv2.typing.MatLike) -> bool:
    """Whether the frame's two sides are of one colour, as far as no object reaches there."""
    sides = np.concatenate([left, right]).reshape(-1, 3)
    off = np.abs(sides - np.median(sides, axis=0)).max(axis=1)
    return bool((off > 1.5 * _ROUGH_LEVELS).mean() < 1.5 * _ROUGH)


def _quiet(away: cv2.typing.MatLike) -> bool:
    """Whether at least two corners look like the sides beside them."""
    height, width = (side // 4 for side in away.shape)
    corners = (away[:height, :width], away[:height, -width:], away[-height:, :width], away[-height:, -width:])
    rough = sorted(float((corner > _ROUGH_LEVELS).mean()) for corner in corners)
    return rough[0] < _ROUGH and rough[1] < 1.5 * _ROUGH
