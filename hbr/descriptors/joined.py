"""Several descriptors as one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hbr.core.arrays import FloatArray, ImageArray, IndexArray, LevelArray
from hbr.descriptors.base import Comparison, CompiledDescriptor, Descriptor
from hbr.descriptors.shift import Shift
from hbr.kernels.calls import Measure
from hbr.segmentation import Segmentation, segment


@dataclass(frozen=True)
class Joined(CompiledDescriptor):
    """Descriptors side by side. The similarity is the mean of theirs, with weights that add up to 1."""

    name: str = ""
    version: int = 1
    parts: tuple[Descriptor, ...] = ()
    weights: tuple[float, ...] = ()

    @property
    def size_bytes(self) -> int:
        return sum(part.size_bytes for part in self.parts)

    @property
    def length(self) -> int:
        return sum(part.length for part in self.parts)

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        found = view if isinstance(view, Segmentation) else segment(view)
        return np.concatenate([part.describe(found) for part in self.parts])

    def compared(self, rows: LevelArray, /) -> "_Average":
        columns = self._columns()
        parts = [part.prepared(rows[:, own]) for part, own in zip(self.parts, columns, strict=True)]
        return _Average(parts, self.weights, columns)

    def measure(self) -> Measure | None:
        """Return how edges and colours, in this order, are compared; other pairs are left to NumPy."""
        measures = [part.measure() if isinstance(part, CompiledDescriptor) else None for part in self.parts]
        edges, colours = measures if len(measures) == 2 else (None, None)
        if edges is None or colours is None or edges.edges_at or colours.colours_at:
            return None
        edges_share, colours_share = self.weights
        return colours._replace(
            edges_at=0,
            colours_at=self.parts[0].size_bytes,
            edge_values=edges.edge_values,
            edges_share=edges_share,
            colours_share=colours_share,
        )

    def entries(self, rows: LevelArray) -> FloatArray:
        return np.concatenate(
            [part.entries(rows[:, own]) for part, own in zip(self.parts, self._columns(), strict=True)], axis=1
        )

    def shifted(self, levels: LevelArray, shift: Shift) -> LevelArray:
        parts = zip(self.parts, self._columns(), strict=True)
        return np.concatenate([part.shifted(levels[own], shift) for part, own in parts])

    def pack_rows(self, rows: LevelArray) -> LevelArray:
        columns = zip(self.parts, self._columns(), strict=True)
        return np.concatenate([part.pack_rows(rows[:, own]) for part, own in columns], axis=1)

    def unpack_rows(self, packed: bytes) -> LevelArray:
        rows = self.packed_rows(packed)
        columns = zip(self.parts, _slices([part.size_bytes for part in self.parts]), strict=True)
        return np.concatenate([part.unpack_rows(rows[:, own].tobytes()) for part, own in columns], axis=1)

    def check_levels(self, rows: LevelArray) -> None:
        for part, columns in zip(self.parts, self._columns(), strict=True):
            part.check_levels(rows[:, columns])

    def _columns(self) -> list[slice]:
        return _slices([part.length for part in self.parts])


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


def _slices(lengths: list[int]) -> list[slice]:
    ends = np.cumsum(lengths).tolist()
    return [slice(end - length, end) for end, length in zip(ends, lengths, strict=True)]
