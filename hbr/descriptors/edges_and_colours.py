"""The two descriptors of the object's edges and colours, parts of the rig's own.

- `Edges`: a coarse histogram of oriented gradients, in 64 bytes.
- `Colours`: the distribution of colours, in 32 bytes.

Decision: docs/decisions/0012.
"""

from dataclasses import dataclass
from math import exp
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray, IndexArray, LevelArray
from hbr.descriptors.base import Descriptor
from hbr.descriptors.similarity import BitCosine
from hbr.segmentation import CROP_PX, Segmentation, segment

Floats = NDArray[np.float32]

# On another bench, 4 x 4 cells found 75 %, 6 x 6 cells 84 % and 8 x 8 cells 87 % of the objects (decision 0012).
_CELLS: Final = 8
_DIRECTIONS: Final = 8
_PIXELS: Final = CROP_PX // 2
#: Standard deviation of the blur before the gradient, in pixels of the small image.
_BLUR: Final = 1.25  # larger: less noise and defocus, and fewer thin edges
#: Largest share of the whole length that one direction of a cell may have.
_CLIP: Final = 0.25  # one strong edge, often a highlight or a shadow, must not silence all others
#: Bits are 1 where the square root of the normalised histogram's entry is above this number.
# One bit, because two find fewer objects in noise. Trial with photographs of 40 objects, 8 views enrolled, Gaussian
# noise of variance 0.012: after 1, 2 and 4 views, the right object was first in 80, 92 and 97 % with one bit, and in
# 77, 90 and 94 % with two. After a hard change of the bench, two find 1 to 2 points more (docs/decisions/0012).
_BORDER: Final = np.float32(0.16175)


def _shares() -> NDArray[np.float32]:
    """Return the weight of every row of pixels in every row of cells, by linear interpolation, float32 (8, 80)."""
    place = (np.arange(_PIXELS) + 0.5) * _CELLS / _PIXELS - 0.5
    shares: FloatArray = np.clip(1 - np.abs(place - np.arange(_CELLS)[:, None]), 0, 1)
    return shares.astype(np.float32)


_SHARES: Final = _shares()


@dataclass(frozen=True)
class Edges(Descriptor):
    """Histograms of 8 unsigned edge directions in 8 x 8 cells of the object, compared by cosine.

    After N. Dalal and B. Triggs, "Histograms of Oriented Gradients for Human Detection", CVPR 2005. Three differences:
    one normalisation for the whole object, square roots of the entries (Hellinger's kernel), and one bit for each.
    Gradients are of the square roots of grey levels and are normalised, so that exposure and gamma hardly matter.
    """

    name: str = "edges"
    version: int = 1
    size_bytes: int = _CELLS * _CELLS * _DIRECTIONS // 8
    length: int = _CELLS * _CELLS * _DIRECTIONS
    max_level: int = 1

    def describe(self, view: ImageArray | Segmentation, /) -> LevelArray:
        image = (view if isinstance(view, Segmentation) else segment(view)).alone
        return (_histogram(image) > _BORDER).astype(np.uint8)

    def prepared(self, rows: LevelArray, /) -> BitCosine:
        self.check_rows(rows)
        return BitCosine(self.pack_rows(rows))

    def opened(self, packed: LevelArray, /) -> BitCosine:
        self.check_packed(packed)
        return BitCosine(packed)

    def pack_rows(self, rows: LevelArray) -> LevelArray:
        """Pack eight levels into each byte, the first one in the highest bit."""
        self.check_levels(rows)
        return np.packbits(rows, axis=1)

    def unpack_rows(self, packed: bytes) -> LevelArray:
        return np.unpackbits(self.packed_rows(packed), axis=1)

    def entries(self, rows: LevelArray) -> FloatArray:
        length = np.sqrt(rows.sum(axis=1, dtype=np.float64))[:, None]
        unit: FloatArray = np.divide(rows, length, out=np.zeros(rows.shape), where=length > 0)
        return unit


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


#: Added to grey levels before the logarithm.
_FLOOR: Final = 12.0
#: Number of coefficients that are stored of brightness, red − green, and blue − yellow.
_KEPT: Final = (12, 10, 10)
#: Share of the object's mean that is subtracted from each: all of the brightness, half of the colours.
# none or all of the mean colour: 1 to 4 points fewer are found (decision 0012)
_SUBTRACTED: Final = np.array([1.0, 0.5, 0.5])
#: Matrix from B, G, R to the three channels.
_OPPONENT: Final = np.array([[1 / 3, 0.0, 1.0], [1 / 3, -1.0, -0.5], [1 / 3, 1.0, -0.5]])
#: Quantisation steps of the coefficients; level 128 is 0.
_STEP: Final = np.repeat([0.04, 0.03, 0.03], _KEPT)
#: Distance at which the similarity is exp(-1/2).
_WIDTH: Final = 2.5
#: Weights of squared differences of levels: squared distances are whole numbers of 1/10,000.
_WEIGHTS: Final = np.rint(_STEP**2 * 10_000).astype(np.float32)
#: The kernel at squared distances 4096 i, and at i below 4096. Their product is the kernel at the sum of both, the same
#: on every computer.
_NEAR_ENTRIES: Final = 4096
_LARGEST: Final = int(_WEIGHTS.sum()) * 255**2
_FAR: Final = np.array([exp(-i * _NEAR_ENTRIES / (20_000 * _WIDTH**2)) for i in range(_LARGEST // _NEAR_ENTRIES + 1)])
_NEAR: Final = np.array([exp(-i / (20_000 * _WIDTH**2)) for i in range(_NEAR_ENTRIES)])
#: Factor that brings coefficients to the size of a unit vector's entries.
_ENTRY: Final = 0.12
#: Cells of which the object covers less are left out.
_MIN_COVERED: Final = 0.1  # smaller: the background at the object's edge counts as its colour


def _zigzag(kept: int) -> tuple[list[int], list[int]]:
    order = sorted(
        ((i, j) for i in range(_CELLS) for j in range(_CELLS)),
        key=lambda at: (sum(at), at[1] if sum(at) % 2 else at[0]),
    )
    return [i for i, _ in order[:kept]], [j for _, j in order[:kept]]


_ZIGZAG: Final = [_zigzag(kept) for kept in _KEPT]


@dataclass(frozen=True)
class Colours(Descriptor):
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

    def prepared(self, rows: LevelArray, /) -> "_Kernel":
        self.check_rows(rows)
        return _Kernel(_centred(rows))


class _Kernel:
    """Rows of centred levels: float32 represents their weighted products exactly, and sums of them."""

    def __init__(self, rows: Floats) -> None:
        self._rows = rows
        self._squares = _squares(rows)

    def similarity(self, queries: LevelArray, /) -> FloatArray:
        own = _centred(queries)
        return _kernel(
            _squares(own)[:, None] + self._squares - 2 * ((own * _WEIGHTS) @ self._rows.T).astype(np.float64)
        )

    def among(self, rows: IndexArray, /) -> FloatArray:
        part, squares = self._rows[rows], self._squares[rows]
        dots = ((part * _WEIGHTS) @ part.transpose(0, 2, 1)).astype(np.float64)
        return _kernel(squares[:, :, None] + squares[:, None, :] - 2 * dots)


def _centred(rows: LevelArray) -> Floats:
    return np.subtract(rows, 128, dtype=np.float32)


def _squares(rows: Floats) -> FloatArray:
    squares: FloatArray = np.einsum("ij,ij,j->i", rows, rows, _WEIGHTS).astype(np.float64)
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
