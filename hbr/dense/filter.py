"""The dense Hough filter: it adds up the support of all views so far for every object at every azimuth.

The paper's voting (`hbr.retrieve`) follows the few views on its lists. This filter has a score for every hypothesis
(j, φ): object j with azimuth φ at the first query, to which each query adds what `hbr.dense.index` says.

Decision: docs/decisions/0014.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from hbr.core.angles import wrap180
from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.dense.index import POWER, DenseIndex, Floats
from hbr.descriptors import descriptor

#: As for `Belief.posterior`: fits the similarities of the bench's own descriptor.
# with the first power of similarities, fewer objects are found; another descriptor needs its own value (decision 0014)
BETA: Final = 30.0
#: Number of objects that are considered after the first view.
KEPT: Final = 500  # more: each view takes longer; fewer: the bound adds objects again more often (decision 0010)
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
        return DenseRanking(self.index.object_index[order], scores[order])

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
    """

    object_index: IndexArray
    scores: FloatArray


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
