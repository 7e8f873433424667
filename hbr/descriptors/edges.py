"""Edge directions over the object: a coarse histogram of oriented gradients in 128 bytes."""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray, LevelArray
from hbr.descriptors.cosine import Cosine
from hbr.descriptors.levels import check_levels, pack_quarters, unpack_quarters
from hbr.segmentation import CROP_PX, Segmentation, segment

_CELLS: Final = 8
_DIRECTIONS: Final = 8
_PIXELS: Final = CROP_PX // 2
#: Blur before the gradient, in pixels of the small image.
_BLUR: Final = 1.25
#: No single direction of a cell has more than this share of the whole length.
_CLIP: Final = 0.25
#: What the four levels stand for: the roots of a normalised histogram's entries, by Lloyd's method.
_REPRESENTATIVES: Final = np.array([0.0114, 0.1062, 0.2173, 0.3713])
_TABLE: Final = np.pad(_REPRESENTATIVES, (0, 252)).astype(np.float32)
_BORDERS: Final = ((_REPRESENTATIVES[1:] + _REPRESENTATIVES[:-1]) / 2).astype(np.float32)


def _shares() -> NDArray[np.float32]:
    """Shares of every row of pixels in the rows of cells, by linear interpolation between their middles, (8, 80)."""
    place = (np.arange(_PIXELS) + 0.5) * _CELLS / _PIXELS - 0.5
    shares: FloatArray = np.clip(1 - np.abs(place - np.arange(_CELLS)[:, None]), 0, 1)
    return shares.astype(np.float32)


_SHARES: Final = _shares()


@dataclass(frozen=True)
class Edges:
    """Histograms of edge direction in 8 x 8 cells around the object, 8 directions without sign, by cosine.

    After N. Dalal and B. Triggs, "Histograms of Oriented Gradients for Human Detection", CVPR 2005, with one
    normalisation for the whole object, the square root of the entries (Hellinger's kernel), and two bits for each. Grey
    levels enter by their square root and are normalised: exposure and gamma hardly matter.
    """

    name: str = "edges"
    version: int = 1
    size_bytes: int = _CELLS * _CELLS * _DIRECTIONS // 4
    length: int = _CELLS * _CELLS * _DIRECTIONS

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        image = (view if isinstance(view, Segmentation) else segment(view)).alone
        return np.searchsorted(_BORDERS, _histogram(image)).astype(np.uint8)

    def prepared(self, rows: LevelArray, /) -> Cosine:
        check_levels(self, rows)
        return Cosine(_unit(rows), _unit)

    def similarity(self, a: LevelArray, b: LevelArray) -> FloatArray:
        check_levels(self, a)
        return self.prepared(b).similarity(a)

    def pack(self, levels: LevelArray) -> bytes:
        check_levels(self, levels)
        return pack_quarters(levels)

    def unpack(self, packed: bytes) -> LevelArray:
        if len(packed) != self.size_bytes:
            raise ValueError(f"{len(packed)} bytes; {self.name} has {self.size_bytes}, check how it was stored")
        return unpack_quarters(packed)


def _histogram(image: ImageArray) -> NDArray[np.float32]:
    small = cv2.resize(image, (_PIXELS, _PIXELS), interpolation=cv2.INTER_AREA)
    levels = cv2.GaussianBlur(np.sqrt(small, dtype=np.float32), (0, 0), _BLUR)
    x, y = cv2.Sobel(levels, cv2.CV_32F, 1, 0), cv2.Sobel(levels, cv2.CV_32F, 0, 1)
    strength = x * x + y * y
    # the channel with the strongest edge, at every pixel
    channel = strength.argmax(axis=2)[:, :, None]
    x, y = (np.take_along_axis(part, channel, axis=2)[:, :, 0] for part in (x, y))
    magnitude, angle = cv2.cartToPolar(x, y)
    place = angle * np.float32(_DIRECTIONS / np.pi)
    away = np.abs(place - np.arange(2 * _DIRECTIONS + 1, dtype=np.float32)[:, None, None])
    votes = np.maximum(1 - away, 0, out=away)
    votes = votes[:_DIRECTIONS] + votes[_DIRECTIONS : 2 * _DIRECTIONS]
    votes[0] += np.maximum(place - (2 * _DIRECTIONS - 1), 0)
    votes *= magnitude
    cells = _SHARES @ votes @ _SHARES.T
    length = float(np.sqrt((cells * cells).sum()))
    if length == 0:
        return np.zeros(cells.size, np.float32)
    clipped = np.minimum(cells / length, _CLIP)
    clipped /= np.sqrt((clipped * clipped).sum())
    roots: NDArray[np.float32] = np.sqrt(clipped).ravel()
    return roots


def _unit(levels: LevelArray) -> NDArray[np.float32]:
    # of a large catalog several times as fast as numpy's indexing
    rows = cv2.LUT(np.ascontiguousarray(levels), _TABLE).astype(np.float32, copy=False).reshape(levels.shape)
    rows /= np.sqrt(np.einsum("ij,ij->i", rows, rows, dtype=np.float64))[:, None]
    return rows
