"""Comparison of descriptors by the cosine of the angle between them."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, IndexArray, LevelArray


class Cosine:
    """A `Comparison` of rows of unit length, float32 (n, length); ``to_unit`` makes such rows of levels."""

    def __init__(self, unit: NDArray[np.float32], to_unit: Callable[[LevelArray], NDArray[np.float32]]) -> None:
        self._unit, self._to_unit = unit, to_unit

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        return _positive(self._to_unit(queries) @ self._unit.T)

    def only(self, rows: IndexArray, /) -> "Cosine":
        return Cosine(self._unit[rows], self._to_unit)

    def among(self, rows: IndexArray, /) -> FloatArray:
        part = self._unit[rows]
        return _positive(part @ part.transpose(0, 2, 1))


def _positive(cosine: NDArray[np.float32]) -> FloatArray:
    similar: FloatArray = np.clip(cosine, 0, 1, dtype=np.float64)
    return similar
