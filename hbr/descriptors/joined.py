"""Several descriptors as one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hbr.core.arrays import FloatArray, ImageArray, IndexArray, LevelArray
from hbr.descriptors.base import Comparison, Descriptor
from hbr.descriptors.levels import check_levels
from hbr.segmentation import Segmentation, segment


@dataclass(frozen=True)
class Joined:
    """Descriptors side by side, their similarities averaged with weights that add up to 1."""

    name: str
    version: int
    parts: tuple[Descriptor, ...]
    weights: tuple[float, ...]

    @property
    def size_bytes(self) -> int:
        return sum(part.size_bytes for part in self.parts)

    @property
    def length(self) -> int:
        return sum(part.length for part in self.parts)

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        seen = view if isinstance(view, Segmentation) else segment(view)
        return np.concatenate([part.describe(seen) for part in self.parts])

    def prepared(self, rows: LevelArray, /) -> "_Average":
        check_levels(self, rows)
        columns = self._columns()
        parts = [part.prepared(rows[:, own]) for part, own in zip(self.parts, columns, strict=True)]
        return _Average(parts, self.weights, columns)

    def similarity(self, a: LevelArray, b: LevelArray) -> FloatArray:
        check_levels(self, a)
        return self.prepared(b).similarity(a)

    def pack(self, levels: LevelArray) -> bytes:
        check_levels(self, levels)
        return b"".join(part.pack(levels[columns]) for part, columns in zip(self.parts, self._columns(), strict=True))

    def unpack(self, packed: bytes) -> LevelArray:
        if len(packed) != self.size_bytes:
            raise ValueError(f"{len(packed)} bytes; {self.name} has {self.size_bytes}, check how it was stored")
        levels, at = [], 0
        for part in self.parts:
            levels.append(part.unpack(packed[at : at + part.size_bytes]))
            at += part.size_bytes
        return np.concatenate(levels)

    def _columns(self) -> list[slice]:
        ends = np.cumsum([part.length for part in self.parts]).tolist()
        return [slice(end - part.length, end) for end, part in zip(ends, self.parts, strict=True)]


class _Average:
    def __init__(self, parts: Sequence[Comparison], weights: Sequence[float], columns: Sequence[slice]) -> None:
        self._parts, self._weights, self._columns = parts, weights, columns

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        return self._weighted(
            [p.similarity(queries[:, own]) for p, own in zip(self._parts, self._columns, strict=True)]
        )

    def only(self, rows: IndexArray, /) -> "_Average":
        return _Average([part.only(rows) for part in self._parts], self._weights, self._columns)

    def among(self, rows: IndexArray, /) -> FloatArray:
        return self._weighted([part.among(rows) for part in self._parts])

    def _weighted(self, similar: Sequence[FloatArray]) -> FloatArray:
        total = self._weights[0] * similar[0]
        for weight, part in zip(self._weights[1:], similar[1:], strict=True):
            total += weight * part
        return total
