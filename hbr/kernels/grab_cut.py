"""Kernel for the cut of an object by its colours. Returns None without the compiled library."""

import ctypes
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import ImageArray
from hbr.kernels.calls import WORKSPACE
from hbr.kernels.library import address, library

#: Memory of the kernel for each pixel, in float64 numbers.
_WORK = 18


@lru_cache(maxsize=1)
def _functions() -> tuple[int, int] | None:
    """Return the addresses of exp and log of the C library, which OpenCV calls, too; None if there is none."""
    for name in ("libm.so.6", None):
        try:
            found = ctypes.CDLL(name)
            exponential, logarithm = (ctypes.cast(each, ctypes.c_void_p).value for each in (found.exp, found.log))
        except (OSError, AttributeError):
            continue
        if exponential and logarithm:
            return exponential, logarithm
    return None


def grab_cut(image: ImageArray, start: NDArray[np.bool_], inner: tuple[int, int, int, int]) -> NDArray[np.uint8] | None:
    """Return the mask of one iteration of `cv2.grabCut` with the seed 0 of its random numbers, 0 or 1 (h, w).

    Pixels outside of the rectangle ``inner`` (left, top, right, bottom), which is not at the frame's border, are
    background. Inside, ``start`` (h, w) marks the pixels that probably show the object. Also returns None for images
    whose colours OpenCV cannot separate, or with too many pixels.

    The mask is that of OpenCV 5.0.0 on x86-64, bit by bit.
    """
    found, functions = library(), _functions()
    if found is None or functions is None:
        return None
    height, width = start.shape
    image, start = np.ascontiguousarray(image), np.ascontiguousarray(start)
    mask, done = np.empty((height, width), np.uint8), ctypes.c_int64()
    work = WORKSPACE.grown(_WORK * height * width)
    found.hbr_grab_cut(
        address(image), height, width, (ctypes.c_int64 * 4)(*inner), address(start), *functions, work.address,
        address(mask), ctypes.byref(done),
    )  # fmt: skip
    return mask if done.value else None
