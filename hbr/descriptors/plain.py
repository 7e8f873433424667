"""CEDD of the whole image: the paper's descriptor."""

from dataclasses import dataclass

from hbr.arrays import FloatArray, ImageArray, LevelArray
from hbr.cedd import BINS, describe
from hbr.packing import PACKED_BYTES, pack, unpack
from hbr.tanimoto import tanimoto


@dataclass(frozen=True)
class Cedd:
    """CEDD to the letter of the reference, compared by Tanimoto."""

    name: str = "cedd"
    version: int = 1
    size_bytes: int = PACKED_BYTES
    length: int = BINS

    def describe(self, image_bgr: ImageArray) -> LevelArray:
        return describe(image_bgr)

    def similarity(self, a: LevelArray, b: LevelArray) -> FloatArray:
        return tanimoto(a, b)

    def pack(self, levels: LevelArray) -> bytes:
        return pack(levels)

    def unpack(self, packed: bytes) -> LevelArray:
        return unpack(packed)
