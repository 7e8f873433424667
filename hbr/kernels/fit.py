"""Kernels for the fit of a plane to the difference of two images. Each returns None without the compiled library."""

import ctypes

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray
from hbr.kernels.calls import WORKSPACE
from hbr.kernels.library import address, library

Floats = NDArray[np.float32]


def samples(
    small: ImageArray, useful: NDArray[np.bool_], logarithm: Floats, table_log: Floats, plane: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return every fifth pixel in both directions that is neither black nor overexposed in both images.

    Parameters
    ----------
    small : uint8 array (h, w, 3)
        An image,
    useful : bool array (h, w)
        Which pixels of the other image are useful.
    logarithm : float32 array (256,)
        The logarithm of each level of ``small``.
    table_log : float32 array (h, w, 3)
        The logarithms of the other image.
    plane : float64 array (rows, columns, 3)
        The basis of the fit at these pixels.

    Returns
    -------
    basis, difference : float64 arrays (n, 3)
    median : float64 array (3,)
        Of the differences.
    """
    found = library()
    if found is None:
        return None
    arrays = [np.ascontiguousarray(one) for one in (small, useful, logarithm, table_log, plane)]
    own = [address(one) for one in arrays]
    most = plane.shape[0] * plane.shape[1]
    taken, median, count = np.empty((2, most, 3)), np.zeros(3), ctypes.c_int64()
    start = address(taken)
    found.hbr_samples(
        *own[:4], *useful.shape, own[4], WORKSPACE.grown(3 * most).address, start, start + 24 * most, address(median),
        ctypes.byref(count),
    )  # fmt: skip
    return taken[0, : count.value], taken[1, : count.value], median


def inliers(
    values: FloatArray, fitted: FloatArray, basis: FloatArray, tolerance: float, quarter: int
) -> tuple[FloatArray, FloatArray] | None:
    """Return the rows of ``basis`` and ``values`` (n, 3) that are near what is fitted: at least ``quarter`` + 1.

    Raises
    ------
    ValueError
        The arrays are not contiguous.
    """
    found = library()
    if found is None:
        return None
    if not values.flags.c_contiguous or not fitted.flags.c_contiguous or not basis.flags.c_contiguous:
        raise ValueError("the rows of a fit have gaps")
    count = len(values)
    near, kept = np.empty((2, count, 3)), ctypes.c_int64()
    start = address(near)
    found.hbr_inliers(
        address(values), address(fitted), address(basis), count, tolerance, quarter,
        WORKSPACE.grown(2 * count).address, start, start + 24 * count, ctypes.byref(kept),
    )  # fmt: skip
    return near[0, : kept.value], near[1, : kept.value]
