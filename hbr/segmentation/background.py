"""A frame, its backgrounds, and the difference between them.

`Background` compares with the empty-table image, or with a background that was learned. The comparison uses small
images and the logarithm of the grey levels. There a change of exposure, of white balance or of a lamp's position adds a
plane to each channel, and a shadow subtracts the same amount from all three channels. `plain_difference` needs no
image: the background is plain.

Decision: docs/decisions/0012.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property, lru_cache
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray, LevelArray, check_frame
from hbr.kernels import calls

Mask = NDArray[np.bool_]
Floats = NDArray[np.float32]

#: Longer side of the images that are compared.
SIDE_PX: Final = 128  # larger: thinner objects are seen, and the time of each frame grows with the square
#: Smallest share of the frame that an object takes.
LEAST: Final = 0.004
#: Step between the pixels that a plane is fitted to.
_EVERY: Final = 5  # a plane has three parameters: a pixel in 25 is enough, and 25 times as fast
#: Number that is added to grey levels before the logarithm, because noise dominates below it.
_FLOOR: Final = 6.0
_LOG: Final = np.log(np.arange(256) + _FLOOR).astype(np.float32)
#: Steps of logarithms as whole numbers, whose differences take a tenth of the time.
_STEPS: Final = 250.0
_LOG_STEPS: Final = np.rint(_STEPS * _LOG).astype(np.int16)
#: The difference of pixels that differ by 0 to 255 steps, from about -0.7 to 1 and fine where it is small; how equal
#: they are.
_FAR: Final = np.minimum(np.log((np.arange(256) / _STEPS + 0.01) / 0.06) / 2.5, 1).astype(np.float32)
_EQUAL: Final = (1 / (1 + (np.arange(256) / _STEPS / 0.07) ** 4)).astype(np.float32)
#: Noise of the logarithm of each grey level.
_NOISE: Final = (0.35 * 8.0 / (np.arange(256) + _FLOOR)).astype(np.float32)
#: Small regularisation that makes the least squares solvable.
_RIDGE: Final = 1e-9 * np.eye(3)
#: Largest residual of a pixel that agrees, in logarithms: about 15 % more or less light.
_AGREES: Final = 0.15  # larger: another bench passes as this one; smaller: a lamp that moved makes the image useless
#: Half of the mean of three channels, and the difference of each from it.
_OPPONENTS: Final = np.vstack([np.full((1, 3), 1 / 6), np.eye(3) - 1 / 3]).astype(np.float32)
#: Cells of a 4 x 4 grid at the frame's border; the object is in the middle.
_BORDER: Final = tuple((y, x) for y in range(4) for x in range(4) if y in (0, 3) or x in (0, 3))
#: A cell agrees if this share of its pixels agree.
_CELL_SHARE: Final = 0.6
#: The empty-table image is used if at least this share of the border cells agree.
# the right image agrees with 83 % or more of the border, one of another bench with 42 % or less (decision 0012)
MIN_AGREEMENT: Final = 0.65
#: Pixels that are compared with the border's colours at once: they fit into the processor's cache.
_BLOCK: Final = 1024  # with more, BLAS starts threads, which take longer than the comparison
#: A texture is what differs from the mean of the neighbours within so many pixels.
_WITHIN_PX: Final = 4
#: A learned background is used if at least this share of the frame's edge, of this width, agrees.
# not of the border's cells, which an object that fills the frame covers: photographs of such objects agree with 58 %
# of the edge or more, views of a camera that moves around the object with 55 % or less
_STILL: Final = 0.57
_EDGE_PX: Final = 4
#: At least this share of the border's cells needs texture to prove that two images show different benches.
_PROOF: Final = 0.5  # a horizon and the platter's rim reach half of them
#: Smallest contrast of a texture, as a standard deviation of logarithms.
_CONTRAST: Final = 0.02  # twice the noise
#: Largest difference between the border cells of a plain backdrop, and its largest distance from grey, in logarithms.
_PLAIN: Final = 0.12  # larger: a coloured wall counts as plain, and its colour is corrected away
_NEAR_GREY: Final = 0.35  # a factor of 1.4 between two channels: with more, the backdrop itself is coloured
#: Grey level that a plain backdrop is corrected to, and the largest correction of the exposure, as a logarithm.
_BACKDROP_LEVEL: Final = 128.0  # the middle of the range of grey levels
_MAX_EXPOSURE: Final = np.log(1.7)  # with more, the backdrop is dark or bright, and not badly exposed (decision 0012)


class BoxMethod(StrEnum):
    """The methods of finding the object's box."""

    EMPTY_TABLE = "empty-table"
    """The object differs from the empty-table image."""
    PLAIN_BACKGROUND = "plain-background"
    """The object differs from a plain background."""
    NETWORK = "network"
    """A small neural network found the object, without any background."""
    ROTATION = "rotation"
    """The same network, with the background that the other views of the search or enrollment show."""
    GUESS = "guess"
    """The object has other colours than the frame's border. Often wrong."""
    NONE = "none"
    """No object was found."""


