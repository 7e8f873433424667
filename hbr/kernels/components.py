"""Kernels for the connected parts of a mask. Each returns None without the compiled library."""

import ctypes

import numpy as np
from numpy.typing import NDArray

from hbr.kernels.calls import WORKSPACE
from hbr.kernels.library import address, library

Bytes = NDArray[np.uint8]

#: Size of a run of pixels in the kernel, in float64 numbers.
_RUN = 6


def largest_parts(mask: Bytes, framed: bool, near: int, least: float, of_border: float, share: float) -> Bytes | None:
    """Return the largest part of a mask of 0 and 1, and those that have this share of its area.

    Parameters
    ----------
    mask : uint8 array (h, w)
    framed : bool
        Whether parts that touch the border are left out, and only parts nearer than ``near`` pixels count.
    near : int
    least : float
        Smallest area of the largest part; also a share ``of_border`` of the largest part at the border.
    of_border, share : float

    Returns
    -------
    uint8 array (h, w)
        Without elements, (0,), if the largest part is too small.
    """
    found = library()
    if found is None:
        return None
    height, width = mask.shape
    mask, out, done = np.ascontiguousarray(mask), np.empty((height, width), np.uint8), ctypes.c_int64()
    work = WORKSPACE.grown(_RUN * height * (width + 1) // 2)
    found.hbr_largest_parts(
        address(mask), height, width, framed, near, least, of_border, share, work.address, address(out),
        ctypes.byref(done),
    )  # fmt: skip
    return out if done.value else np.empty(0, np.uint8)


def likely_parts(mask: Bytes, prior: NDArray[np.float32], near: int, share: float, mean: float) -> Bytes | None:
    """Return the part of a mask of 0 and 1 with the largest sum of ``prior``, and those that belong to it.

    Parameters
    ----------
    mask : uint8 array (h, w)
    prior : float32 array (h, w)
    near : int
        Smallest distance, in pixels, of parts that do not belong to the main part.
    share : float
        Smallest share of the main part's area for another part.
    mean : float
        Smallest mean of ``prior`` for another part.

    Returns
    -------
    uint8 array (h, w)
        Without elements, (0,), if the mask is empty.
    """
    found = library()
    if found is None:
        return None
    height, width = mask.shape
    mask, prior = np.ascontiguousarray(mask), np.ascontiguousarray(prior)
    out, done = np.empty((height, width), np.uint8), ctypes.c_int64()
    work = WORKSPACE.grown(_RUN * height * (width + 1) // 2)
    found.hbr_likely_parts(
        address(mask), height, width, address(prior), near, share, mean, work.address, address(out), ctypes.byref(done)
    )
    return out if done.value else np.empty(0, np.uint8)
