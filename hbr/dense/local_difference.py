"""Comparisons pixel by pixel: of two objects, and of a view with an enrolled one.

Near twins differ in one sticker, letter or handle, which a descriptor of the whole object hardly shows. For each view
of a search, the enrolled views of both objects at the estimated pose are registered to it. Where the enrolled views of
the two differ by more than neighbouring views of one object do, the view is compared with both:

    score = Σ w · (difference from the second − difference from the first) / Σ w · (difference between both)

summed over the pixels of all views: 1 for the first object, −1 for the second one. Then the same scores are computed
for enrolled views in place of the views of the search; each is left out of the views that it is compared with. These
scores show whether the objects can be distinguished from these sides, and how much a score scatters. Cantelli's
inequality bounds the error rate.

Decision: docs/decisions/0016.

`fit` compares a view with an enrolled one, after registration, in any light: logarithms of the brightness and of two
ratios of the colours, minus their medians. Another exposure or another colour of the light only adds a constant to them
(docs/decisions/0016).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap180
from hbr.core.arrays import ImageArray

#: Side of the compared images.
SIDE_PX: Final = 128
#: Enrolled views that a view is compared with, at most; one more is needed where one is left out.
NEAREST: Final = 2  # a view lies between two enrolled ones; further ones show other sides
#: Views of a search that are compared, at most, and how far apart they are at least.
MOST_VIEWS: Final = 8
APART_DEG: Final = 20.0  # nearer views show nearly the same pixels: they take time and add little evidence
#: Score above which the difference decides.
MIN_SCORE: Final = 0.5  # the right twin of ten pairs scored between 0.8 and 1 (decision 0016); 0 favours neither
#: Smallest sum of the weights, grey levels times pixels: about a spot of 6 x 6 pixels in another colour.
MIN_WEIGHT: Final = 2000.0
#: Largest difference that the found object leaves unexplained: as a share of the weights, and in grey levels per pixel.
MAX_UNEXPLAINED: Final = 0.5  # with more, a third object explains the view as well as the leader does
# larger: an unknown object that resembles one twin is found; smaller: a noisy camera never decides
MAX_MISFIT: Final = 2.0
#: Largest displacement of a detail after the registration, by parallax and by views between two enrolled ones.
_REACH_PX: Final = 3  # larger: a small sticker matches a shade beside it; smaller: parallax looks like a difference
#: Differences of grey levels that noise and sharpness explain.
_FLOOR: Final = 10.0
#: A view with less weight than this does not show a difference.
_LEAST_WEIGHT: Final = 300.0
# more or smaller steps: a better registration of flat images, at more time for each pair
_CRITERIA: Final = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 25, 1e-4)
Mask = NDArray[np.uint8]
Map = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class LocalView:
    """A view for the comparison.

    Attributes
    ----------
    crop : uint8 array (160, 160, 3)
        As `hbr.Segmentation.crop`.
    mask : uint8 array (160, 160)
        As `hbr.Segmentation.mask`.
    azimuth_deg : float
        Orientation of the camera around the object; for a view of a search, from any zero that its views share.
    """

    crop: ImageArray
    mask: Mask
    azimuth_deg: float

    def resized(self, side_px: int) -> tuple[ImageArray, Mask]:
        """Return crop and mask, uint8 (side, side, 3) and (side, side)."""
        size = (side_px, side_px)
        crop, mask = (cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in (self.crop, self.mask))
        return crop.astype(np.uint8, copy=False), mask.astype(np.uint8, copy=False)


@dataclass(frozen=True, eq=False)
class ViewDifference:
    """The differences that one view of a search shows.

    Attributes
    ----------
    view : int
        Its place among the views that were compared.
    score : float
        1 for the first object, −1 for the second one.
    weight : float
        How much the objects differ from this side: grey levels, summed over pixels.
    unexplained : (float, float)
        Differences of the view from each object that neighbouring enrolled views do not have, in the same unit.
    pixels : int
        Pixels of the object in the view.
    difference : float32 array (128, 128)
        Difference of the enrolled views of both objects, minus that of neighbouring views of one object, in grey
        levels.
    query, first, second : uint8 arrays (128, 128, 3)
        The view, and the enrolled views of both objects, registered to it.
    """

    view: int
    score: float
    weight: float
    unexplained: tuple[float, float]
    pixels: int
    difference: Map
    query: ImageArray
    first: ImageArray
    second: ImageArray


@dataclass(frozen=True, eq=False)
class LocalDecision:
    """Which of two objects the views show.

    Attributes
    ----------
    winner : int or None
        0 for the first object, 1 for the second one, None if the comparison decides for neither.
    score : float
        1 for the first object, −1 for the second one.
    expected : (float, float), or None
        The scores of enrolled views of each object in place of the views; None if the views show no difference, or do
        not fit.
    error_bound : float
        Bound of the probability that the other object has this score; 1 if it is not known.
    unexplained : float, or None
        Differences of the views from the better object that neighbouring enrolled views do not have, as a share of the
        weights; None without weights.
    weight : float
        Sum of the weights.
    misfit, apart : float
        Differences that the better object leaves unexplained, and the weights, per pixel of the object, in grey levels.
    views : tuple of ViewDifference
        The views that show a difference, the clearest first.
    """

    winner: int | None
    score: float
    expected: tuple[float, float] | None
    error_bound: float
    unexplained: float | None
    weight: float
    misfit: float
    apart: float
    views: tuple[ViewDifference, ...]


class _Fit(NamedTuple):
    """An enrolled view that was registered to another one, its difference from that one, and the mean of that."""

    image: ImageArray
    mask: Mask
    apart: Map
    mean: float


def chosen_views(orientations_deg: Sequence[float]) -> list[int]:
    """Return the places of the views of a search to compare: the last ones that are `APART_DEG` from each other."""
    chosen: list[int] = []
    for number in range(len(orientations_deg) - 1, -1, -1):
        away = [abs(wrap180(orientations_deg[number] - orientations_deg[other])) for other in chosen]
        if len(chosen) < MOST_VIEWS and min(away, default=360.0) >= APART_DEG:
            chosen.append(number)
    return chosen[::-1]


def compare_objects(
    queries: Sequence[LocalView],
    objects: tuple[Sequence[LocalView], Sequence[LocalView]],
    rotations_deg: tuple[Sequence[float], Sequence[float]],
    *,
    max_error: float = 0.01,
) -> LocalDecision:
    """Decide which of two objects the views of a search show."""
    if not queries or min(map(len, objects)) < NEAREST:
        raise ValueError("the comparison needs a view of the search and two enrolled views of each object")
    fits = [_best_pose(queries, views, rotations) for views, rotations in zip(objects, rotations_deg, strict=True)]
    (first_deg, first), (second_deg, second) = fits
    shown = [_shown(n, query, a, b) for n, (query, a, b) in enumerate(zip(queries, first, second, strict=True))]
    telling = [one for one in shown if one.weight >= _LEAST_WEIGHT]
    weights = np.array([one.weight for one in telling])
    weight = float(weights.sum())
    score = float(weights @ [one.score for one in telling]) / weight if weight else 0.0
    best = int(score < 0)
    pixels = max(1, sum(one.pixels for one in shown))
    left = sum(one.unexplained[best] for one in shown)
    misfit, apart = left / pixels, weight / pixels
    unexplained = left / weight if weight else None
    winner, expected, bound = None, None, 1.0
    if unexplained is not None and weight >= MIN_WEIGHT and misfit <= MAX_MISFIT:
        scores, own = _left_out([queries[one.view] for one in telling], objects, (first_deg, second_deg))
        expected = float(scores[0] @ own[0] / own[0].sum()), float(scores[1] @ own[1] / own[1].sum())
        away = np.concatenate([1 - scores[0], 1 + scores[1]])
        every = np.concatenate(own)
        scatter = float(away**2 @ every / every.sum()) / (weight**2 / float(weights @ weights))
        bound = scatter / (scatter + (1 + abs(score)) ** 2)
        is_clear = min(abs(score), expected[0], -expected[1]) >= MIN_SCORE
        if is_clear and unexplained <= MAX_UNEXPLAINED and bound <= max_error:
            winner = best
    views = tuple(sorted(telling, key=lambda one: -one.weight))
    return LocalDecision(winner, score, expected, bound, unexplained, weight, misfit, apart, views)


def _left_out(
    queries: Sequence[LocalView],
    objects: tuple[Sequence[LocalView], Sequence[LocalView]],
    added_deg: tuple[float, float],
) -> tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]]:
    """Return scores and weights of the enrolled views of each object that are nearest to these views of a search."""
    scores, weights = [], []
    for own in (0, 1):
        found = []
        for query in queries:
            (view,) = _nearest(objects[own], query.azimuth_deg + added_deg[own], 1)
            rest = [other for other in objects[own] if other is not view]
            azimuths_deg = [view.azimuth_deg - added_deg[own] + by for by in added_deg]
            sides = [rest if side == own else objects[side] for side in (0, 1)]
            a, b = (_fits(view, views, deg) for views, deg in zip(sides, azimuths_deg, strict=True))
            found.append(_shown(0, view, a, b))
        scores.append(np.array([one.score for one in found]))
        weights.append(np.array([max(one.weight, 1.0) for one in found]))
    return scores, weights


def _best_pose(
    queries: Sequence[LocalView], views: Sequence[LocalView], rotations_deg: Sequence[float]
) -> tuple[float, list[list[_Fit]]]:
    """Return the rotation at which an object fits the views best, with the enrolled views there, the best one first."""
    poses = [(deg, [_fits(query, views, query.azimuth_deg + deg) for query in queries]) for deg in rotations_deg]
    return min(poses, key=lambda pose: sum(best.mean for best, *_ in pose[1]))


def _nearest(views: Sequence[LocalView], azimuth_deg: float, count: int) -> list[LocalView]:
    return sorted(views, key=lambda view: abs(wrap180(view.azimuth_deg - azimuth_deg)))[:count]


def _fits(query: LocalView, views: Sequence[LocalView], azimuth_deg: float) -> list[_Fit]:
    """Return the enrolled views nearest to an azimuth, registered to a view, the one that fits best first."""
    image, mask = query.resized(SIDE_PX)
    own = (mask > 127).astype(np.uint8)
    found = []
    for view in _nearest(views, azimuth_deg, NEAREST):
        moved, moved_mask = _registered(view, query)
        apart = pixel_difference(image, moved)
        found.append(_Fit(moved, moved_mask, apart, float(cv2.mean(apart, mask=own)[0])))
    return sorted(found, key=lambda fit: fit.mean)


def _shown(number: int, query: LocalView, first: Sequence[_Fit], second: Sequence[_Fit]) -> ViewDifference:
    """Compare a view with the enrolled views of both objects, where these differ."""
    image, mask = query.resized(SIDE_PX)
    a, b = first[0], second[0]
    both = pixel_difference(a.image, b.image)
    noise = np.full_like(both, _FLOOR)
    for best, *others in (first, second):
        for other in others:  # the differences of neighbouring views of one object
            noise = np.maximum(noise, cv2.dilate(pixel_difference(best.image, other.image), _square(3)))
    inside = cv2.dilate(np.maximum(np.maximum(a.mask, b.mask), mask), _square(3)) > 127
    weights = np.where(inside, np.maximum(both - noise, 0), 0).astype(np.float32)
    total = float((weights * both).sum())
    score = float((weights * (b.apart - a.apart)).sum()) / total if total > 0 else 0.0
    own = mask > 127
    of_first, of_second = (float(np.maximum(one.apart - noise, 0)[own].sum()) for one in (a, b))
    weight, pixels = float(weights.sum()), int(own.sum())
    return ViewDifference(number, score, weight, (of_first, of_second), pixels, weights, image, a.image, b.image)


def _registered(view: LocalView, to: LocalView) -> tuple[ImageArray, Mask]:
    """Return a view and its mask, moved, scaled and sheared to fit another view, with the light of that view."""
    image, mask = view.resized(SIDE_PX)
    target, target_mask = to.resized(SIDE_PX)
    grey, target_grey = (cv2.cvtColor(one, cv2.COLOR_BGR2GRAY) for one in (image, target))
    move = np.eye(2, 3, dtype=np.float32)
    found = affine_map(target_grey, grey, move, cv2.dilate(target_mask, _square(5)), _CRITERIA, 5)
    move = move if found is None else found  # an even surface stays where the silhouettes have placed it
    size, flags = (SIDE_PX, SIDE_PX), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpAffine(image, move, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    moved_mask = cv2.warpAffine(mask, move, size, flags=flags)
    both = (moved_mask > 127) & (target_mask > 127)
    if both.any():
        levels = [np.median(one[both], axis=0).astype(np.float64) + 8.0 for one in (target, moved)]
        moved = np.clip(moved * np.clip(levels[0] / levels[1], 0.5, 2.0), 0, 255)
    return moved.astype(np.uint8, copy=False), moved_mask.astype(np.uint8, copy=False)


def affine_map(
    to: NDArray[Any],
    image: NDArray[Any],
    begin: Map,
    inside: NDArray[Any],
    criteria: tuple[int, int, float],
    blur_px: int,
) -> Map | None:
    """Return the affine map, float32 (2, 3), from pixels of ``to`` to those of an image, both of one channel.

    It begins with ``begin`` and looks at the pixels ``inside``; None if an even surface has nothing to register.
    """
    try:
        _, found = cv2.findTransformECC(to, image, begin.copy(), cv2.MOTION_AFFINE, criteria, inside, blur_px)
    except cv2.error:
        return None
    return np.asarray(found, np.float32)


def pixel_difference(a: ImageArray, b: ImageArray) -> Map:
    """Return the difference of two images, uint8 (h, w, 3), at each pixel, in grey levels, float32 (h, w).

    Details may be displaced by `_REACH_PX`. A detail that only one of the images has counts in both directions.
    """
    height, width = a.shape[:2]
    soft = [cv2.GaussianBlur(one, (0, 0), 0.8) for one in (a, b)]
    found = []
    for one, other in (soft, soft[::-1]):
        wide = cv2.copyMakeBorder(other, *(_REACH_PX,) * 4, cv2.BORDER_REPLICATE)
        least = np.full((height, width), 255, np.uint8)
        for x, y in _shifts():
            apart = cv2.absdiff(one, wide[y : y + height, x : x + width])
            blue, green, red = cv2.split(apart)
            cv2.min(least, cv2.max(cv2.max(blue, green), red), dst=least)
        found.append(least)
    return cv2.max(found[0], found[1]).astype(np.float32)


@lru_cache
def _shifts() -> tuple[tuple[int, int], ...]:
    reach = range(-_REACH_PX, _REACH_PX + 1)
    return tuple((x + _REACH_PX, y + _REACH_PX) for x in reach for y in reach if x * x + y * y <= _REACH_PX**2 + 1)


def _square(side: int) -> Mask:
    return np.ones((side, side), np.uint8)


#: Side of the compared images, and their largest movement in the first step.
FIT_PX: Final = 64
_FIT_REACH_PX: Final = 10  # a sixth of the side: a larger displacement is an error of the pose, and not of the box
#: Scales of width and height in the first step.
_SCALES: Final = ((0.88, 0.88), (0.88, 1.0), (1.0, 0.88), (1.0, 1.0), (1.0, 1.13), (1.13, 1.0), (1.13, 1.13))
#: Smallest gain of correlation that justifies a change of a scale, and a movement by a pixel of the reduced image.
_SCALE_COST: Final = 0.02
_PIXEL_COST: Final = 0.002
# coarser than `_CRITERIA`: every candidate is registered, and the fit needs no single pixels
_FIT_CRITERIA: Final = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 1e-3)
#: A registration with a larger change than this is not used.
_MOST_SHEAR: Final = 0.4
_AREAS: Final = (0.55, 1.8)  # outside, the two boxes cannot be of one object, or the registration went astray
#: Units of a logarithm, and grey levels that keep it finite.
_UNITS: Final = 40.0
_DARK: Final = (9.0, 12.0)  # larger: less noise of dark pixels, and less of their contrast
#: Smallest number of common pixels for a comparison.
_FEWEST: Final = 60


@dataclass(frozen=True, eq=False)
class Pixels:
    """A view, prepared.

    Attributes
    ----------
    colours : float32 array (64, 64, 3)
        Logarithms of the brightness and of two ratios of the colours.
    mask : uint8 array (64, 64)
        Share of each pixel that belongs to the object, 0..255.
    alone : float32 array (32, 32)
        The logarithm of the brightness at half the size, with its mean instead of the background.
    """

    colours: Map
    mask: Mask
    alone: Map

    @classmethod
    def of(cls, view: LocalView) -> "Pixels":
        """Prepare a view."""
        crop, mask = view.resized(FIT_PX)
        levels = crop.astype(np.float32)
        brightness = np.log(levels.mean(axis=2) + _DARK[0])
        blue, green, red = cv2.split(np.log(levels + _DARK[1]))
        colours = _UNITS * np.dstack([brightness, red - green, blue - (green + red) / 2])
        inside = mask > 127
        alone = colours[:, :, 0].copy()
        if inside.any():
            alone[~inside] = alone[inside].mean()
        half = cv2.resize(alone, (FIT_PX // 2, FIT_PX // 2), interpolation=cv2.INTER_AREA)
        return cls(colours.astype(np.float32), mask, np.asarray(half, np.float32))


class PixelFit(NamedTuple):
    """The fit of the leading candidates of a search to its views, at most 1.

    Attributes
    ----------
    object_index : int
        The leader, after the comparison, as an index of the views' names.
    own, second : float
        Mean fit of the leader, and of the other one of the two likeliest candidates; 0 without one.
    others : float
        The best mean fit of the next candidates that are no near twins of the leader; 0 without one.
    expected : float
        Mean fit of the two enrolled views of the leader beside each view to each other.
    """

    object_index: int
    own: float
    second: float
    others: float
    expected: float


def fit(view: Pixels, enrolled: Pixels) -> float:
    """Return the share of contrast that an enrolled view explains, at most 1; 0 if the two have no common pixels."""
    begin = _begin(view, enrolled)
    found = _fit_map(view, enrolled, begin)
    return max(_explained(view, enrolled, move) for move in ([begin] if found is None else [begin, found]))


def _explained(view: Pixels, enrolled: Pixels, move: Map) -> float:
    """Return the share of contrast that an enrolled view explains when it is moved."""
    size, flags = (FIT_PX, FIT_PX), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpAffine(enrolled.colours, move, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    inside = (cv2.warpAffine(enrolled.mask, move, size, flags=flags) > 127).astype(np.uint8)
    common = cv2.erode(inside, np.ones((3, 3), np.uint8)) > 0
    if int(common.sum()) < _FEWEST:
        return 0.0
    a, b = view.colours[common], moved[common]
    apart = a - b
    contrast = float(np.abs(a - np.median(a, axis=0)).sum() + np.abs(b - np.median(b, axis=0)).sum())
    return 1 - float(np.abs(apart - np.median(apart, axis=0)).sum()) / max(contrast, 1e-6)


def _fit_map(view: Pixels, enrolled: Pixels, begin: Map) -> Map | None:
    """Return the affine map, (2, 3), from pixels of a view to those of an enrolled view; None if none is found."""
    inside = cv2.erode((enrolled.mask > 127).astype(np.uint8), np.ones((3, 3), np.uint8))
    here, there = (np.ascontiguousarray(one.colours[:, :, 0]) for one in (view, enrolled))
    move = affine_map(here, there, begin, inside, _FIT_CRITERIA, 3)
    if move is None:
        return None
    area = float(np.linalg.det(move[:, :2]))
    plausible = _AREAS[0] < area < _AREAS[1] and float(np.abs(move[:, :2] - np.eye(2)).max()) < _MOST_SHEAR
    return move if plausible else None


def _begin(view: Pixels, enrolled: Pixels) -> Map:
    """Return the map with the highest correlation among some scales and all moves, at half the size."""
    wide = cv2.copyMakeBorder(view.colours[:, :, 0], *(_FIT_REACH_PX,) * 4, cv2.BORDER_REPLICATE)
    half = cv2.resize(wide, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    side = enrolled.alone.shape[0]
    found: list[tuple[float, tuple[float, float, float, float]]] = []
    middle = (side - 1) / 2
    for across, down in _SCALES:
        scaled = np.array([[across, 0, (1 - across) * middle], [0, down, (1 - down) * middle]])
        part = cv2.warpAffine(enrolled.alone, scaled, (side, side), borderMode=cv2.BORDER_REPLICATE)
        _, similar, _, (x, y) = cv2.minMaxLoc(cv2.matchTemplate(half, part, cv2.TM_CCOEFF_NORMED))
        away = x - _FIT_REACH_PX / 2, y - _FIT_REACH_PX / 2
        similar -= _SCALE_COST * ((across != 1) + (down != 1)) + _PIXEL_COST * (abs(away[0]) + abs(away[1]))
        found.append((similar, (across, down, 2 * away[0], 2 * away[1])))
    across, down, x_px, y_px = max(found)[1]
    middle = (FIT_PX - 1) / 2
    forward = np.array([[across, 0, (1 - across) * middle + x_px], [0, down, (1 - down) * middle + y_px], [0, 0, 1]])
    return np.linalg.inv(forward)[:2].astype(np.float32)
