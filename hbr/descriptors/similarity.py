"""Similarities of descriptors: the Tanimoto coefficient, and the cosine of the angle between them.

Source of the coefficient: Eq. 1 of Czúni and Rashad, Sensors 2018, 18(3), 801.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, IndexArray, LevelArray
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


Rows = NDArray[np.float32]

#: Products are added up in blocks of this many columns.
_BLOCK: Final = 64
#: Unit into whose multiples and the rest the values of a query are split: 64 products of 4095 and 63 are below 2**24.
_UNIT: Final = 64.0
#: Rows that are converted to float at once.
_CHUNK: Final = 256
#: Cosines that are computed at once, so that they stay in the processor's cache between blocks.
_AT_ONCE: Final = 65536


class RootCosine:
    """A `Comparison` of rows of unit length by the square root of the cosine, to 1e-6; 0 if that is negative.

    The dense filter raises similarities to the fourth power. The root leaves the second one, so that also views count
    whose cosine is small on another bench.

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

    def only(self, rows: IndexArray, /) -> "RootCosine":
        return RootCosine(self._to_unit, np.take(self._blocks, rows, axis=1))

    def among(self, rows: IndexArray, /) -> FloatArray:
        part = np.take(self._blocks, rows, axis=1)
        products = part @ part.transpose(0, 1, 3, 2)
        total = products[0]
        for product in products[1:]:  # in this order: a sum over an axis may add up in another one
            total += product
        similar: FloatArray = np.sqrt(np.clip(total, 0, 1, dtype=np.float64))
        return similar


class WholeCosine:
    """A `Comparison` of rows of whole numbers, exact up to the division by the lengths: the same on every computer.

    The products are added up in float32, in blocks of columns whose sums are below 2**24. For that, the values of a
    query are split into two parts, of 64 and of 1.
    """

    def __init__(self, values: NDArray[np.int32], blocks: Rows, squares: FloatArray) -> None:
        self._values, self._blocks, self._squares = values, blocks, squares

    @classmethod
    def of(cls, rows: LevelArray, values: NDArray[np.int32]) -> "WholeCosine":
        """Prepare rows of levels, uint8 (n, length)."""
        table = values.astype(np.float32)
        return cls(values, _blocks(rows, table.take), _whole_squares(rows, values))

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        parts = [_blocks(queries, part.take) for part in _split(self._values.astype(np.float32))]
        dots = np.zeros((len(queries), self._blocks.shape[1]))
        for rows, *own in zip(self._blocks, *parts, strict=True):
            for query, unit in zip(own, (_UNIT, 1.0), strict=True):
                dots += unit * (query @ rows.T).astype(np.float64)
        return _cosine(dots, _whole_squares(queries, self._values)[:, None], self._squares)

    def only(self, rows: IndexArray, /) -> "WholeCosine":
        return WholeCosine(self._values, np.take(self._blocks, rows, axis=1), self._squares[rows])

    def among(self, rows: IndexArray, /) -> FloatArray:
        dots = np.zeros((*rows.shape, rows.shape[-1]))
        for block in self._blocks:
            columns = block[rows].transpose(0, 2, 1)
            for query, unit in zip(_split(block[rows]), (_UNIT, 1.0), strict=True):
                dots += unit * (query @ columns).astype(np.float64)
        lengths = self._squares[rows]
        return _cosine(dots, lengths[:, :, None], lengths[:, None, :])


def _split(values: Rows) -> tuple[Rows, Rows]:
    """Return values as multiples of 64, and the rest."""
    high = np.floor(values / np.float32(_UNIT))
    return high, values - np.float32(_UNIT) * high


def _whole_squares(rows: LevelArray, values: NDArray[np.int32]) -> FloatArray:
    squares = np.empty(len(rows))
    table = values.astype(np.float64) ** 2
    for start in range(0, len(rows), _CHUNK):
        squares[start : start + _CHUNK] = table[rows[start : start + _CHUNK]].sum(axis=1)
    return squares


def _cosine(dots: FloatArray, squares_a: FloatArray, squares_b: FloatArray) -> FloatArray:
    similar: FloatArray = np.minimum(dots / np.sqrt(squares_a * squares_b), 1)
    return similar


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
