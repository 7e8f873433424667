"""Distribution of colours over the object, in 32 bytes.

Decision: docs/decisions/0023.
"""

from dataclasses import dataclass
from math import exp
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray, IndexArray, LevelArray
from hbr.descriptors.base import CompiledDescriptor, Shift
from hbr.kernels.calls import Measure
from hbr.segmentation import CROP_PX, Segmentation, segment

_CELLS: Final = 8
_PIXELS: Final = CROP_PX // 2
#: Added to grey levels before the logarithm.
_FLOOR: Final = 12.0
#: Number of coefficients that are stored of brightness, red − green, and blue − yellow.
_KEPT: Final = (12, 10, 10)
#: Share of the object's mean that is subtracted from each: all of the brightness, half of the colours.
_SUBTRACTED: Final = np.array([1.0, 0.5, 0.5])
#: Matrix from B, G, R to the three channels.
_OPPONENT: Final = np.array([[1 / 3, 0.0, 1.0], [1 / 3, -1.0, -0.5], [1 / 3, 1.0, -0.5]])
#: Quantisation steps of the coefficients; level 128 is 0.
_STEP: Final = np.repeat([0.04, 0.03, 0.03], _KEPT)
#: Distance at which the similarity is exp(-1/2).
_WIDTH: Final = 2.5
#: Weights of squared differences of levels: squared distances are whole numbers of 1/10,000.
_WEIGHTS: Final = np.rint(_STEP**2 * 10_000).astype(np.int32)
#: The kernel at squared distances 4096 i, and at i below 4096. Their product is the kernel at the sum of both, the same
#: on every computer.
_NEAR_ENTRIES: Final = 4096
_LARGEST: Final = int(_WEIGHTS.sum()) * 255**2
_FAR: Final = np.array([exp(-i * _NEAR_ENTRIES / (20_000 * _WIDTH**2)) for i in range(_LARGEST // _NEAR_ENTRIES + 1)])
_NEAR: Final = np.array([exp(-i / (20_000 * _WIDTH**2)) for i in range(_NEAR_ENTRIES)])
#: Factor that brings coefficients to the size of a unit vector's entries.
_ENTRY: Final = 0.12
#: Cells of which the object covers less are left out.
_MIN_COVERED: Final = 0.1


def _zigzag(kept: int) -> tuple[list[int], list[int]]:
    order = sorted(
        ((i, j) for i in range(_CELLS) for j in range(_CELLS)),
        key=lambda at: (sum(at), at[1] if sum(at) % 2 else at[0]),
    )
    return [i for i, _ in order[:kept]], [j for _, j in order[:kept]]


_ZIGZAG: Final = [_zigzag(kept) for kept in _KEPT]


@dataclass(frozen=True)
class Colours(CompiledDescriptor):
    """Low-frequency cosine coefficients of brightness and two opponent colours, compared by a Gaussian kernel.

    After the colour layout of MPEG-7 (ISO/IEC 15938-3): the mean colours of 8 x 8 cells and the first coefficients of
    their cosine transform. Two differences: the colours are logarithms, in which another colour or strength of the
    light only adds a constant, and half of the object's mean colour is subtracted. That is a compromise between a known
    and an unknown colour of the light.
    """

    name: str = "colours"
    version: int = 1
    size_bytes: int = sum(_KEPT)
    length: int = sum(_KEPT)

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        found = view if isinstance(view, Segmentation) else segment(view)
        steps = np.rint(_coefficients(found.crop, found.mask) / _STEP)
        levels: FloatArray = np.clip(steps + 128, 0, 255)
        return levels.astype(np.uint8)

    def entries(self, rows: LevelArray) -> FloatArray:
        values: FloatArray = (rows.astype(np.float64) - 128) * (_ENTRY * _STEP)
        return values

    def shifted(self, levels: LevelArray, shift: Shift) -> LevelArray:
        rng = np.random.default_rng(shift.seed)
        coefficients = np.split((levels.astype(np.float64) - 128) * _STEP, np.cumsum(_KEPT)[:-1])
        planes = np.zeros((len(_KEPT), _CELLS, _CELLS), np.float32)
        for plane, part, kept in zip(planes, coefficients, _ZIGZAG, strict=True):
            plane[kept] = part
        planes = shift.moved(np.stack([cv2.idct(plane) for plane in planes]))
        planes[0] *= shift.contrast
        planes[1:] += (1 - _SUBTRACTED[1:, None, None]) * shift.light[:, None, None]
        stains = rng.normal(0, shift.stain, (len(_KEPT), 4, 4)).astype(np.float32)
        planes += np.stack([cv2.resize(stain, (_CELLS, _CELLS), interpolation=cv2.INTER_LINEAR) for stain in stains])
        planes *= shift.visible
        found = np.concatenate(
            [cv2.dct(np.ascontiguousarray(p))[kept] for p, kept in zip(planes, _ZIGZAG, strict=True)]
        )
        changed: FloatArray = np.clip(np.rint(found / _STEP) + 128, 0, 255)
        return changed.astype(np.uint8)

    def compared(self, rows: LevelArray, /) -> "_Kernel":
        return _Kernel(rows.astype(np.float64))

    def measure(self) -> Measure:
        return Measure(colours_at=0, colour_weights=_WEIGHTS, far=_FAR, near=_NEAR)


class _Kernel:
    def __init__(self, rows: FloatArray) -> None:
        self._rows = rows
        self._squares = _squares(rows)

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        own = queries.astype(np.float64)
        return _kernel(_squares(own)[:, None] + self._squares - 2 * (own * _WEIGHTS) @ self._rows.T)

    def only(self, rows: IndexArray, /) -> "_Kernel":
        return _Kernel(self._rows[rows])

    def among(self, rows: IndexArray, /) -> FloatArray:
        part, squares = self._rows[rows], self._squares[rows]
        dots = (part * _WEIGHTS) @ part.transpose(0, 2, 1)
        return _kernel(squares[:, :, None] + squares[:, None, :] - 2 * dots)


def _squares(rows: FloatArray) -> FloatArray:
    squares: FloatArray = (rows * rows) @ _WEIGHTS.astype(np.float64)
    return squares


def _kernel(squares: FloatArray) -> FloatArray:
    """Return the kernel at these squared distances, whole numbers of 1/10,000."""
    far, near = np.divmod(squares.astype(np.intp), _NEAR_ENTRIES)
    similar: FloatArray = _FAR[far] * _NEAR[near]
    return similar


def _coefficients(crop: ImageArray, mask: NDArray[np.uint8]) -> FloatArray:
    # in two steps, because OpenCV averages fast when it halves the size
    half = cv2.resize(crop, (_PIXELS, _PIXELS), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    weight = cv2.resize(mask, (_PIXELS, _PIXELS), interpolation=cv2.INTER_AREA).astype(np.float32) * np.float32(1 / 255)
    totals, covered = _means(half * weight[:, :, None]), _means(weight)
    share = np.where(covered > _MIN_COVERED, covered, 0.0)
    colour = totals / np.maximum(covered, 1e-3)[:, :, None]
    channels = np.log(colour + _FLOOR) @ _OPPONENT
    whole = share.sum()
    if whole > 0:
        channels -= _SUBTRACTED * (channels * share[:, :, None]).sum(axis=(0, 1)) / whole
    channels *= share[:, :, None]
    return np.concatenate(
        [cv2.dct(np.ascontiguousarray(channels[:, :, c]))[kept] for c, kept in enumerate(_ZIGZAG)], dtype=np.float64
    )


def _means(image: NDArray[np.floating]) -> FloatArray:
    size = _PIXELS // _CELLS
    cells = image.reshape(_CELLS, size, _CELLS, size, *image.shape[2:])
    means: FloatArray = cells.mean(axis=(1, 3), dtype=np.float64)
    return means
