"""Similarities of descriptors: the Tanimoto coefficient, and the cosine of the angle between them.

Source of the coefficient: Eq. 1 of Czúni and Rashad, Sensors 2018, 18(3), 801.
"""

from collections.abc import Callable
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.kernels import library
from hbr.kernels.calls import ByteRows

#: From this number of rows on, a matrix product is as fast as the compiled kernel.
MANY: Final = 8
#: Rows that are converted to float at once for a matrix product.
_ROWS_AT_ONCE: Final = 8192

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
    if is_short and len(rows_a) < MANY and library() is not None:
        return ByteRows(np.asarray(rows_b, np.uint8)).similarity(np.asarray(rows_a, np.uint8))
    # float32 represents every dot product of uint8 rows up to this length exactly, float64 of any length
    of_bytes = rows_a.dtype == rows_b.dtype == np.uint8 and rows_a.shape[1] * 255**2 < 2**24
    kind = np.float32 if of_bytes else np.float64
    x: NDArray[np.floating] = rows_a.astype(kind)
    similar = np.empty((len(x), len(rows_b)))
    for start in range(0, len(rows_b), _ROWS_AT_ONCE):  # floats need several times the memory of levels
        part = slice(start, start + _ROWS_AT_ONCE)
        y: NDArray[np.floating] = rows_b[part].astype(kind)
        similar[:, part] = tanimoto_of_dots((x @ y.T).astype(np.float64), squares(x)[:, None], squares(y))
    return similar


def tanimoto_of_dots(dots: FloatArray, squares_a: FloatArray, squares_b: FloatArray) -> FloatArray:
    """Return the similarity of vectors with these dot products and squared lengths; 0 if both lengths are 0."""
    union = squares_a + squares_b - dots
    return np.divide(dots, union, out=np.zeros_like(union), where=union > 0)


def squares(rows: NDArray[np.floating]) -> FloatArray:
    """Return the squared length of every row."""
    total: FloatArray = np.einsum("ij,ij->i", rows, rows).astype(np.float64)
    return total


Rows = NDArray[np.float32]

#: Products are added up in blocks of this many columns.
_BLOCK: Final = 64
#: Rows that are converted to float at once.
_CHUNK: Final = 256
#: Cosines that are computed at once, so that they stay in the processor's cache between blocks.
_AT_ONCE: Final = 65536


class RootCosine:
    """A `Comparison` of rows of unit length by the square root of the cosine, to 1e-6; 0 if that is negative.

    With the root, also views count whose cosine is small on another bench.

    A matrix product adds up float32 in one accumulator for each result. Levels take few values, so that equal products
    are rounded in the same direction many times: over 512 columns the error is up to 5e-6. Therefore the rows are
    stored in blocks of columns, float32 (blocks, n, 64), whose products are added up separately.
    """

    def __init__(self, to_unit: Callable[[LevelArray], Rows], blocks: Rows) -> None:
        self._to_unit, self._blocks = to_unit, blocks

    @classmethod
    def of(cls, rows: LevelArray, to_unit: Callable[[LevelArray], Rows]) -> "RootCosine":
        """Prepare rows of levels, uint8 (n, length)."""
        return cls(to_unit, _blocks(rows, to_unit))

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        own = _blocks(queries, self._to_unit)
        count = self._blocks.shape[1]
        cosine = np.empty((len(queries), count))
        step = max(_BLOCK, _AT_ONCE // max(1, len(queries)))
        for start in range(0, count, step):
            part = slice(start, start + step)
            total = own[0] @ self._blocks[0, part].T
            for query, rows in zip(own[1:], self._blocks[1:, part], strict=True):
                total += query @ rows.T
            np.clip(total, 0, 1, out=cosine[:, part])
        return np.sqrt(cosine)

    def among(self, rows: IndexArray, /) -> FloatArray:
        part = np.take(self._blocks, rows, axis=1)
        products = part @ part.transpose(0, 1, 3, 2)
        total = products[0]
        for product in products[1:]:  # in this order: a sum over an axis may add up in another one
            total += product
        similar: FloatArray = np.sqrt(np.clip(total, 0, 1, dtype=np.float64))
        return similar


#: Number of ones in each byte.
_ONES: Final = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(axis=1, dtype=np.uint8)
#: Packed rows that are compared at once.
_PACKED_AT_ONCE: Final = 2048


class BitCosine:
    """A `Comparison` of rows of bits by the cosine, exact up to the division: the same on every computer.

    Parameters
    ----------
    packed : uint8 array (n, bytes)
        The bits, as `numpy.packbits` packs them. They stay packed.
    """

    def __init__(self, packed: LevelArray) -> None:
        self._packed, self._ones = packed, _common(packed, np.full((1, packed.shape[1]), 255, np.uint8))[0]

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        own = np.packbits(queries, axis=1)
        return _cosine(_common(self._packed, own), _common(own, own).diagonal()[:, None], self._ones)

    def among(self, rows: IndexArray, /) -> FloatArray:
        bits = np.unpackbits(self._packed[rows], axis=2).astype(np.float32)
        ones = self._ones[rows]
        return _cosine((bits @ bits.transpose(0, 2, 1)).astype(np.float64), ones[:, :, None], ones[:, None, :])


def _common(packed: LevelArray, queries: LevelArray) -> FloatArray:
    """Return the number of ones that packed queries, (n, bytes), and rows, (m, bytes), have in common, (n, m)."""
    common = np.empty((len(queries), len(packed)))
    for start in range(0, len(packed), _PACKED_AT_ONCE):
        rows = packed[start : start + _PACKED_AT_ONCE]
        for query, found in zip(queries, common[:, start : start + len(rows)], strict=True):
            found[:] = cv2.reduce(cv2.LUT(rows & query, _ONES), 1, cv2.REDUCE_SUM, dtype=cv2.CV_32S)[:, 0]
    return common


def _cosine(common: FloatArray, ones_a: FloatArray, ones_b: FloatArray) -> FloatArray:
    length = np.sqrt(ones_a * ones_b)
    return np.divide(common, length, out=np.zeros_like(common), where=length > 0)


def _blocks(rows: LevelArray, to_unit: Callable[[LevelArray], Rows]) -> Rows:
    """Return converted rows in blocks of columns; the last block is filled with zeros."""
    length = rows.shape[1]
    blocks = np.zeros((-(-length // _BLOCK), len(rows), _BLOCK), np.float32)
    for start in range(0, len(rows), _CHUNK):
        unit = to_unit(rows[start : start + _CHUNK])
        for block, column in zip(blocks, range(0, length, _BLOCK), strict=True):
            part = unit[:, column : column + _BLOCK]
            block[start : start + _CHUNK, : part.shape[1]] = part
    return blocks
