"""CEDD, the paper's descriptor: of the image as it is, or blurred."""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray, IndexArray, LevelArray
from hbr.descriptors.base import Descriptor
from hbr.descriptors.cedd import BINS, cedd, covered, describe
from hbr.descriptors.cedd_packing import PACKED_BYTES, pack, pack_rows, unpack_rows
from hbr.descriptors.tanimoto import squares, tanimoto, tanimoto_of_dots
from hbr.segmentation import Segmentation

#: Blocks of CEDD's grid along each side of an image.
_BLOCKS: Final = 40


@dataclass(frozen=True)
class Cedd(Descriptor):
    """CEDD of the whole image, compared by Tanimoto.

    Attributes
    ----------
    blur : float
        Standard deviation of a Gaussian blur, in blocks of the grid; 0 is the paper's CEDD. Noise looks like an edge
        in blocks that are as small as its grain. A blur of about one block removes the noise and leaves the edges.
    """

    name: str = "cedd"
    version: int = 1
    size_bytes: int = PACKED_BYTES
    length: int = BINS
    max_level: int = 7
    whole_image: bool = True
    blur: float = 0.0

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        image = view.alone if isinstance(view, Segmentation) else view
        if not self.blur:
            return describe(image)
        image = covered(image)
        sigma = [self.blur * side / _BLOCKS for side in image.shape[:2]]
        blurred = cv2.GaussianBlur(image, (0, 0), sigma[1], sigmaY=sigma[0], borderType=cv2.BORDER_REPLICATE)
        return cedd(blurred.astype(np.uint8, copy=False))

    def prepared(self, rows: LevelArray, /) -> "_Tanimoto":
        self.check_rows(rows)
        return _Tanimoto(rows.astype(np.float32))  # float32 represents products of levels 0..7 exactly

    def similarity(self, a: LevelArray, b: LevelArray) -> FloatArray:
        return tanimoto(a, b)

    def pack(self, levels: LevelArray) -> bytes:
        return pack(levels)

    def pack_rows(self, rows: LevelArray) -> LevelArray:
        self.check_levels(rows)
        return pack_rows(rows)

    def unpack_rows(self, packed: bytes) -> LevelArray:
        return unpack_rows(packed)


class _Tanimoto:
    def __init__(self, rows: NDArray[np.float32]) -> None:
        self._rows = rows
        self._squares = squares(rows)

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        own = queries.astype(np.float32)
        return tanimoto_of_dots((own @ self._rows.T).astype(np.float64), squares(own)[:, None], self._squares)

    def only(self, rows: IndexArray, /) -> "_Tanimoto":
        return _Tanimoto(self._rows[rows])

    def among(self, rows: IndexArray, /) -> FloatArray:
        part, lengths = self._rows[rows], self._squares[rows]
        dots = (part @ part.transpose(0, 2, 1)).astype(np.float64)
        return tanimoto_of_dots(dots, lengths[:, :, None], lengths[:, None, :])
