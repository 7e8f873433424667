"""Kernels for parts of the segmentation of a view. Each returns None without the compiled library."""

from functools import lru_cache
from math import ceil, floor
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray
from hbr.kernels.library import address, library

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

#: Largest number of bytes whose sum fits into 16 bits.
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
    sums, small = np.empty(3 * image.shape[1] + 1, np.uint16), np.empty((height, width, 3), np.uint8)
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
        self._first = np.array([min(first, size - self.most) for first, _ in rows], np.int64)
        self._weights = np.zeros((side, self.most), np.float32)
        for row, at, (first, weights) in zip(self._weights, self._first, rows, strict=True):
            row[first - at : first - at + len(weights)] = weights
        self.addresses = address(self._first), address(self._weights)


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
    floats, out = np.zeros(8 * side + 3 * size + 1, np.float32), np.empty((side, side, 3), np.uint8)
    start = address(floats)
    found.hbr_average(
        address(image), image.strides[0], size, side, *taps.addresses, taps.most,
        start + 32 * side, start, start + 16 * side, address(out),
    )  # fmt: skip
    return out


def surround(crop: ImageArray, mask: Bytes, bright: float) -> ImageArray | None:
    """Return a square crop with an even grey around the object, like `Segmentation.alone`."""
    found = library()
    side = len(crop)
    if found is None or crop.shape != (side, side, 3) or mask.shape != (side, side):
        return None
    crop, mask = np.ascontiguousarray(crop), np.ascontiguousarray(mask)
    blurred, line, out = np.empty(side * side, np.uint16), np.empty(side + 14, np.uint8), np.empty_like(crop)
    found.hbr_surround(address(crop), address(mask), side, bright, address(line), address(blurred), address(out))
    return out


def compare(
    small: ImageArray,
    table: ImageArray,
    logarithm: Floats,
    table_log: Floats,
    sides: tuple[Floats, Floats],
    noise: Floats,
    agrees_below: float,
) -> tuple[Floats, Floats, Bytes, Bytes, Bytes] | None:
    """Compare a small frame with an empty-table image, as `hbr.segmentation.background.Background.difference` does.

    ``logarithm`` (256,) is that of each level, ``table_log`` (h, w, 3) that of the table. Returns the planes ``evenly``
    and ``coloured``, and 0 or 1 for pixels that are certain, possible and in agreement.
    """
    found = library()
    if found is None:
        return None
    height, width = small.shape[:2]
    arrays = [np.ascontiguousarray(one) for one in (small, table, logarithm, table_log, *sides, noise)]
    own = [address(one) for one in arrays]
    floats, masks = np.empty((2, height, width), np.float32), np.empty((3, height, width), np.uint8)
    line = np.empty(8 * width, np.float32)
    plane, start, masked = 4 * height * width, address(floats), address(masks)
    found.hbr_difference(
        *own[:4], height, width, *own[4:], agrees_below, address(line),
        start, start + plane, *(masked + k * height * width for k in range(3)),
    )  # fmt: skip
    return floats[0], floats[1], masks[0], masks[1], masks[2]
