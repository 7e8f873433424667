"""How well an enrolled view fits a view of a search, pixel by pixel, in any light.

The descriptors of two views compare 8 x 8 cells, which an object that is not enrolled, or a near twin with another
sticker, letter or lid, may share. Here the enrolled view is registered to the view. The two are compared in logarithms
of the brightness and of two ratios of the colours, minus their medians: another exposure or another colour of the light
only adds a constant to them.

Decision: docs/decisions/0015.
"""

from dataclasses import dataclass
from operator import attrgetter
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray

Mask = NDArray[np.uint8]
Map = NDArray[np.float32]

#: Side of the compared images, and their largest movement in the first step.
SIDE_PX: Final = 64
_REACH_PX: Final = 10  # a sixth of the side: a larger displacement is an error of the pose, and not of the box
#: Scales of width and height in the first step.
_SCALES: Final = ((0.88, 0.88), (0.88, 1.0), (1.0, 0.88), (1.0, 1.0), (1.0, 1.13), (1.13, 1.0), (1.13, 1.13))
#: Smallest gain of correlation that justifies a change of a scale, and a movement by a pixel of the reduced image.
_SCALE_COST: Final = 0.02
_PIXEL_COST: Final = 0.002
# more or smaller steps: a better registration of flat images, at more time for each pair
_CRITERIA: Final = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 1e-3)
#: A registration with a larger change than this is not used.
_MOST_SHEAR: Final = 0.4
_AREAS: Final = (0.55, 1.8)  # outside, the two boxes cannot be of one object, or the registration went astray
#: Units of a logarithm, and grey levels that keep it finite.
_UNITS: Final = 40.0
_DARK: Final = (9.0, 12.0)  # larger: less noise of dark pixels, and less of their contrast
#: Largest square of a difference of the light that counts: that of a factor of e.
_MOST_LIGHT: Final = 1.0
#: Smallest number of common pixels for a comparison.
_FEWEST: Final = 60


@dataclass(frozen=True, eq=False)
class LocalView:
    """A view for the comparison."""

    crop: ImageArray
    """uint8 array (160, 160, 3): as `hbr.Segmentation.crop`."""
    mask: Mask
    """uint8 array (160, 160): as `hbr.Segmentation.mask`."""
    azimuth_deg: float
    """Orientation of the camera around the object; for a view of a search, from any zero that its views share."""


