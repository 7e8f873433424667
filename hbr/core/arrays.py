"""Types of the arrays that retrieval uses, checks of images, and segments of different lengths in one array."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

#: An image, (H, W, 3), in the order blue, green, red.
ImageArray = NDArray[np.uint8]
#: CEDD levels 0..7, (144,) or (n, 144).
LevelArray = NDArray[np.uint8]
FloatArray = NDArray[np.float64]
#: Single or double precision.
RealArray = NDArray[np.floating]
IndexArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


def ranges(start: IndexArray, count: IndexArray) -> tuple[IndexArray, IndexArray]:
    """Return ``start[i] .. start[i] + count[i] - 1`` for all i, joined, and the position at which each begins."""
    end = np.cumsum(count)
    begin = end - count
    return np.arange(end[-1] if len(end) else 0) + np.repeat(start - begin, count), begin


def lengths(begin: IndexArray, total: int) -> IndexArray:
    """Return the lengths of the segments that begin at the positions ``begin``; their sum is ``total``."""
    end = np.empty_like(begin)
    end[:-1], end[-1:] = begin[1:], total
    return end - begin


def first_maximum(values: FloatArray, begin: IndexArray) -> IndexArray:
    """Return the index of the first maximum of each segment. No segment may be empty."""
    maxima = np.maximum.reduceat(values, begin)
    reached = np.flatnonzero(values == np.repeat(maxima, lengths(begin, len(values))))
    return reached[np.searchsorted(reached, begin)]


#: Smallest side of a frame that can be segmented.
MIN_SIDE_PX: Final = 16


def check_image(image: object) -> None:
    """Check that an image is a uint8 array of shape (H, W, 3) and not empty.

    Raises `TypeError`, `ValueError`: the image has another type or shape. The message names them, and the next step.
    """
    if not isinstance(image, np.ndarray):
        raise TypeError(
            f"the image is a {type(image).__name__}, not an array; cv2.imread returns None if it cannot read the file"
        )
    if image.dtype != np.uint8:
        raise TypeError(f"the image is of {image.dtype}; scale it to 0..255 and convert it with .astype(np.uint8)")
    if image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 1):
        raise ValueError(f"the image is grey, shape {image.shape}; use cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)")
    if image.ndim == 3 and image.shape[2] == 4:
        raise ValueError(f"the image has alpha, shape {image.shape}; composite it, or use cv2.COLOR_BGRA2BGR")
    if image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"the image has shape {image.shape}; one BGR image of shape (H, W, 3) is needed")
    if image.size == 0:
        raise ValueError(f"the image is empty, shape {image.shape}; check the capture or the crop")


def check_frame(image: object) -> None:
    """Check an image like `check_image`, and that it is large enough for a segmentation.

    Raises `TypeError`, `ValueError`: as `check_image`, or a side is shorter than 16 pixels.
    """
    check_image(image)
    assert isinstance(image, np.ndarray)
    if min(image.shape[:2]) < MIN_SIDE_PX:
        raise ValueError(
            f"the frame has {image.shape[1]} x {image.shape[0]} pixels; sides of at least {MIN_SIDE_PX} are needed"
        )