class IssueCode(StrEnum):
    """The issues of a segmentation. The parameters of an issue are listed with its code."""

    TABLE_SIZE = "empty-table-size"
    """The empty-table image has another size: ``table_px`` and ``frame_px``, [width, height]."""
    TABLE_AZIMUTH = "empty-table-azimuth"
    """The camera moves around the object, and no empty-table image was taken near this azimuth: ``away_deg``."""
    TABLE_DIFFERS = "empty-table-differs"
    """The frame's border does not look like the empty-table image: ``agreement``, 0..1."""
    BACKDROP_EXPOSURE = "backdrop-exposure"
    """Most of the backdrop is too dark or overexposed: its colour is not measurable."""
    BACKDROP_COLOURS = "backdrop-several-colours"
    """The backdrop has several colours: none of them is known to be grey."""
    BACKDROP_COLOURFUL = "backdrop-colourful"
    """The backdrop's colour is too far from grey."""
    BACKDROP_LEVEL = "backdrop-level"
    """The backdrop is too dark or too bright to correct the exposure with it."""
    BACKGROUND_NOT_PLAIN = "background-not-plain"
    """The background is not plain: the object can only be guessed from its colours, or found by rotation."""
    DOUBTFUL_OUTLINE = "doubtful-outline"
    """Parts of the platter or of the backdrop may be inside the box: ``overlap``, expected with the object, 0..1."""
    NO_OBJECT = "no-object"
    """The network found no object."""
    NO_GUESS = "no-guess"
    """No part of the frame stands out by its colours."""
    NO_DIFFERENCE = "no-difference"
    """Nothing differs from the background: the empty-table image, or a plain one."""


@dataclass(frozen=True, slots=True)
class Issue:
    """An issue: its code, such as an `IssueCode`, and the JSON values that are listed with the code."""

    code: StrEnum
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Return the code and the parameters in one flat mapping."""
        return {"code": self.code.value, **self.parameters}


@dataclass(frozen=True, eq=False)
class Illumination:
    """Illumination correction of a frame: a plane for each channel."""

    slopes: FloatArray
    """float64 array (3, 3): logarithms of the factors that the frame is multiplied by. Rows: value at the frame's
    middle, rise over its width, rise over its height. Columns: B, G, R."""

    @property
    def gains(self) -> tuple[float, float, float]:
        """Factors for B, G, R at the middle of the frame."""
        blue, green, red = np.exp(self.slopes[0]).tolist()
        return blue, green, red

    def over(self, height: int, width: int) -> Floats:
        """Return the logarithms of the factors for every pixel, float32 (H, W, 3)."""
        x, y = _places(width), _places(height)
        along = (self.slopes[0] + x * self.slopes[1]).astype(np.float32)
        down = (y * self.slopes[2]).astype(np.float32)
        # in long rows: NumPy adds up short ones slowly
        planes: Floats = along.reshape(1, -1) + np.tile(down, (1, width))
        return planes.reshape(height, width, 3)


@dataclass(frozen=True, eq=False)
class Difference:
    """Difference between a frame and the empty-table image."""

    agreement: float
    """Share of the border's cells that look like the empty-table image after illumination correction."""
    certain: Mask
    """bool array (h, w): pixels of another colour, or brighter than the table can be."""
    possible: Mask
    """bool array (h, w): pixels that are darker by the same share in all colours: a shadow, or a grey object."""
    correction: Illumination
    """Brings the frame's illumination to that of the empty-table image."""
    evenly: Floats
    """float32 array (h, w): mean over the channels of what remains of the difference, in logarithms."""
    coloured: Floats
    """float32 array (h, w): largest distance of a channel from that mean."""
    residual: Floats
    """float32 array (h, w, 3): what remains of the difference in each channel, in logarithms."""
    background: "Background"
    """The background."""
    still: bool
    """Whether the frame's edge looks like the background."""

    @property
    def reliable(self) -> bool:
        """Whether the frame's border looks like the empty-table image."""
        return self.agreement >= MIN_AGREEMENT

    @property
    def is_enough(self) -> bool:
        """Whether as many pixels differ as an object has."""
        return int(np.count_nonzero(self.certain | self.possible)) >= LEAST * self.certain.size


