"""Types of the arrays that retrieval uses, and segments of different lengths in one array, one after the other."""

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
