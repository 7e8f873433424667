"""Kernels for masks of 0 and 1. Each returns None without the compiled library."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hbr.kernels.library import address, library

Bytes = NDArray[np.uint8]

#: Margin of a mask in the kernels, in pixels.
_EDGE: Final = 16


class Disc(NamedTuple):
    """A symmetric disc; ``reach`` (2 radius + 1) says how many pixels each of its rows reaches to both sides."""

    radius: int
    reach: NDArray[np.int64]


def cleaned(mask: Bytes, opens: Disc, closes: Disc) -> Bytes | None:
    """Return a mask (h, w) after morphological opening with one disc and closing with another one.

    The radii are below 16. Pixels outside the mask do not count, as in cv2.morphologyEx.
    """
    found = library()
    if found is None:
        return None
    height, width = mask.shape
    mask, out, work = np.ascontiguousarray(mask), np.empty((height, width), np.uint8), _work(height, width)
    found.hbr_cleaned(
        address(mask), height, width, address(opens.reach), opens.radius, address(closes.reach), closes.radius,
        address(work), address(out),
    )  # fmt: skip
    return out


def filled(mask: Bytes, closes: Disc) -> Bytes | None:
    """Return a mask (h, w) after closing with a disc of a radius below 16, without holes."""
    found = library()
    if found is None:
        return None
    height, width = mask.shape
    work = _work(height + 2 * _EDGE, width)
    mask, out = np.ascontiguousarray(mask), np.empty((height, width), np.uint8)
    found.hbr_filled(address(mask), height, width, address(closes.reach), closes.radius, address(work), address(out))
    return out


def _work(rows: int, width: int) -> NDArray[np.uint64]:
    """Return zeros for four masks of a bit for each pixel."""
    return np.zeros(4 * rows * ((width + 2 * _EDGE + 63) // 64) + 4, np.uint64)
