"""The dense Hough filter: it adds up the support of all views so far for every object at every azimuth.

The paper's voting (`hbr.retrieve`) follows the few views on its lists. This filter has a score for every hypothesis
(j, φ): object j with azimuth φ at the first query, to which each query adds what `hbr.dense.index` says.

`pose` turns the support of an object's azimuths into a posterior, p(φ) ∝ exp(κ A(φ) / √n). The standard uncertainty is
a half-width of this posterior around the estimated azimuth. Two constants are fitted on objects 1-50 of COIL-100, so
that 68 % and 95 % of the true azimuths lie within one and two standard uncertainties. If the posterior has n equal
parts, the object looks the same every 360° / n. If it is spread over most azimuths, the object looks the same from all
sides. Coverage: docs/results.md; `python -m benchmarks.pose_coverage`.

Decision: docs/decisions/0014.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from hbr.core.angles import wrap180, wrap360
from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.dense.index import BIN_DEG, BINS, POWER, DenseIndex, Floats
from hbr.descriptors import descriptor

#: As for `Belief.posterior`: fits the similarities of the bench's own descriptor.
# with the first power of similarities, fewer objects are found; another descriptor needs its own value (decision 0014)
BETA: Final = 30.0
#: Number of objects that are considered after the first view.
KEPT: Final = 500  # more: each view takes longer; fewer: the bound adds objects again more often (decision 0010)
#: Rate at which a bin's weight in the mean azimuth falls with its support.
_POSE_SHARPNESS: Final = 60.0
#: Largest correction of an azimuth from the bins beside it, in degrees, and smallest fall of the support for it.
_FARTHEST_LEAN_DEG: Final = 90.0
# with a smaller fall on both sides, the azimuth is undetermined, and the quotient would be noise
_LEAST_FALL: Final = 1e-6
#: Largest error of a sum of float32.
_ROUNDING: Final = 1e-6


@dataclass(frozen=True, eq=False)
class Belief:
    """The support of all views so far for every object at every azimuth.

    Attributes
    ----------
    index : DenseIndex
        The enrolled views of the objects that are still considered.
    support : float32 array (k, 72)
        A, the sum of the support that each query adds, at most their number; for azimuths 0, 5, ... at the first query.
    orientation_deg : float64 array (n,)
        Orientations of the camera around the object at the queries, from any zero.
    weights : float64 array (n,), or None
        How much each query counts, 0..1; None: all count fully.
    levels : tuple of uint8 arrays (length,) or (h, length)
        The queries.
    """

    index: DenseIndex
    support: Floats
    orientation_deg: FloatArray
    weights: FloatArray | None = None
    levels: tuple[LevelArray, ...] = ()

    @property
    def queries(self) -> int:
        return len(self.orientation_deg)

    @property
    def amount(self) -> float:
        """The sum of the queries' weights; their number if all count fully."""
        return float(self.queries if self.weights is None else self.weights.sum())

    @property
    def rotated_deg(self) -> float:
        """Orientation of the last query, from the first."""
        return float(self.orientation_deg[-1] - self.orientation_deg[0])

    def scores(self) -> FloatArray:
        """Score of every object considered: the power mean of the similarities at the best azimuth, 0..1."""
        mean = self.support.max(axis=1).astype(np.float64) / self.amount
        scores: FloatArray = np.maximum(mean, 0) ** (1 / POWER)
        return scores

    def ranking(self) -> "DenseRanking":
        """Return the objects considered, best first."""
        scores = self.scores()
        order = np.argsort(-scores, kind="stable")
        azimuth_deg = self._azimuth_deg(order) + self.rotated_deg
        return DenseRanking(self.index.object_index[order], scores[order], wrap360(azimuth_deg))

    def _azimuth_deg(self, which: IndexArray) -> FloatArray:
        """Return the azimuth at the first query of these objects, finer than the bins and than the enrolled views.

        In the dead zone around an enrolled view all bins are equal. The first estimate is their middle, the mean
        weighted by the support. The second estimate compares the support one step to either side, and assumes that it
        falls off evenly on both sides of the true azimuth.
        """
        support = self.support[which].astype(np.float64)
        best = support.argmax(axis=1)
        step = np.minimum(self.index.spacing_deg[which], _FARTHEST_LEAN_DEG) / BIN_DEG
        reach = np.maximum(1, np.rint(1.25 * self.index.spacing_deg[which] / BIN_DEG)).astype(int)
        offset = np.arange(-BINS // 2, BINS // 2)
        near = np.take_along_axis(support, (best[:, None] + offset) % BINS, axis=1)
        weight = np.exp(_POSE_SHARPNESS * (near - near.max(axis=1, keepdims=True)))
        weight *= np.abs(offset) <= reach[:, None]
        middle = best + (weight * offset).sum(axis=1) / weight.sum(axis=1)
        before, here, behind = (_between(support, middle + side * step) for side in (-1, 0, 1))
        fall = here - np.minimum(before, behind)
        lean = np.divide(behind - before, fall, out=np.zeros_like(fall), where=fall > _LEAST_FALL)
        azimuth_deg: FloatArray = (middle + np.clip(lean, -1, 1) * step / 2) * BIN_DEG
        return azimuth_deg

    def posterior(self, beta: float = BETA) -> FloatArray:
        """Return the probability of every hypothesis, (k, 72), read-only: proportional to exp(β A / √n).

        The root is there because views of one object are not independent: each adds less than the one before. Weights
        contain that already; with weights there is no root.
        """
        if beta not in self._posteriors:  # the stopping rule and the next view use the same one
            root = np.sqrt(self.queries) if self.weights is None else 1.0
            probability: FloatArray = self.support.astype(np.float64)
            probability *= beta / root
            probability -= probability.max()
            np.exp(probability, out=probability)
            probability /= probability.sum()
            probability.flags.writeable = False
            self._posteriors[beta] = probability
        return self._posteriors[beta]

    def probability(self, beta: float = BETA) -> FloatArray:
        """Return the probability of every object considered, (k,): the sum over its azimuths."""
        probability: FloatArray = self.posterior(beta).sum(axis=1)
        return probability

    def likeliest(self, beta: float = BETA) -> tuple[int, float]:
        """Return the place in the index of the likeliest object, and its probability."""
        probability = self.probability(beta)
        place = int(probability.argmax())
        return place, float(probability[place])

    @cached_property
    def _posteriors(self) -> dict[float, FloatArray]:
        return {}


@dataclass(frozen=True, eq=False)
class DenseRanking:
    """The objects that the filter considers, best first.

    Attributes
    ----------
    object_index : integer array (k,)
        Equal scores by lower index.
    scores : float64 array (k,)
        As `Belief.scores`.
    pose_deg : float64 array (k,)
        Orientation of the camera around each object at the last query, in [0, 360).
    """

    object_index: IndexArray
    scores: FloatArray
    pose_deg: FloatArray


def update_belief(
    query: LevelArray,
    orientation_deg: float,
    so_far: DenseIndex | Belief,
    *,
    kept: int = KEPT,
    weight: float | None = None,
) -> Belief:
    """Add a query to the belief.

    Parameters
    ----------
    query : uint8 array (length,) or (h, length)
        The view, described like the enrolled views; a row for each of several segmentations, of which the most similar
        one counts.
    orientation_deg : float
        Orientation of the camera around the object, counter-clockwise, from any zero that all queries share.
    so_far : DenseIndex or Belief
        The enrolled views for the first query, the belief so far for any other.
    kept : int
        Objects that are considered further after the first query: those with the most similar views.
    weight : float, optional
        Weight of the query, 0..1, if it is nearly the same evidence as an earlier one (`hbr.dense.arc`).

    Raises
    ------
    TypeError, ValueError
        The query is no view of the index's descriptor, the orientation is not finite, or `kept` is below 1.
    """
    index = so_far.index if isinstance(so_far, Belief) else so_far
    query = np.asarray(query)
    length = descriptor(index.views.descriptor).length
    if query.dtype != np.uint8 or query.ndim not in (1, 2) or query.shape[-1] != length or not query.size:
        raise ValueError(
            f"the query is {query.dtype} of shape {query.shape}; {index.views.descriptor} has uint8 of ({length},)"
        )
    if not np.isfinite(orientation_deg):
        raise ValueError(f"orientation_deg is {orientation_deg}; a finite angle is needed")
    if kept < 1:
        raise ValueError(f"kept is {kept}; at least 1 object is needed")
    if isinstance(so_far, Belief):
        similar = index.similarity(query)
        rotated_deg = float(wrap180(orientation_deg - so_far.orientation_deg[0]))
        added = index.support(similar, rotated_deg)
        weights = so_far.weights
        if weight is not None or weights is not None:
            weight = 1.0 if weight is None else weight
            added = added * np.float32(weight)
            weights = np.append(np.ones(so_far.queries) if weights is None else weights, weight)
        support = so_far.support + added
        return Belief(
            index, support, np.append(so_far.orientation_deg, orientation_deg), weights, (*so_far.levels, query)
        )
    if len(index) > kept:
        index = index.only(index.nearest(query, kept))
    similar = index.similarity(query)
    return Belief(index, index.support(similar, 0.0), np.array([orientation_deg], np.float64), levels=(query,))


def completed(belief: Belief, index: DenseIndex) -> Belief:
    """Return a belief with all objects that can be first or second, as if they had been considered from the start.

    The support of an object is at most the sum of the largest similarities of its views. Objects that were left out
    after the first query, and whose sum reaches the support of the second object considered, are added. The index has
    all objects.
    """
    kept = np.searchsorted(index.object_index, belief.index.object_index)
    best = belief.support.max(axis=1)
    second = float(np.partition(best, -2)[-2]) if len(best) > 1 else -np.inf
    bounds = np.sum([index.bounds(query) for query in belief.levels], axis=0)
    bounds[kept] = np.inf
    places = np.flatnonzero(bounds >= second - _ROUNDING * belief.queries)
    if len(places) == len(kept):
        return belief
    more: DenseIndex | Belief = index.only(places)
    weights = [None] * belief.queries if belief.weights is None else belief.weights.tolist()
    for query, orientation_deg, weight in zip(belief.levels, belief.orientation_deg.tolist(), weights, strict=True):
        more = update_belief(query, orientation_deg, more, kept=len(places), weight=weight)
    assert isinstance(more, Belief)
    return more


def _between(support: FloatArray, bins: FloatArray) -> FloatArray:
    """Return the support of each object, a row, at its place between two bins."""
    rows, low = np.arange(len(support)), np.floor(bins)
    share = bins - low
    at = low.astype(int)
    value: FloatArray = support[rows, at % BINS] * (1 - share) + support[rows, (at + 1) % BINS] * share
    return value


#: κ, and the uncertainty as a share of the posterior's half-width, because azimuths are estimated finer than its bins.
# with these two, about 68 % of the true rotations of COIL-100 are within one uncertainty (docs/results.md)
SHARPNESS: Final = 120.0
WIDTH: Final = 0.68
#: A pose with a larger uncertainty is not determined.
# larger: a rotation is stated that an operator cannot use; smaller: fewer answers have one
LARGEST_SIGMA_DEG: Final = 30.0
#: The largest uncertainty with an n-fold symmetry, as a share of the period.
_LARGEST_SHARE: Final = 1 / 9
#: Each equivalent pose has at least this share of the probability of an equal one.
_LEAST_PART: Final = 0.25
#: An object looks the same from all sides if the likeliest azimuths, 95 % together, are at least this share of all.
_FREE_SHARE: Final = 0.5  # a symmetry of two, three or more parts leaves most azimuths unlikely
#: Poses of an object that a comparison tries: those of at least this probability, relative to the likeliest one.
# more poses, or less likely ones: the right one is missed less often; each is registered again, which takes time
_MOST_POSES: Final = 3
_LEAST_POSE: Final = 0.02
_POSES_APART_DEG: Final = 25.0
_ORDERS: Final = range(2, 13)  # up to 30°, five bins: with finer symmetries the bins hardly separate two maxima
_ONE_SIGMA, _TWO_SIGMA = 0.683, 0.954


@dataclass(frozen=True, slots=True)
class Pose:
    """Orientation of the camera around an object at the last query, if the views determine it.

    Attributes
    ----------
    azimuth_deg : tuple of float
        All azimuths that are equally likely, the estimated one first: one without symmetry, n if the object looks the
        same every 360° / n, none if no azimuth is determined.
    sigma_deg : float, optional
        Standard uncertainty of each; None if no azimuth is determined.
    period_deg : float, optional
        360 without symmetry, 360 / n, 0 if the object looks the same from all sides; None if that is not known.
    """

    azimuth_deg: tuple[float, ...]
    sigma_deg: float | None
    period_deg: float | None


def pose(belief: Belief, object_index: int) -> Pose:
    """Return the pose of an object that the filter considers."""
    azimuth_deg, p = _likely_azimuths(belief, object_index)
    return pose_of(p / p.sum(), azimuth_deg, azimuth_deg - belief.rotated_deg)


def poses_of(belief: Belief, object_index: int) -> tuple[float, ...]:
    """Return the likely azimuths of an object at the last view, the likeliest first; symmetric objects have several."""
    best_deg, likely = _likely_azimuths(belief, object_index)
    found = [best_deg]
    for place in np.argsort(-likely, kind="stable").tolist():
        azimuth_deg = float(wrap360(place * BIN_DEG + belief.rotated_deg))
        if likely[place] < _LEAST_POSE or len(found) == _MOST_POSES:
            break
        if min(abs(wrap180(azimuth_deg - one)) for one in found) >= _POSES_APART_DEG:
            found.append(azimuth_deg)
    return tuple(found)


def _likely_azimuths(belief: Belief, object_index: int) -> tuple[float, FloatArray]:
    """Return an object's estimated azimuth at the last query, and how likely those at the first one are, (72,)."""
    ranking = belief.ranking()
    (support,) = belief.support[belief.index.object_index == object_index].astype(np.float64)
    p: FloatArray = np.exp(SHARPNESS * (support - support.max()) / np.sqrt(belief.queries))
    return float(ranking.pose_deg[ranking.object_index == object_index][0]), p


def pose_of(posterior: FloatArray, azimuth_deg: float, estimate_deg: float) -> Pose:
    """Return the pose by the posterior of one object's azimuths, float64 (72,), at the first query.

    The estimated azimuth is ``azimuth_deg`` at the last query, and ``estimate_deg`` at the first one.
    """
    away_deg: FloatArray = np.arange(BINS, dtype=np.float64) * BIN_DEG - estimate_deg
    sigma_deg = _sigma_deg(posterior, away_deg, 360.0)
    if sigma_deg <= LARGEST_SIGMA_DEG:
        return Pose((azimuth_deg,), sigma_deg, 360.0)
    ordered = np.cumsum(-np.sort(-posterior))
    if np.searchsorted(ordered, _TWO_SIGMA) >= _FREE_SHARE * BINS:
        return Pose((), None, 0.0)
    for order in _ORDERS:
        period_deg = 360 / order
        sigma_deg = _sigma_deg(posterior, away_deg, period_deg)
        part = np.rint(away_deg / period_deg).astype(int) % order
        least = np.bincount(part, posterior, order).min()
        if sigma_deg <= _LARGEST_SHARE * period_deg and least >= _LEAST_PART / order:
            poses = tuple(wrap360(azimuth_deg + k * period_deg) for k in range(order))
            return Pose(poses, sigma_deg, period_deg)
    return Pose((), None, None)


def _sigma_deg(posterior: FloatArray, away_deg: FloatArray, period_deg: float) -> float:
    """Return the uncertainty: 68 % of the posterior is within its half-width, 95 % within twice as much."""
    away_deg = np.abs((away_deg + period_deg / 2) % period_deg - period_deg / 2)
    order = np.argsort(away_deg, kind="stable")
    share = np.cumsum(posterior[order])
    one, two = np.interp([_ONE_SIGMA, _TWO_SIGMA], share, away_deg[order])
    return float(WIDTH * max(one, two / 2))
