"""Arrays of unequal length laid end to end."""

import numpy as np

from hbr.core.arrays import FloatArray, IndexArray


def ranges(start: IndexArray, count: IndexArray) -> tuple[IndexArray, IndexArray]:
    """``start[i] .. start[i] + count[i] - 1`` for all i, end to end, and where each begins."""
    end = np.cumsum(count)
    begin = end - count
    return np.arange(end[-1] if len(end) else 0) + np.repeat(start - begin, count), begin


def lengths(begin: IndexArray, total: int) -> IndexArray:
    """Lengths of the segments that begin there and fill the total."""
    end = np.empty_like(begin)
    end[:-1], end[-1:] = begin[1:], total
    return end - begin


def first_maximum(values: FloatArray, begin: IndexArray) -> IndexArray:
    """Index of the maximum of each segment, the first of equals; no segment may be empty."""
    maxima = np.maximum.reduceat(values, begin)
    reached = np.flatnonzero(values == np.repeat(maxima, lengths(begin, len(values))))
    return reached[np.searchsorted(reached, begin)]
