"""Comparison of descriptors by the cosine of the angle between them."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, IndexArray, LevelArray

Rows = NDArray[np.float32]

#: Products are added up in blocks of this many columns.
_BLOCK: Final = 64
#: Cosines that are computed at once, so that they stay in the processor's cache between blocks.
_AT_ONCE: Final = 16384


class Cosine:
    """A `Comparison` of rows of unit length, float32 (n, length); ``to_unit`` makes such rows of levels."""

    def __init__(self, unit: Rows, to_unit: Callable[[LevelArray], Rows]) -> None:
        self._unit, self._to_unit = unit, to_unit

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        return _cosine(self._to_unit(queries), self._unit)

    def only(self, rows: IndexArray, /) -> "Cosine":
        return Cosine(self._unit[rows], self._to_unit)

    def among(self, rows: IndexArray, /) -> FloatArray:
        part = self._unit[rows]
        return _positive(part @ part.transpose(0, 2, 1))


def _cosine(a: Rows, b: Rows) -> FloatArray:
    """Return the cosines of rows of unit length to 1e-6, float64 (n, m); 0 for obtuse angles.

    Matrix products add up float32 in one accumulator for each result. Levels take few values, so that the same product
    is rounded in the same direction many times: over 512 columns the error is up to 5e-6. Blocks of columns, each with
    an accumulator of its own, keep it below 1e-6. The product with one vector uses several accumulators anyway.
    """
    if len(a) == 1:
        return _positive(a @ b.T)
    cosine = np.empty((len(a), len(b)))
    blocks = [slice(start, start + _BLOCK) for start in range(0, a.shape[1], _BLOCK)]
    queries = [np.ascontiguousarray(a[:, columns]) for columns in blocks]
    step = max(_BLOCK, _AT_ONCE // max(1, len(a)))
    for start in range(0, len(b), step):
        rows = b[start : start + step]
        total = queries[0] @ rows[:, blocks[0]].T
        for query, columns in zip(queries[1:], blocks[1:], strict=True):
            total += query @ rows[:, columns].T
        np.clip(total, 0, 1, out=cosine[:, start : start + step])
    return cosine


def _positive(cosine: Rows) -> FloatArray:
    similar: FloatArray = np.clip(cosine, 0, 1, dtype=np.float64)
    return similar
