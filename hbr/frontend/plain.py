"""The object before a plain background that no reference shows."""

from typing import Final

import cv2
import numpy as np

from hbr.arrays import ImageArray
from hbr.frontend.background import Mask

#: A pixel differs when it does by this many grey levels, or by this share of what the object differs.
_LEAST_LEVELS: Final = 12.0
_SHARE: Final = 0.25
#: More of the frame's border than this must not differ.
_ROUGH: Final = 0.3


def plain_difference(small: ImageArray) -> Mask | None:
    """Where a small image differs from its background, bool (h, w); None where its border is not plain.

    The background of a row is what lies between its two ends, which a horizon does not disturb.
    """
    height, width = small.shape[:2]
    image = cv2.GaussianBlur(small, (0, 0), 1.3).astype(np.float32)
    edge = max(2, width // 32)
    left, right = (cv2.blur(np.median(part, axis=1)[:, None], (1, 9)) for part in (image[:, :edge], image[:, -edge:]))
    left, right = left.reshape(height, 1, 3), right.reshape(height, 1, 3)
    across = ((np.arange(width, dtype=np.float32) + 0.5) / width)[None, :, None]
    away = np.abs(image - (left + (right - left) * across)).max(axis=2)
    border = np.concatenate([away[:edge].ravel(), away[:, :edge].ravel(), away[:, -edge:].ravel()])
    threshold = max(_LEAST_LEVELS, 4 * float(np.median(border)))
    if (border > threshold).mean() > _ROUGH:
        return None
    differs: Mask = away > max(threshold, _SHARE * float(np.quantile(away, 0.95)))
    return differs