@dataclass(frozen=True, eq=False)
class Pixels:
    """A view, prepared."""

    colours: Map
    """float32 array (64, 64, 3): logarithms of the brightness and of two ratios of the colours."""
    mask: Mask
    """uint8 array (64, 64): share of each pixel that belongs to the object, 0..255."""
    alone: Map
    """float32 array (32, 32): the logarithm of the brightness at half the size, with its mean instead of the
    background."""

    @classmethod
    def of(cls, view: LocalView) -> "Pixels":
        """Prepare a view."""
        size = (SIDE_PX, SIDE_PX)
        crop, mask = (cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in (view.crop, view.mask))
        levels = crop.astype(np.float32)
        brightness = np.log(levels.mean(axis=2) + _DARK[0])
        blue, green, red = cv2.split(np.log(levels + _DARK[1]))
        colours = _UNITS * np.dstack([brightness, red - green, blue - (green + red) / 2])
        inside = mask > 127
        alone = colours[:, :, 0].copy()
        if inside.any():
            alone[~inside] = alone[inside].mean()
        half = cv2.resize(alone, (SIDE_PX // 2, SIDE_PX // 2), interpolation=cv2.INTER_AREA)
        return cls(colours.astype(np.float32), np.asarray(mask, np.uint8), np.asarray(half, np.float32))


class Compared(NamedTuple):
    """What a registered enrolled view says of a view; zeros if the two have no common pixels."""

    fit: float
    """Share of the contrast that the enrolled view explains, at most 1."""
    light: FloatArray
    """float64 array (3,): median differences of the three logarithms, that is, of the exposure and the light."""


#: The key by which the best of several comparisons is found.
BY_FIT: Final = attrgetter("fit")


class PixelFit(NamedTuple):
    """The comparison of the leading candidates of a search with its views; a fit is at most 1."""

    object_index: int
    """The leader, after the comparison, as an index of the views' names."""
    own: float
    second: float
    """Mean fit of the leader, and of the other one of the two likeliest candidates; 0 without one."""
    others: float
    """The best mean fit of the next candidates that are no near twins of the leader; 0 without one."""
    expected: float
    """Mean fit of the two enrolled views of the leader beside each view to each other."""
    light: float
    """How far the light of the views is from that of the leader's enrollment: the square of their mean
    `Compared.light`, from 0 on."""

    def numbers(self) -> list[float]:
        """Return the numbers for the evidence (`hbr.dense.stopping`)."""
        return [self.own, self.own - self.others, self.own - self.expected, min(self.light, _MOST_LIGHT)]


def compare(view: Pixels, enrolled: Pixels) -> Compared:
    """Register an enrolled view to a view, and compare the two."""
    begin = _begin(view, enrolled)
    found = _fit_map(view, enrolled, begin)
    moved = [_compare(view, enrolled, move) for move in ([begin] if found is None else [begin, found])]
    return max(moved, key=BY_FIT)


def _compare(view: Pixels, enrolled: Pixels, move: Map) -> Compared:
    """Compare a view with an enrolled view that is moved."""
    size, flags = (SIDE_PX, SIDE_PX), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpAffine(enrolled.colours, move, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    inside = (cv2.warpAffine(enrolled.mask, move, size, flags=flags) > 127).astype(np.uint8)
    common = cv2.erode(inside, np.ones((3, 3), np.uint8)) > 0
    if int(common.sum()) < _FEWEST:
        return Compared(0.0, np.zeros(3))
    a, b = view.colours[common], moved[common]
    apart = a - b
    light = np.median(apart, axis=0)
    contrast = float(np.abs(a - np.median(a, axis=0)).sum() + np.abs(b - np.median(b, axis=0)).sum())
    fit = 1 - float(np.abs(apart - light).sum()) / max(contrast, 1e-6)
    return Compared(fit, light.astype(np.float64) / _UNITS)


def _fit_map(view: Pixels, enrolled: Pixels, begin: Map) -> Map | None:
    """Return the affine map, (2, 3), from pixels of a view to those of an enrolled view; None if none is found."""
    inside = cv2.erode((enrolled.mask > 127).astype(np.uint8), np.ones((3, 3), np.uint8))
    here, there = (np.ascontiguousarray(one.colours[:, :, 0]) for one in (view, enrolled))
    try:
        _, found = cv2.findTransformECC(here, there, begin.copy(), cv2.MOTION_AFFINE, _CRITERIA, inside, 3)
    except cv2.error:  # an even surface has nothing to register
        return None
    move = np.asarray(found, np.float32)
    area = float(np.linalg.det(move[:, :2]))
    plausible = _AREAS[0] < area < _AREAS[1] and float(np.abs(move[:, :2] - np.eye(2)).max()) < _MOST_SHEAR
    return move if plausible else None


def _begin(view: Pixels, enrolled: Pixels) -> Map:
    """Return the map with the highest correlation among some scales and all moves, at half the size."""
    wide = cv2.copyMakeBorder(view.colours[:, :, 0], *(_REACH_PX,) * 4, cv2.BORDER_REPLICATE)
    half = cv2.resize(wide, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    side = enrolled.alone.shape[0]
    found: list[tuple[float, tuple[float, float, float, float]]] = []
    middle = (side - 1) / 2
    for across, down in _SCALES:
        scaled = np.array([[across, 0, (1 - across) * middle], [0, down, (1 - down) * middle]])
        part = cv2.warpAffine(enrolled.alone, scaled, (side, side), borderMode=cv2.BORDER_REPLICATE)
        _, similar, _, (x, y) = cv2.minMaxLoc(cv2.matchTemplate(half, part, cv2.TM_CCOEFF_NORMED))
        away = x - _REACH_PX / 2, y - _REACH_PX / 2
        similar -= _SCALE_COST * ((across != 1) + (down != 1)) + _PIXEL_COST * (abs(away[0]) + abs(away[1]))
        found.append((similar, (across, down, 2 * away[0], 2 * away[1])))
    across, down, x_px, y_px = max(found)[1]
    middle = (SIDE_PX - 1) / 2
    forward = np.array([[across, 0, (1 - across) * middle + x_px], [0, down, (1 - down) * middle + y_px], [0, 0, 1]])
    return np.linalg.inv(forward)[:2].astype(np.float32)
