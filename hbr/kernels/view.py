"""Kernels for parts of the segmentation of a view. Each returns None without the compiled library."""

from functools import lru_cache
from math import ceil, floor
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray
from hbr.kernels.calls import Addresses
from hbr.kernels.library import address, library

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

#: Sums of more bytes do not fit into 16 bits.
_MOST_ROWS: Final = 257


def shrink(image: ImageArray, size: tuple[int, int]) -> ImageArray | None:
    """Return an image averaged to (width, height), as cv2.INTER_AREA does, if one whole number above 2 divides it."""
    found = library()
    width, height = size
    factor = image.shape[1] // width
    if found is None or not 2 < factor <= _MOST_ROWS or image.shape[:2] != (height * factor, width * factor):
        return None
    if image.strides[1:] != (3, 1):
        image = np.ascontiguousarray(image)
    sums, small = np.empty(3 * image.shape[1], np.uint16), np.empty((height, width, 3), np.uint8)
    found.hbr_shrink(address(image), image.strides[0], height, width, factor, address(sums), address(small))
    return small


class _Taps:
    """The pixels, and their weights, of which each pixel of a shrunk row is the average."""

    def __init__(self, size: int, side: int) -> None:
        scale = size / side
        rows: list[tuple[int, list[float]]] = []
        for x in range(side):
            begin, end = x * scale, x * scale + scale
            width = min(scale, size - begin)
            last = min(floor(end), size - 1)
            whole = min(ceil(begin), last)
            weights = [1 / width] * (last - whole)
            first = whole
            if whole - begin > 1e-3:
                weights.insert(0, (whole - begin) / width)
                first -= 1
            if end - last > 1e-3:
                weights.append(min(min(end - last, 1.0), width) / width)
            rows.append((first, weights))
        self.most = max(len(weights) for _, weights in rows)
        self._first = np.array([first for first, _ in rows], np.int64)
        self._count = np.array([len(weights) for _, weights in rows], np.int64)
        self._weights = np.zeros((side, self.most), np.float32)
        for row, (_, weights) in zip(self._weights, rows, strict=True):
            row[: len(weights)] = weights
        self.addresses = address(self._first), address(self._count), address(self._weights)


_taps = lru_cache(maxsize=512)(_Taps)


def average(image: ImageArray, side: int) -> ImageArray | None:
    """Return a square image of more than ``side`` pixels averaged to ``side``, as cv2.INTER_AREA does."""
    found = library()
    size = image.shape[0]
    if found is None or image.shape[1] != size or not size > side or not size % side:
        return None
    if image.strides[1:] != (3, 1):
        image = np.ascontiguousarray(image)
    taps = _taps(size, side)
    floats, out = np.zeros(4 * (size + 2 * side), np.float32), np.empty((side, side, 3), np.uint8)
    start = address(floats)
    found.hbr_average(
        address(image), image.strides[0], size, side, *taps.addresses, taps.most,
        start, start + 16 * size, start + 16 * (size + side), address(out),
    )  # fmt: skip
    return out


def compare(
    small: ImageArray,
    table: ImageArray,
    table_log: Floats,
    along: Floats,
    down: Floats,
    tables: Addresses,
    agrees_below: float,
) -> tuple[Floats, Floats, Bytes, Bytes, Bytes] | None:
    """Compare a small frame with an empty-table image, as `hbr.segmentation.background.Background.difference` does.

    Returns the planes ``evenly`` and ``coloured``, and 0 or 1 for pixels that are certain, possible and in agreement.
    """
    found = library()
    if found is None:
        return None
    height, width = small.shape[:2]
    small, table = np.ascontiguousarray(small), np.ascontiguousarray(table)
    floats, masks = np.empty((2, height, width), np.float32), np.empty((3, height, width), np.uint8)
    plane, start, masked = 4 * height * width, address(floats), address(masks)
    found.hbr_difference(
        address(small), address(table), address(table_log), height, width, address(along), address(down),
        tables.address, agrees_below, start, start + plane, *(masked + k * height * width for k in range(3)),
    )  # fmt: skip
    return floats[0], floats[1], masks[0], masks[1], masks[2]


def closed(mask: Bytes, reach: NDArray[np.int64]) -> Bytes | None:
    """Return a mask of 0 and 1 after morphological closing with a disc whose rows reach so far to both sides."""
    found = library()
    if found is None:
        return None
    height, width = mask.shape
    radius = len(reach) // 2
    mask = np.ascontiguousarray(mask)
    spread, out = np.empty((height, radius + 1, width), np.uint8), np.empty((2, height, width), np.uint8)
    start = address(out)
    found.hbr_closed(
        address(mask), height, width, address(reach), radius, address(spread), start, start + height * width
    )
    closed: Bytes = out[1]
    return closed
