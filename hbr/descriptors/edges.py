"""Edge directions over the object: a coarse histogram of oriented gradients, in 128 bytes.

Decision: docs/decisions/0023.
"""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray, LevelArray
from hbr.descriptors.base import CompiledDescriptor, Shift
from hbr.descriptors.cosine import WholeCosine
from hbr.kernels.calls import Measure
from hbr.segmentation import CROP_PX, Segmentation, segment

Floats = NDArray[np.float32]

_CELLS: Final = 8
_DIRECTIONS: Final = 8
_PIXELS: Final = CROP_PX // 2
#: Standard deviation of the blur before the gradient, in pixels of the small image.
_BLUR: Final = 1.25
#: Largest share of the whole length that one direction of a cell may have.
_CLIP: Final = 0.25
#: Values of the four levels in 1/10,000: square roots of a normalised histogram's entries, quantised by Lloyd's method.
_VALUES: Final = np.array([114, 1062, 2173, 3713], np.int32)
_REPRESENTATIVES: Final = _VALUES / 10_000
_BORDERS: Final = ((_REPRESENTATIVES[1:] + _REPRESENTATIVES[:-1]) / 2).astype(np.float32)


def _shares() -> NDArray[np.float32]:
    """Return the weight of every row of pixels in every row of cells, by linear interpolation, float32 (8, 80)."""
    place = (np.arange(_PIXELS) + 0.5) * _CELLS / _PIXELS - 0.5
    shares: FloatArray = np.clip(1 - np.abs(place - np.arange(_CELLS)[:, None]), 0, 1)
    return shares.astype(np.float32)


_SHARES: Final = _shares()


@dataclass(frozen=True)
class Edges(CompiledDescriptor):
    """Histograms of 8 unsigned edge directions in 8 x 8 cells of the object, compared by cosine.

    After N. Dalal and B. Triggs, "Histograms of Oriented Gradients for Human Detection", CVPR 2005. Three differences:
    one normalisation for the whole object, square roots of the entries (Hellinger's kernel), and two bits for each.
    Gradients are of the square roots of grey levels and are normalised, so that exposure and gamma hardly matter.
    """

    name: str = "edges"
    version: int = 1
    size_bytes: int = _CELLS * _CELLS * _DIRECTIONS // 4
    length: int = _CELLS * _CELLS * _DIRECTIONS
    max_level: int = 3

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        image = (view if isinstance(view, Segmentation) else segment(view)).alone
        return np.searchsorted(_BORDERS, _histogram(image)).astype(np.uint8)

    def compared(self, rows: LevelArray, /) -> WholeCosine:
        return WholeCosine.of(rows, _VALUES)

    def measure(self) -> Measure:
        return Measure(edges_at=0, edge_values=_VALUES)

    def pack_rows(self, rows: LevelArray) -> LevelArray:
        """Pack four levels into each byte, the first one in the highest bits."""
        self.check_levels(rows)
        parts = np.ascontiguousarray(rows).reshape(len(rows), self.size_bytes, 4)
        packed = parts[:, :, 0] << 6 | parts[:, :, 1] << 4 | parts[:, :, 2] << 2 | parts[:, :, 3]
        return packed.astype(np.uint8, copy=False)

    def entries(self, rows: LevelArray) -> FloatArray:
        values = _REPRESENTATIVES[rows]
        length = np.sqrt(np.einsum("ij,ij->i", values, values))[:, None]
        unit: FloatArray = values / length
        return unit

    def shifted(self, levels: LevelArray, shift: Shift) -> LevelArray:
        rng = np.random.default_rng(shift.seed)
        roots = _REPRESENTATIVES[levels].astype(np.float32)
        cells = shift.moved((roots * roots).reshape(_DIRECTIONS, _CELLS, _CELLS)) * shift.visible
        hidden = 1 - shift.visible
        mean = float(cells.mean())
        upright = np.zeros((_DIRECTIONS, 1, 1), np.float32)
        upright[[0, -1]] = 0.5  # the gradients of a vertical bar are horizontal
        cells += 3 * mean * hidden * (upright + 0.1)
        false = rng.exponential(1.0, cells.shape) * (rng.random((1, _CELLS, _CELLS)) < 0.3)
        cells = np.maximum(cells, 0) ** shift.exponent
        cells += (2 * shift.false * float(cells.mean()) * false).astype(np.float32)
        return np.searchsorted(_BORDERS, _normalised(cells)).astype(np.uint8)

    def unpack_rows(self, packed: bytes) -> LevelArray:
        rows = self.packed_rows(packed)
        return np.stack([rows >> 6, rows >> 4 & 3, rows >> 2 & 3, rows & 3], axis=2).reshape(-1, self.length)


def _histogram(image: ImageArray) -> NDArray[np.float32]:
    small = cv2.resize(image, (_PIXELS, _PIXELS), interpolation=cv2.INTER_AREA)
    levels = cv2.GaussianBlur(np.sqrt(small, dtype=np.float32), (0, 0), _BLUR)
    x, y = cv2.Sobel(levels, cv2.CV_32F, 1, 0), cv2.Sobel(levels, cv2.CV_32F, 0, 1)
    magnitude, angle = cv2.cartToPolar(*_strongest(x, y))
    votes = _votes(magnitude, angle)
    return _normalised((_SHARES @ votes @ _SHARES.T).astype(np.float32, copy=False))


def _strongest(x: cv2.typing.MatLike, y: cv2.typing.MatLike) -> tuple[Floats, Floats]:
    """Return at every pixel the gradient of the channel with the strongest edge."""
    strength = x * x + y * y
    channel = strength.argmax(axis=2)[:, :, None]
    own = [np.take_along_axis(part, channel, axis=2)[:, :, 0] for part in (x, y)]
    return own[0].astype(np.float32, copy=False), own[1].astype(np.float32, copy=False)


def _votes(magnitude: cv2.typing.MatLike, angle: cv2.typing.MatLike) -> Floats:
    """Return the votes of the pixels for the eight directions, float32 (8, h, w)."""
    scale = np.float32(_DIRECTIONS / np.pi)
    place = angle * scale
    away = np.abs(place - np.arange(2 * _DIRECTIONS + 1, dtype=np.float32)[:, None, None])
    votes = np.maximum(1 - away, 0, out=away)
    votes = votes[:_DIRECTIONS] + votes[_DIRECTIONS : 2 * _DIRECTIONS]
    votes[0] += np.maximum(place - (2 * _DIRECTIONS - 1), 0)
    votes *= magnitude
    shared: Floats = votes
    return shared


def _normalised(cells: NDArray[np.float32]) -> NDArray[np.float32]:
    length = float(np.sqrt((cells * cells).sum()))
    if length == 0:
        return np.zeros(cells.size, np.float32)
    clipped = np.minimum(cells / length, _CLIP)
    clipped /= np.sqrt((clipped * clipped).sum())
    roots: NDArray[np.float32] = np.sqrt(clipped).ravel()
    return roots
