"""The object where neither a reference nor a plain background helps: what has other colours than the frame's border."""

from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray
from hbr.segmentation.background import Mask

#: The part of the frame that an object may be in: left, top, right, bottom.
_WITHIN: Final = (0.2, 0.12, 0.8, 0.9)
#: Where objects stand before a camera that looks at a turntable: a bell of this middle and these widths.
_MIDDLE: Final = (0.5, 0.56)
_SPREAD: Final = (0.16, 0.22)
#: What is taken for the object at first: where the bell is higher than this. The next is tried where a cut comes to
#: nothing, or to all.
_STARTS: Final = (0.5, 0.3, 0.7, 0.15)
#: Share of the frame that an object takes.
_LEAST, _MOST = 0.015, 0.45
#: Radius of what connects the object with something behind it and is cut, as a share of the longer side.
_BRIDGE: Final = 0.024
#: A part beside the main one belongs to the object if it has this share of its area, and this mean height of the bell.
_PART: Final = 0.08
_PLACED: Final = 0.35
_NEAR_PX: Final = 3

Binary = NDArray[np.uint8]


def guessed(small: ImageArray) -> Mask | None:
    """Cut out what stands in the middle by its colours, bool (h, w); None where that does not come to an end.

    Of what differs from the border only that part is kept which stands where objects stand; clutter behind it is cut
    off. The hull of it is returned: a guess is more often right about where the object ends than about its holes.

    Source: C. Rother, V. Kolmogorov and A. Blake, "GrabCut", SIGGRAPH 2004. Takes some 12 ms, several times as long
    as the other ways, and is right less often.
    """
    height, width = small.shape[:2]
    size = max(32, width), max(32, height)  # mixtures of five colours want some pixels
    image = cv2.resize(small, size, interpolation=cv2.INTER_LINEAR) if size != (width, height) else small
    smooth = cv2.bilateralFilter(image, 5, 30, 3)
    bell = _bell(size[1], size[0])
    for start in _STARTS:
        part = _main_part(_cut(smooth, bell > start), bell)
        if part is not None and _LEAST < part.mean() < _MOST:
            hull = np.zeros_like(part)
            cv2.fillConvexPoly(hull, cv2.convexHull(cv2.findNonZero(part)), (1,))
            found: Mask = cv2.resize(hull, (width, height), interpolation=cv2.INTER_NEAREST) > 0
            return found
    return None


def _cut(image: cv2.typing.MatLike, start: Mask) -> Binary:
    height, width = start.shape
    labels = np.full((height, width), cv2.GC_BGD, np.uint8)
    left, top, right, bottom = (int(part * (width, height)[i % 2]) for i, part in enumerate(_WITHIN))
    inner = start[top:bottom, left:right]
    labels[top:bottom, left:right] = np.where(inner, cv2.GC_PR_FGD, cv2.GC_PR_BGD)
    cv2.setRNGSeed(0)  # GrabCut clusters colours from random starts; equal frames must give equal cuts
    cv2.grabCut(image, labels, None, np.zeros((1, 65)), np.zeros((1, 65)), 1, cv2.GC_INIT_WITH_MASK)  # type: ignore[call-overload]
    return np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8)


def _main_part(cut: Binary, bell: NDArray[np.float32]) -> Binary | None:
    """The part that most of the bell stands on, and those close to it, without bridges to anything behind."""
    radius = max(1, round(_BRIDGE * max(cut.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(cv2.morphologyEx(cut, cv2.MORPH_OPEN, disc))
    if count < 2:
        return None
    weight = np.bincount(labels.ravel(), bell.ravel(), count)[1:]
    x, y, w, h, area = stats[1:].T
    main = int(weight.argmax())
    near = (x < x[main] + w[main] + _NEAR_PX) & (x[main] < x + w + _NEAR_PX)
    near &= (y < y[main] + h[main] + _NEAR_PX) & (y[main] < y + h + _NEAR_PX)
    keep = near & (area > _PART * area[main]) & (weight > _PLACED * area)
    keep[main] = True
    part = np.isin(labels, 1 + np.flatnonzero(keep)).astype(np.uint8)
    return cv2.dilate(part, np.ones((3, 3), np.uint8)).astype(np.uint8) & cut


@lru_cache
def _bell(height: int, width: int) -> NDArray[np.float32]:
    x = ((np.arange(width) + 0.5) / width - _MIDDLE[0]) / _SPREAD[0]
    y = ((np.arange(height) + 0.5) / height - _MIDDLE[1]) / _SPREAD[1]
    bell: NDArray[np.float32] = np.exp(-0.5 * (x * x + (y * y)[:, None])).astype(np.float32)
    return bell
