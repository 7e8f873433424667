"""The empty table: how a frame differs from it, in light and by what stands there.

Everything is done on small images and on the logarithm of the grey levels, where a change of exposure, of white balance
or of a lamp's place is a plane added to each channel, and a shadow the same amount taken from all three.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray
from hbr.core.validation import check_frame

Mask = NDArray[np.bool_]
Floats = NDArray[np.float32]

#: Longer side of the images that are compared.
SIDE_PX: Final = 128
#: Every so many-th pixel each way is enough to fit a plane to.
_EVERY: Final = 5
#: Added to grey levels before the logarithm: below it there is more noise than light.
_FLOOR: Final = 6.0
_LOG: Final = np.log(np.arange(256) + _FLOOR).astype(np.float32)
#: How far the logarithm of a grey level is off by noise.
_NOISE: Final = (0.35 * 8.0 / (np.arange(256) + _FLOOR)).astype(np.float32)
#: A logarithm of this much is a fifth more or less light.
_AGREES: Final = 0.15
#: Cells of a 4 x 4 grid at the frame's border; the object stands in the middle.
_BORDER: Final = tuple((y, x) for y in range(4) for x in range(4) if y in (0, 3) or x in (0, 3))
#: A cell agrees when this share of its pixels do.
_CELL_SHARE: Final = 0.6
#: A reference is trusted when this share of the border cells agree.
TRUSTED: Final = 0.65
#: How unlike the border cells of a plain backdrop may be, and how far from grey, in logarithms.
_PLAIN: Final = 0.12
_NEAR_GREY: Final = 0.35
#: The grey that a plain backdrop is brought to, and the farthest that this may brighten or darken a frame.
_BACKDROP_LEVEL: Final = 128.0
_FARTHEST: Final = np.log(1.7)


@dataclass(frozen=True, eq=False)
class Light:
    """How a frame's light differs from what it is brought to.

    Attributes
    ----------
    slopes : float64 array (3, 3)
        Rows: at the frame's middle, rise over its width, rise over its height. Columns: B, G, R. Logarithms of the
        factors that the frame is multiplied by.
    """

    slopes: FloatArray

    @property
    def gains(self) -> tuple[float, float, float]:
        """Factors of B, G, R at the middle of the frame."""
        blue, green, red = np.exp(self.slopes[0]).tolist()
        return blue, green, red

    def over(self, height: int, width: int) -> Floats:
        """Logarithms of the factors for every pixel, (H, W, 3)."""
        x = ((np.arange(width) + 0.5) / width - 0.5)[None, :, None]
        y = ((np.arange(height) + 0.5) / height - 0.5)[:, None, None]
        along, down = (self.slopes[0] + x * self.slopes[1]).astype(np.float32), (y * self.slopes[2]).astype(np.float32)
        planes: Floats = along + down
        return planes


@dataclass(frozen=True, eq=False)
class Difference:
    """What a frame shows that the empty table does not.

    Attributes
    ----------
    agreement : float
        Share of the border's cells that look like the reference under some even light.
    surely : bool array (h, w)
        Another colour, or brighter than the table can be.
    perhaps : bool array (h, w)
        Darker by the same share in all colours: a shadow, or a grey thing.
    light : Light
        That brings the frame to the reference.
    """

    agreement: float
    surely: Mask
    perhaps: Mask
    light: Light

    @property
    def trusted(self) -> bool:
        return self.agreement >= TRUSTED


class Background:
    """The empty table as a photograph shows it, made ready for comparison with many frames.

    Parameters
    ----------
    reference_bgr : uint8 array (H, W, 3)
        The table without any object, from the camera's place of the frames that it is compared with; the light may
        have changed since.

    Raises
    ------
    TypeError, ValueError
        It is no such image.
    """

    def __init__(self, reference_bgr: ImageArray) -> None:
        check_frame(reference_bgr)
        self.shape = reference_bgr.shape[:2]
        self._grey_levels = shrunk(reference_bgr)
        self._log = _logarithm(self._grey_levels)
        self._useful = _useful(self._grey_levels)
        self.light, self.words = self._own_light()

    def difference(self, small: ImageArray) -> Difference:
        """Compare a frame, brought to size by `shrunk`, with the empty table."""
        ratio = _logarithm(small) - self._log
        slopes = _fit(ratio, self._useful & _useful(small))
        residual = cv2.split(ratio - Light(slopes).over(*ratio.shape[:2]))
        evenly = (residual[0] + residual[1] + residual[2]) * np.float32(1 / 3)
        coloured = _largest([cv2.absdiff(part, evenly) for part in residual])
        # a grey level of noise counts for more where there is little light
        noise = cv2.LUT(_smallest(cv2.split(cv2.min(small, self._grey_levels))), _NOISE)
        surely = (coloured > 0.08 + noise) | (evenly > 0.10 + noise) | (evenly < -1.1)
        perhaps = (evenly < -0.12) & ~surely
        # a shadow is smooth; what has a grain that the table has not is a thing
        grain = (np.abs(cv2.Laplacian(evenly, cv2.CV_32F, ksize=3)) > 0.5).astype(np.float32)
        surely |= perhaps & (cv2.blur(grain, (5, 5)) > 0.15)
        agrees = _largest([np.abs(part) for part in residual]) < _AGREES
        shares = np.array([cell.mean() for cell in border_cells(agrees)])
        return Difference(float((shares > _CELL_SHARE).mean()), surely, perhaps & ~surely, Light(-slopes))

    def _own_light(self) -> tuple[Light | None, str]:
        """Light that makes the backdrop grey, if it is plain and nearly so; and why not, or in what part."""
        cells = [
            np.median(cell[ok], axis=0)
            for cell, ok in zip(border_cells(self._log), border_cells(self._useful), strict=True)
            if ok.mean() > 0.5
        ]
        if len(cells) < len(_BORDER) / 2:
            return None, "the backdrop is too dark or overexposed to tell the light's colour"
        colours = np.array(cells)
        opponent = colours - colours.mean(axis=1, keepdims=True)
        middle = np.median(opponent, axis=0)
        if np.quantile(np.abs(opponent - middle).max(axis=1), 0.75) > _PLAIN:
            return None, "the backdrop has several colours; none is sure to be grey"
        if np.abs(middle).max() > _NEAR_GREY:
            return None, "the backdrop is too colourful to be taken for grey"
        exposure = float(np.log(_BACKDROP_LEVEL + _FLOOR) - np.median(colours.mean(axis=1)))
        slopes = np.zeros((3, 3))
        slopes[0] = -middle
        if abs(exposure) > _FARTHEST:
            return Light(slopes), "the backdrop is too dark or too bright to take the exposure from"
        slopes[0] += exposure
        return Light(slopes), ""


def shrunk(image_bgr: ImageArray) -> ImageArray:
    """The image at a size of at most 128 pixels, slightly blurred."""
    scale = SIDE_PX / max(image_bgr.shape[:2])
    if scale < 1:
        size = max(1, round(image_bgr.shape[1] * scale)), max(1, round(image_bgr.shape[0] * scale))
        image_bgr = cv2.resize(image_bgr, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    return cv2.GaussianBlur(image_bgr, (5, 5), 0.8).astype(np.uint8, copy=False)


def border_cells(image: NDArray[np.generic]) -> list[NDArray[np.generic]]:
    """The cells of a 4 x 4 grid that lie at the border."""
    rows, columns = (np.linspace(0, side, 5).astype(int) for side in image.shape[:2])
    return [image[rows[y] : rows[y + 1], columns[x] : columns[x + 1]] for y, x in _BORDER]


def _logarithm(image: ImageArray) -> Floats:
    return cv2.LUT(image, _LOG).astype(np.float32, copy=False)


def _useful(image: ImageArray) -> Mask:
    """Neither black nor overexposed."""
    brightest = _largest(cv2.split(image))
    useful: Mask = (brightest > _FLOOR) & (brightest < 250)
    return useful


def _largest(channels: Sequence[cv2.typing.MatLike]) -> cv2.typing.MatLike:
    # numpy's reduction over a last axis of three is several times slower
    return cv2.max(cv2.max(channels[0], channels[1]), channels[2])


def _smallest(channels: Sequence[cv2.typing.MatLike]) -> cv2.typing.MatLike:
    return cv2.min(cv2.min(channels[0], channels[1]), channels[2])


def _fit(ratio: Floats, useful: Mask) -> FloatArray:
    """The plane that most pixels lie on, for each channel: least squares, again and again without the outliers."""
    height, width = useful.shape
    keep = useful[2::_EVERY, 2::_EVERY]
    rows, columns = np.nonzero(keep)
    if len(rows) < 12:
        return np.zeros((3, 3))
    x, y = (columns * _EVERY + 2.5) / width - 0.5, (rows * _EVERY + 2.5) / height - 0.5
    basis = np.column_stack([np.ones(len(rows)), x, y])
    values = ratio[2::_EVERY, 2::_EVERY][keep].astype(np.float64)
    slopes = np.zeros((3, 3))
    slopes[0] = np.median(values, axis=0)
    quarter = len(values) // 4
    for tolerance in (0.35, 0.2, 0.12, 0.12):
        away = np.abs(values - basis @ slopes).max(axis=1)
        inlier = away <= max(tolerance, float(np.partition(away, quarter)[quarter]))
        gram = basis[inlier].T @ basis[inlier] + 1e-9 * np.eye(3)
        slopes = np.linalg.solve(gram, basis[inlier].T @ values[inlier])
    return slopes
