"""Several descriptors as one."""

from dataclasses import dataclass

import numpy as np

from hbr.arrays import FloatArray, ImageArray, LevelArray
from hbr.descriptors.packing import check_levels
from hbr.descriptors.protocol import Descriptor
from hbr.frontend import Sighting, sight


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

    def describe(self, view: ImageArray | Sighting, /) -> LevelArray:
        seen = view if isinstance(view, Sighting) else sight(view)
        return np.concatenate([part.describe(seen) for part in self.parts])

    def similarity(self, a: LevelArray, b: LevelArray) -> FloatArray:
        check_levels(self, a, b)
        total = np.zeros((len(a), len(b)))
        for part, weight, columns in zip(self.parts, self.weights, self._columns(), strict=True):
            total += weight * part.similarity(a[:, columns], b[:, columns])
        return total

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