class ViewDifferences(NamedTuple):
    """How a frame differs from the views that its background was learned from, or from the empty-table image.

    Differences are the largest of a pixel's channels, on the scale `_FAR`.
    """

    nearest: Floats
    """float32 array (h, w): difference from the view that is most similar in this pixel."""
    usual: Floats
    """float32 array (h, w): median of the differences."""
    equal: Floats
    """float32 array (h, w): share of the views that are equal in this pixel."""


class Background:
    """An empty-table image, prepared for comparison with many frames.

    Parameters
    ----------
    empty_table_bgr : uint8 array (H, W, 3)
        The table without an object, from the same camera position as the frames. The light may differ.

    Raises
    ------
    TypeError, ValueError
        The array is no such image.
    """

    def __init__(self, empty_table_bgr: ImageArray) -> None:
        check_frame(empty_table_bgr)
        self.shape = empty_table_bgr.shape[:2]
        self._set(shrunk(empty_table_bgr))

    @classmethod
    def learned(cls, smalls: Sequence[ImageArray], shape: tuple[int, int]) -> "Background":
        """Return the background that frames of this height and width show while the table rotates: their median.

        Parameters
        ----------
        smalls : sequence of uint8 array (h, w, 3)
            One to nine frames as `shrunk` returns them.
        shape : (int, int)
            Height and width of the frames.
        """
        background = cls.__new__(cls)
        background.shape = shape
        background._set(median(smalls))
        background._views = smalls
        return background

    def _set(self, small: ImageArray) -> None:
        self._views: Sequence[ImageArray] = ()
        self._grey_levels = small
        self._log = _logarithm(small)
        self._useful = _useful(small)

    @property
    def views(self) -> int:
        """Number of views that the background was learned from; 0 for an empty-table image."""
        return len(self._views)

    @cached_property
    def _apart(self) -> list[NDArray[np.int16]]:
        """How far each view is from the background, without the camera's exposure, in `_STEPS`, (h, w, 3)."""
        own = cv2.LUT(self._grey_levels, _LOG_STEPS)
        apart = [cv2.subtract(cv2.LUT(small, _LOG_STEPS), own) for small in self._views]
        middles = [_medians(np.ascontiguousarray(one[::6, ::6].reshape(-1, 3).T)).tolist() for one in apart]
        return [
            np.asarray(cv2.subtract(one, np.array([*middle, 0.0])), np.int16)
            for one, middle in zip(apart, middles, strict=True)
        ]

    @cached_property
    def spread(self) -> Floats:
        """How much the background changes from view to view, in logarithms, (h, w); 0 for an empty-table image."""
        if not self._views:
            return np.zeros(self._log.shape[:2], np.float32)
        away = np.abs(self._apart[0])
        for one in self._apart[1:]:  # NumPy's sum of a list copies it first, and takes five times as long
            away += np.abs(one)
        return np.asarray(_largest(cv2.split(away)) * np.float32(1 / (_STEPS * len(self._apart))), np.float32)

    def view_differences(self, difference: "Difference") -> "ViewDifferences":
        """Compare the frame of a difference with each view that the background was learned from, or with the image."""
        residual = np.rint(difference.residual * np.float32(_STEPS)).astype(np.int16)
        # saturated: nothing depends on a difference of a factor of 2.8
        away = [cv2.convertScaleAbs(cv2.subtract(residual, one)) for one in self._apart] or [
            cv2.convertScaleAbs(residual)
        ]
        far = [np.asarray(_largest(cv2.split(one)), np.uint8) for one in away]
        equal = np.add.reduce([cv2.LUT(one, _EQUAL) for one in far]) * np.float32(1 / len(far))
        nearest, usual = (cv2.LUT(one, _FAR) for one in (np.minimum.reduce(far), median(far)))
        return ViewDifferences(*(np.asarray(plane, np.float32) for plane in (nearest, usual, equal)))

    @cached_property
    def differs(self) -> Mask | None:
        """Where the small image differs from a plain background, (h, w); None if it is not plain."""
        return plain_difference(self._grey_levels)

    @property
    def correction(self) -> Illumination | None:
        """The correction that makes a plain backdrop grey; None if its colour is too far from grey."""
        return self._backdrop[0]

    @property
    def issue(self) -> IssueCode | None:
        """The reason why the correction is missing or incomplete."""
        return self._backdrop[1]

    def difference(self, small: ImageArray) -> Difference:
        """Compare a small frame, as `shrunk` returns it, with the empty-table image."""
        slopes = _fit(small, self._useful, self._log)
        residual = _logarithm(small) - self._log - Illumination(slopes).over(*small.shape[:2])
        evenly, coloured, certain, possible, agrees = self._planes(small, residual)
        # a shadow is smooth: a fine texture that the table does not have belongs to an object
        grain = (np.abs(cv2.Laplacian(evenly, cv2.CV_32F, ksize=3)) > 0.5).astype(np.float32)
        certain |= possible & (cv2.blur(grain, (5, 5)) > 0.15)
        shares = [int(np.count_nonzero(cell)) / cell.size for cell in border_cells(agrees)]
        agreement = sum(share > _CELL_SHARE for share in shares) / len(shares)
        inner = agrees[_EDGE_PX:-_EDGE_PX, _EDGE_PX:-_EDGE_PX]
        edge = np.count_nonzero(agrees) - np.count_nonzero(inner)
        return Difference(
            agreement,
            certain,
            possible & ~certain,
            Illumination(-slopes),
            evenly,
            coloured,
            residual,
            self,
            bool(edge >= _STILL * (agrees.size - inner.size)),
        )

    def _planes(self, small: ImageArray, remaining: Floats) -> tuple[Floats, Floats, Mask, Mask, Mask]:
        """Return the planes of a `Difference`, without the grain, and where the frame agrees with this image."""
        residual = cv2.split(remaining)
        evenly = (residual[0] + residual[1] + residual[2]) * np.float32(1 / 3)
        coloured = np.asarray(_largest([cv2.absdiff(part, evenly) for part in residual]), np.float32)
        # one grey level of noise is a larger share of a dark pixel
        noise = cv2.LUT(_smallest(cv2.split(cv2.min(small, self._grey_levels))), _NOISE)
        sure = (coloured > 0.08 + noise) | (evenly > 0.10 + noise) | (evenly < -1.1)
        return (
            evenly,
            coloured,
            sure,
            (evenly < -0.12) & ~sure,
            _largest([np.abs(part) for part in residual]) < _AGREES,
        )

    def shows_another_bench(self, empty_bgr: ImageArray) -> bool:
        """Return whether another empty-table image, uint8 (H, W, 3), certainly shows another bench, in any light.

        Only the border counts. A border without texture proves nothing: the same backdrop may have another shade, or
        another part of it may be in the picture.
        """
        if empty_bgr.shape[:2] != self.shape:
            return False
        small = shrunk(empty_bgr)
        textured = min(_textured_cells(self._log), _textured_cells(_logarithm(small)))
        return textured >= _PROOF * len(_BORDER) and not self.difference(small).reliable

    def whole_correction(self, difference: Difference) -> Illumination:
        """Return the correction of a frame to the light of this image, and to a plain grey backdrop if it shows one."""
        if self.correction is None:
            return difference.correction
        return Illumination(difference.correction.slopes + self.correction.slopes)

    @cached_property
    def _backdrop(self) -> tuple[Illumination | None, IssueCode | None]:
        """Return the correction that makes a plain, nearly grey backdrop grey, and what prevents it or a part of it."""
        cells = [
            np.median(cell[ok], axis=0)
            for cell, ok in zip(border_cells(self._log), border_cells(self._useful), strict=True)
            if ok.mean() > 0.5
        ]
        if len(cells) < len(_BORDER) / 2:
            return None, IssueCode.BACKDROP_EXPOSURE
        colours = np.array(cells)
        opponent = colours - colours.mean(axis=1, keepdims=True)
        middle = np.median(opponent, axis=0)
        if np.quantile(np.abs(opponent - middle).max(axis=1), 0.75) > _PLAIN:
            return None, IssueCode.BACKDROP_COLOURS
        if np.abs(middle).max() > _NEAR_GREY:
            return None, IssueCode.BACKDROP_COLOURFUL
        exposure = float(np.log(_BACKDROP_LEVEL + _FLOOR) - np.median(colours.mean(axis=1)))
        slopes = np.zeros((3, 3))
        slopes[0] = -middle
        if abs(exposure) > _MAX_EXPOSURE:
            return Illumination(slopes), IssueCode.BACKDROP_LEVEL
        slopes[0] += exposure
        return Illumination(slopes), None


