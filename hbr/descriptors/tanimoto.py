"""The Tanimoto coefficient (Eq. 1 of Czúni and Rashad, Sensors 2018, 18(3), 801)."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray
from hbr.kernels import library
from hbr.kernels.calls import ByteRows

#: From this number of rows on, a matrix product is as fast as the compiled kernel.
_MANY: Final = 8

Descriptors = NDArray[np.uint8] | FloatArray


def tanimoto(a: Descriptors, b: Descriptors) -> FloatArray:
    """Return the similarity of every row of `a` to every row of `b`: a·b / (a·a + b·b - a·b).

    Parameters
    ----------
    a : uint8 or float array (n, d), or (d,) for one row
        Descriptors: levels, or real-valued averages of levels.
    b : uint8 or float array (m, d), or (d,) for one row
        Descriptors to compare with.

    Returns
    -------
    float64 array (n, m)
        1 for equal rows, 0 if either row is all zero. For uint8 rows the value is the correctly rounded quotient of two
        exact integers, so that equal ratios are equal.

    Raises
    ------
    ValueError
        The rows have different lengths.
    """
    rows_a, rows_b = np.atleast_2d(a), np.atleast_2d(b)
    if rows_a.ndim != 2 or rows_b.ndim != 2 or rows_a.shape[1] != rows_b.shape[1]:
        raise ValueError(
            f"descriptors of shapes {np.shape(a)} and {np.shape(b)}; both need the shape (rows, d) with the same d"
        )
    is_short = rows_a.dtype == rows_b.dtype == np.uint8 and rows_a.shape[1] <= ByteRows.LONGEST
    if is_short and len(rows_a) < _MANY and library() is not None:
        return ByteRows(np.asarray(rows_b, np.uint8)).similarity(np.asarray(rows_a, np.uint8))
    # float32 represents every dot product of uint8 rows up to this length exactly, float64 of any length
    of_bytes = rows_a.dtype == rows_b.dtype == np.uint8 and rows_a.shape[1] * 255**2 < 2**24
    kind = np.float32 if of_bytes else np.float64
    x: NDArray[np.floating] = rows_a.astype(kind)
    y: NDArray[np.floating] = rows_b.astype(kind)
    return tanimoto_of_dots((x @ y.T).astype(np.float64), squares(x)[:, None], squares(y))


def tanimoto_of_dots(dots: FloatArray, squares_a: FloatArray, squares_b: FloatArray) -> FloatArray:
    """Return the similarity of vectors with these dot products and squared lengths; 0 if both lengths are 0."""
    union = squares_a + squares_b - dots
    return np.divide(dots, union, out=np.zeros_like(union), where=union > 0)


def squares(rows: NDArray[np.floating]) -> FloatArray:
    """Return the squared length of every row."""
    total: FloatArray = np.einsum("ij,ij->i", rows, rows).astype(np.float64)
    return total
