"""A guess of the object by its colours, for frames without empty-table image and without plain background."""

from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray
from hbr.segmentation.background import Mask

#: Part of the frame that an object may be in: left, top, right, bottom.
_WITHIN: Final = (0.2, 0.12, 0.8, 0.9)
#: Where an object usually is in the image of a turntable: middle and widths of a bell-shaped weight (x, y).
_MIDDLE: Final = (0.5, 0.56)
_SPREAD: Final = (0.16, 0.22)
#: GrabCut starts from the pixels whose weight is higher than this. If it returns nothing or everything, it starts again
#: with the next value.
_STARTS: Final = (0.5, 0.3, 0.7, 0.15)
#: Smallest and largest share of the frame that an object takes.
_LEAST, _MOST = 0.015, 0.45
#: Connections to clutter behind the object are cut if thinner than this radius, a share of the longer side.
_BRIDGE: Final = 0.024
#: Another part belongs to the object if it has this share of the main part's area, and this mean weight.
_PART: Final = 0.08
_PART_WEIGHT: Final = 0.35
_NEAR_PX: Final = 3

Binary = NDArray[np.uint8]


def guess_object(small: ImageArray) -> Mask | None:
    """Return a mask of the object in the middle, found by its colours, bool (h, w); None if there is no clear part.

    GrabCut separates colours of the middle from colours of the border. Parts away from the usual place of an object
    are clutter and are removed. The convex hull is returned, because a guess finds the object's outline more reliably
    than its holes.

    Source: C. Rother, V. Kolmogorov and A. Blake, "GrabCut", SIGGRAPH 2004. Takes several times as long as the other
    methods, and is correct less often.
    """
    height, width = small.shape[:2]
    size = max(32, width), max(32, height)  # GrabCut fits mixtures of five colours and needs enough pixels
    image = cv2.resize(small, size, interpolation=cv2.INTER_LINEAR) if size != (width, height) else small
    smooth = cv2.bilateralFilter(image, 5, 30, 3).astype(np.uint8, copy=False)
    prior = _prior(size[1], size[0])
    for start in _STARTS:
        part = _main_part(_cut(smooth, prior > start), prior)
        if part is not None and _LEAST < part.mean() < _MOST:
            hull = np.zeros_like(part)
            cv2.fillConvexPoly(hull, cv2.convexHull(cv2.findNonZero(part)), (1,))
            found: Mask = cv2.resize(hull, (width, height), interpolation=cv2.INTER_NEAREST) > 0
            return found
    return None


def _cut(image: ImageArray, start: Mask) -> Binary:
    height, width = start.shape
    left, top, right, bottom = (int(part * (width, height)[i % 2]) for i, part in enumerate(_WITHIN))
    labels = np.full((height, width), cv2.GC_BGD, np.uint8)
    inner = start[top:bottom, left:right]
    labels[top:bottom, left:right] = np.where(inner, cv2.GC_PR_FGD, cv2.GC_PR_BGD)
    cv2.setRNGSeed(0)  # GrabCut starts at random; equal frames must give equal masks
    cv2.grabCut(image, labels, None, np.zeros((1, 65)), np.zeros((1, 65)), 1, cv2.GC_INIT_WITH_MASK)  # type: ignore[call-overload]
    return np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8)


def _main_part(cut: Binary, prior: NDArray[np.float32]) -> Binary | None:
    """Return the part with the largest weight and the parts close to it, without thin connections to clutter."""
    radius = max(1, round(_BRIDGE * max(cut.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    opened = cv2.morphologyEx(cut, cv2.MORPH_OPEN, disc).astype(np.uint8, copy=False)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened)
    if count < 2:
        return None
    weight = np.bincount(labels.ravel(), prior.ravel(), count)[1:]
    x, y, w, h, area = stats[1:].T
    main = int(weight.argmax())
    near = (x < x[main] + w[main] + _NEAR_PX) & (x[main] < x + w + _NEAR_PX)
    near &= (y < y[main] + h[main] + _NEAR_PX) & (y[main] < y + h + _NEAR_PX)
    keep = near & (area > _PART * area[main]) & (weight > _PART_WEIGHT * area)
    keep[main] = True
    part = np.isin(labels, 1 + np.flatnonzero(keep)).astype(np.uint8)
    return cv2.dilate(part, np.ones((3, 3), np.uint8)).astype(np.uint8) & cut


@lru_cache
def _prior(height: int, width: int) -> NDArray[np.float32]:
    x = ((np.arange(width) + 0.5) / width - _MIDDLE[0]) / _SPREAD[0]
    y = ((np.arange(height) + 0.5) / height - _MIDDLE[1]) / _SPREAD[1]
    prior: NDArray[np.float32] = np.exp(-0.5 * (x * x + (y * y)[:, None])).astype(np.float32)
    return prior