def shrunk(image_bgr: ImageArray) -> ImageArray:
    """Return the image with sides of at most 128 pixels, slightly blurred."""
    scale = SIDE_PX / max(image_bgr.shape[:2])
    if scale < 1:
        size = max(1, round(image_bgr.shape[1] * scale)), max(1, round(image_bgr.shape[0] * scale))
        by_kernel = calls.shrink(image_bgr, size)
        if by_kernel is None:
            by_kernel = cv2.resize(image_bgr, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
        image_bgr = by_kernel
    return cv2.GaussianBlur(image_bgr, (5, 5), 0.8).astype(np.uint8, copy=False)


def median(images: Sequence[ImageArray]) -> ImageArray:
    """Return the median of each value of at most a few images of one shape, uint8, rounded down.

    The images are sorted up to their middle by pairwise minima and maxima, which is ten times faster than a partition
    of each pixel.
    """
    ranked = [image.copy() for image in images]
    middle = len(ranked) // 2
    for rank in range(middle + 1):
        for n in range(len(ranked) - 1, rank, -1):
            lower = np.minimum(ranked[n - 1], ranked[n])
            np.maximum(ranked[n - 1], ranked[n], out=ranked[n])
            ranked[n - 1] = lower
    if len(ranked) % 2:
        return ranked[middle]
    return ((ranked[middle - 1].astype(np.uint16) + ranked[middle]) // 2).astype(np.uint8)


def from_border(small: ImageArray) -> Floats:
    """Return the distance of each pixel's colour from the nearest colour at the frame's border, in logarithms, (h, w).

    Brightness counts half, because shadows and folds of a cloth change it more than the colour.
    """
    height, width = small.shape[:2]
    coarse = cv2.resize(small, (16, 12), interpolation=cv2.INTER_AREA)
    border = np.concatenate([coarse[0], coarse[-1], coarse[1:-1, 0], coarse[1:-1, -1]])[None]
    # every second pixel is enough, and takes a quarter of the time
    half = cv2.resize(small, (max(1, width // 2), max(1, height // 2)), interpolation=cv2.INTER_AREA)
    colours, near = _opponents(np.asarray(half, np.uint8)), _opponents(np.ascontiguousarray(border, np.uint8))
    # |near - colour|² without |colour|², as one matrix product with a fifth column
    near = np.concatenate([-2 * near, np.einsum("nc,nc->n", near, near)[:, None]], axis=1)
    squares = np.einsum("nc,nc->n", colours, colours)
    colours = np.concatenate([colours, np.ones((len(colours), 1), np.float32)], axis=1)
    for start in range(0, len(colours), _BLOCK):
        squares[start : start + _BLOCK] += (near @ colours[start : start + _BLOCK].T).min(axis=0)
    distances = np.sqrt(np.maximum(squares, 0)).reshape(half.shape[:2])
    return np.asarray(cv2.resize(distances, (width, height)), np.float32)


def _opponents(image: ImageArray) -> Floats:
    """Return half the mean of the logarithms of each pixel's channels, and their differences from it, (n, 4)."""
    return cv2.transform(_logarithm(image), _OPPONENTS).reshape(-1, 4).astype(np.float32, copy=False)


def border_cells(image: NDArray[Any]) -> list[NDArray[Any]]:
    """Return the 12 cells of a 4 x 4 grid that lie at the border."""
    rows, columns = map(_quarters, image.shape[:2])
    return [image[rows[y] : rows[y + 1], columns[x] : columns[x + 1]] for y, x in _BORDER]


def _textured_cells(logarithms: Floats) -> int:
    """Return the number of border cells with differences of brightness within a few pixels."""
    grey = cv2.transform(logarithms, np.full((1, 3), 1 / 3, np.float32))
    within = np.asarray(grey - cv2.GaussianBlur(grey, (0, 0), _WITHIN_PX), np.float32)
    return sum(float(cell.std()) > _CONTRAST for cell in border_cells(within))


@lru_cache
def _places(side: int) -> FloatArray:
    """Return the middles of pixels as shares of a side, 0 in its middle, (side, 1)."""
    places: FloatArray = ((np.arange(side) + 0.5) / side - 0.5)[:, None]
    return places


@lru_cache
def _plane(height: int, width: int) -> FloatArray:
    """Return 1 and the place across and down of the pixels that a plane is fitted to, (h, w, 3)."""
    y, x = np.mgrid[2:height:_EVERY, 2:width:_EVERY]
    basis: FloatArray = np.stack([np.ones(x.shape), (x + 0.5) / width - 0.5, (y + 0.5) / height - 0.5], axis=2)
    return basis


@lru_cache
def _quarters(side: int) -> tuple[int, ...]:
    return tuple(np.linspace(0, side, 5).astype(int).tolist())


def _logarithm(image: ImageArray) -> Floats:
    return cv2.LUT(image, _LOG).astype(np.float32, copy=False)


def _useful(image: cv2.typing.MatLike) -> Mask:
    """Return which pixels are neither black nor overexposed."""
    brightest = _largest(cv2.split(image))
    useful: Mask = (brightest > _FLOOR) & (brightest < 250)
    return useful


def _largest(channels: Sequence[cv2.typing.MatLike]) -> cv2.typing.MatLike:
    # NumPy's reduction over a last axis of length 3 is several times slower
    return cv2.max(cv2.max(channels[0], channels[1]), channels[2])


def _smallest(channels: Sequence[cv2.typing.MatLike]) -> cv2.typing.MatLike:
    return cv2.min(cv2.min(channels[0], channels[1]), channels[2])


def _medians(rows: FloatArray) -> FloatArray:
    """Return the median of each row: as np.median, which takes three times as long for few values."""
    middle = rows.shape[1] // 2
    both = np.partition(rows, (middle - 1, middle), axis=1)[:, middle - 1 : middle + 1]
    return (both[:, 0] + both[:, 1]) / 2 if rows.shape[1] % 2 == 0 else both[:, 1]


def _fit(small: ImageArray, useful: Mask, table_log: Floats) -> FloatArray:
    """Fit a plane to each channel of the difference of logarithms by least squares, repeated without the outliers."""
    few = np.s_[2::_EVERY, 2::_EVERY]
    keep = useful[few] & _useful(small[few])
    basis = _plane(*useful.shape)[keep]
    values = (_logarithm(small[few]) - table_log[few])[keep].astype(np.float64)
    if len(basis) < 12:
        return np.zeros((3, 3))
    slopes = np.zeros((3, 3))
    slopes[0] = _medians(np.ascontiguousarray(values.T))
    quarter = len(values) // 4
    for tolerance in (0.35, 0.2, 0.12, 0.12):
        fitted = basis @ slopes
        away = np.maximum.reduce(np.abs(values - fitted).T)
        inlier = np.flatnonzero(away <= max(tolerance, float(np.partition(away, quarter)[quarter])))
        own, own_values = basis.take(inlier, axis=0), values.take(inlier, axis=0)
        gram = own.T @ own + _RIDGE
        slopes = np.linalg.solve(gram, own.T @ own_values).astype(np.float64, copy=False)
    return slopes


#: A pixel differs from the background by at least this many grey levels, and by this share of the object's contrast.
_LEAST_LEVELS: Final = 12.0  # above noise and compression
_SHARE: Final = 0.25  # larger: dim parts of the object are lost; smaller: its shadow becomes part of it
#: A backdrop is plain if three corners of the frame have the same colour within this many grey levels (two corners are
#: enough if they are darker than `_DARK`),
_ONE_COLOUR: Final = 12.0
_DARK: Final = 40.0  # below this, noise and stray light differ from corner to corner
#: and if the smoothest corner differs from the background by at most this, plus its noise.
_SMOOTH: Final = 3.0
_GRAIN: Final = 1.5


def plain_difference(small: ImageArray) -> Mask | None:
    """Return where a small image differs from its background, bool (h, w); None if the background is not plain.

    The background of each row is interpolated between its two ends, so that a horizon does not matter.
    """
    height, width = small.shape[:2]
    image = cv2.GaussianBlur(small, (7, 7), 1.3)
    corners = _corners(height, width)
    if not _one_colour([image[corner] for corner in corners]):
        return None
    edge = max(2, width // 32)
    left, right = (
        cv2.blur(np.sort(part, axis=1)[:, part.shape[1] // 2, None].astype(np.float32), (1, 9)).reshape(height, 1, 3)
        for part in (image[:, :edge], image[:, -edge:])
    )
    across = ((np.arange(width, dtype=np.float32) + 0.5) / width)[None, :, None]
    apart = cv2.split(cv2.absdiff(image.astype(np.float32), left + (right - left) * across))
    away = cv2.max(cv2.max(apart[0], apart[1]), apart[2])
    border = np.concatenate([away[:edge].ravel(), away[:, :edge].ravel(), away[:, -edge:].ravel()])
    threshold = max(_LEAST_LEVELS, 4 * float(np.median(border)))
    if not _smooth(corners, away, cv2.absdiff(small, image), edge + 2):
        return None
    # the object's contrast: 5 % of the frame exceed it; every third pixel in each direction is enough
    sample = np.sort(away[::3, ::3], axis=None)
    contrast = float(sample[-(len(sample) // 20 + 1)])
    differs: Mask = away > max(threshold, _SHARE * contrast)
    return differs


def _corners(height: int, width: int) -> list[tuple[slice, slice]]:
    height, width = max(1, height // 8), max(1, width // 8)
    return [(rows, part) for rows in (np.s_[:height], np.s_[-height:]) for part in (np.s_[:width], np.s_[-width:])]


def _one_colour(corners: list[cv2.typing.MatLike]) -> bool:
    """Return whether the corners show one backdrop, and not a wall and a table."""
    colours = np.array([_median(corner.reshape(-1, 3)) for corner in corners])
    same = (np.abs(colours[:, None] - colours).max(axis=2) <= _ONE_COLOUR).sum(axis=1)
    dark = colours.max(axis=1) < _DARK
    return bool((same >= np.where(dark, 2, 3)).any())


def _median(rows: cv2.typing.MatLike) -> FloatArray:
    """Return the median of each column: as np.median, which takes four times as long for few values."""
    columns, middle = np.sort(rows.T, axis=1), len(rows) // 2
    return (columns[:, middle] + columns[:, -middle - 1].astype(np.float64)) / 2


def _smooth(corners: list[tuple[slice, slice]], away: cv2.typing.MatLike, noise: cv2.typing.MatLike, edge: int) -> bool:
    """Return whether the smoothest corner shows no pattern."""
    edge = min(edge, (away.shape[1] - 1) // 2)
    # not at the edges: the background is interpolated from them, so that the difference is always small there
    inner = away[:, edge : -edge or None], noise[:, edge : -edge or None]
    difference, grain = min(
        (float(np.median(inner[0][corner])), float(inner[1][corner].max(axis=2).mean())) for corner in corners
    )
    return difference <= _SMOOTH + _GRAIN * grain


class SegmentedFrame:
    """A frame, uint8 (H, W, 3), and its small image; ``described`` has its levels by descriptors of the whole frame.

    Raises `TypeError`, `ValueError`: the array is no such image.
    """

    def __init__(self, image_bgr: ImageArray) -> None:
        check_frame(image_bgr)
        self.image = image_bgr
        self.small = shrunk(image_bgr)
        self.described: dict[str, LevelArray] = {}
        self._compared: tuple[Background, Difference] | None = None

    @classmethod
    def of(cls, image_bgr: "ImageArray | SegmentedFrame") -> "SegmentedFrame":
        """Return the frame of an image, or the frame itself."""
        return image_bgr if isinstance(image_bgr, SegmentedFrame) else cls(image_bgr)

    def difference(self, background: Background) -> Difference:
        """Return the difference from a background. The last one is cached for further segmentations of the frame."""
        if self._compared is None or self._compared[0] is not background:
            self._compared = background, background.difference(self.small)
        return self._compared[1]

    @cached_property
    def differs(self) -> Mask | None:
        """Where the small image differs from a plain background, bool (h, w); None if it is not plain."""
        return plain_difference(self.small)

    @cached_property
    def from_border(self) -> Floats:
        """The distance of each pixel's colour from the colours at the frame's border, as `from_border` returns it."""
        return from_border(self.small)
