"""Segmentation by rotation: the background is learned from the views of one search or enrollment.

While the table rotates, the background stands still, and the object and the platter's marks move. So a view is compared
with the median of the other views: behind the object most of them show the background. Such a median can show the
object, too; the network was trained with such medians and combines them with the frame.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from hbr.core.arrays import ImageArray
from hbr.segmentation.background import Background, shrunk

#: Largest number of views that the background is learned from.
_MOST: Final = 9


class LearnedBackground:
    """The views of one search or enrollment, from one camera before one background in one light."""

    def __init__(self) -> None:
        self._shape: tuple[int, int] | None = None
        self._small: list[ImageArray] = []

    def __len__(self) -> int:
        return len(self._small)

    def add(self, image_bgr: ImageArray, small: ImageArray | None = None) -> None:
        """Add a view, uint8 (H, W, 3); ``small`` is what `shrunk` returns for it, if that is known.

        Raises
        ------
        ValueError
            The view has another size than the others.
        """
        height, width = image_bgr.shape[:2]
        if self._shape is not None and self._shape != (height, width):
            raise ValueError(
                f"the view has {width} x {height} pixels, the others {self._shape[1]} x {self._shape[0]}; "
                "views of one search need one size"
            )
        self._shape = height, width
        self._small.append(shrunk(image_bgr) if small is None else small)

    def of(self, view: int) -> Background | None:
        """Return the background of a view, learned from the others; None with a single view."""
        others = [n for n in range(len(self)) if n != view]
        if not others or self._shape is None:
            return None
        if len(others) > _MOST:  # evenly spread over all views
            others = [others[n * len(others) // _MOST] for n in range(_MOST)]
        return Background.learned(median([self._small[n] for n in others]), self._shape)


def median(images: Sequence[ImageArray]) -> ImageArray:
    """Return the median of each value of at most a few images of one shape, uint8, rounded down.

    The images are sorted up to their middle by pairwise minima and maxima, which is ten times faster than a partition
    of each pixel.
    """
    ranked = [image.copy() for image in images]
    middle = len(ranked) // 2
    for rank in range(middle + 1):
        for n in range(len(ranked) - 1, rank, -1):
            lower = np.minimum(ranked[n - 1], ranked[n])
            np.maximum(ranked[n - 1], ranked[n], out=ranked[n])
            ranked[n - 1] = lower
    if len(ranked) % 2:
        return ranked[middle]
    return ((ranked[middle - 1].astype(np.uint16) + ranked[middle]) // 2).astype(np.uint8)
