"""The object's silhouette, from the pixels that differ from the background."""

from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.segmentation.background import Mask

Binary = NDArray[np.uint8]

#: Smallest share of the frame that an object takes.
_LEAST: Final = 0.004
#: Another part belongs to the object if it has this share of the largest part's area.
_PART: Final = 0.08
#: and, if something may reach into the frame, is so near.
_NEAR_PX: Final = 5
#: The object is smaller than a part at the frame's border by at most this.
_OF_BORDER: Final = 0.6
#: Radii of the bars that are removed when something reaches into the frame, in pixels of the small image.
_BARS: Final = (0, 2, 3, 4, 5)
#: Rows at the foot that are narrower than this share of the median row are the rest of a removed bar.
_STUMP: Final = 0.35


def silhouette(certain: Mask, possible: Mask | None = None, *, framed: bool) -> Mask | None:
    """Return the object's silhouette without holes, bool (h, w); None if there is no object.

    Parameters
    ----------
    certain, possible : bool arrays (h, w)
        Pixels that are not background, and pixels that may be shadow; the latter count inside the object's hull.
    framed : bool
        Whether anything that touches the frame's border is not the object: a holder, a hand, a shelf.
    """
    everything = _cleaned(certain.astype(np.uint8))
    for radius in _BARS if framed else _BARS[:1]:
        kept = _main_parts(_opened(everything, radius), framed=framed)
        if kept is None:
            continue
        if radius:  # restore the corners that the opening rounded off
            kept = _without_stump(cv2.dilate(kept, _disc(1)).astype(np.uint8) & everything)
        if possible is not None:
            hull = np.zeros_like(kept)
            # the hull of the outlines equals that of all pixels, and takes a tenth of the time
            outlines, _ = cv2.findContours(kept, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
            cv2.fillConvexPoly(hull, cv2.convexHull(np.concatenate(outlines)), (1,))
            kept |= hull & possible
        return _filled(kept)
    return None


def _cleaned(mask: Binary) -> Binary:
    """Remove single pixels, and join what is separated by a few."""
    opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, _disc(1))
    return cv2.morphologyEx(opened, cv2.MORPH_CLOSE, _disc(3)).astype(np.uint8, copy=False)


def _without_stump(mask: Binary) -> Binary:
    """Remove the rest of a holder from below: objects stand on a wider base."""
    widths = np.count_nonzero(mask, axis=1)
    foot = np.flatnonzero(widths >= _STUMP * np.median(widths[widths > 0]))[-1]
    mask[foot + 1 :] = 0
    return mask


def _opened(mask: Binary, radius: int) -> Binary:
    return cv2.morphologyEx(mask, cv2.MORPH_OPEN, _disc(radius)).astype(np.uint8) if radius else mask


def _main_parts(mask: Binary, *, framed: bool) -> Binary | None:
    """Return the largest part and those close to it; None if a part that touches the border is much larger."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    if count < 2:
        return None
    height, width = mask.shape
    x, y, w, h, area = stats[1:].T
    outside = framed & ((x == 0) | (y == 0) | (x + w == width) | (y + h == height))
    inner, outer = np.where(outside, 0, area), np.where(outside, area, 0)
    largest = int(inner.argmax())
    if inner[largest] < max(_LEAST * mask.size, _OF_BORDER * outer.max()):
        return None
    near = (x < x[largest] + w[largest] + _NEAR_PX) & (x[largest] < x + w + _NEAR_PX)
    near &= (y < y[largest] + h[largest] + _NEAR_PX) & (y[largest] < y + h + _NEAR_PX)
    keep = (inner > _PART * inner[largest]) & (near if framed else True)
    chosen = 1 + np.flatnonzero(keep)
    return (labels == chosen[0] if len(chosen) == 1 else np.isin(labels, chosen)).view(np.uint8)


def _filled(mask: Binary) -> Mask:
    margin = 12  # so that closing does not see the frame's border as background
    height, width = mask.shape
    wide = cv2.copyMakeBorder(mask, margin, margin, margin, margin, cv2.BORDER_CONSTANT)
    closed = cv2.morphologyEx(wide, cv2.MORPH_CLOSE, _disc(8)).astype(np.uint8, copy=False)
    contours, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(closed, contours, -1, (1,), -1)
    filled: Mask = closed[margin : margin + height, margin : margin + width] > 0
    return filled


@lru_cache
def _disc(radius: int) -> Binary:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)).astype(np.uint8)
