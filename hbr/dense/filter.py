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
from hbr.dense.index import DenseIndex
from hbr.dense.space import Floats
from hbr.descriptors import descriptor

#: β, as for `Belief.posterior`.
BETA: Final = 2.0


@dataclass(frozen=True, eq=False)
class Belief:
    """The support of all views so far for every object at every azimuth."""

    index: DenseIndex
    """The enrolled views of the objects that are still considered."""
    support: Floats
    """float32 array (k, 72): A, the sum of the support that each query adds; for azimuths 0, 5, ... at the first
    query."""
    orientation_deg: FloatArray
    """float64 array (n,): orientations of the camera around the object at the queries, from any zero."""
    weights: FloatArray | None = None
    """float64 array (n,), or None: how much each query counts, 0..1; None: all count fully."""
    vectors: tuple[Floats, ...] = ()
    """tuple of float32 arrays (h, d): the queries in the index's space."""

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
        """Score of every object considered: the mean similarity at the best azimuth, 0..1."""
        scores: FloatArray = np.maximum(self.index.space.similarity(self.support.max(axis=1) / self.amount), 0)
        return scores

    def ranking(self) -> "DenseRanking":
        """Return the objects considered, best first."""
        scores = self.scores()
        order = np.argsort(-self.support.max(axis=1), kind="stable")  # the scores of poor objects are all 0
        return DenseRanking(self.index.object_index[order], scores[order])

    @cached_property
    def posterior(self) -> FloatArray:
        """The probability of every hypothesis among the enrolled objects, (k, 72), read-only.

        It is proportional to exp(β A / √n). The root is there because views of one object are not independent: each
        adds less than the one before. Weights contain that already; with weights there is no root.
        """
        root = np.sqrt(self.queries) if self.weights is None else 1.0
        probability: FloatArray = self.support.astype(np.float64)
        probability *= BETA / root
        probability -= probability.max()
        np.exp(probability, out=probability)
        probability /= probability.sum()
        probability.flags.writeable = False
        return probability

    def probability(self) -> FloatArray:
        """Return the probability of every object considered among them, (k,): the sum over its azimuths."""
        probability: FloatArray = self.posterior.sum(axis=1)
        return probability

    def likeliest(self) -> tuple[int, float]:
        """Return the place in the index of the likeliest object, and its probability."""
        probability = self.probability()
        place = int(probability.argmax())
        return place, float(probability[place])


@dataclass(frozen=True, eq=False)
class DenseRanking:
    """The objects that the filter considers, best first."""

    object_index: IndexArray
    """integer array (k,): equal scores by lower index."""
    scores: FloatArray
    """float64 array (k,): as `Belief.scores`."""


def update_belief(
    query: LevelArray,
    orientation_deg: float,
    so_far: DenseIndex | Belief,
    *,
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
    weight : float, optional
        Weight of the query, 0..1, if it is nearly the same evidence as an earlier one (`hbr.dense.arc`).

    Raises
    ------
    TypeError, ValueError
        The query is no view of the index's descriptor, or the orientation is not finite.
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
    vectors = index.space.vectors(np.atleast_2d(query))
    z = index.z(vectors)
    if not isinstance(so_far, Belief):
        return Belief(index, index.support(z, 0.0), np.array([orientation_deg], np.float64), vectors=(vectors,))
    rotated_deg = float(wrap180(orientation_deg - so_far.orientation_deg[0]))
    added = index.support(z, rotated_deg)
    weights = so_far.weights
    if weight is not None or weights is not None:
        weight = 1.0 if weight is None else weight
        added = added * np.float32(weight)
        weights = np.append(np.ones(so_far.queries) if weights is None else weights, weight)
    orientations_deg = np.append(so_far.orientation_deg, orientation_deg)
    return Belief(index, so_far.support + added, orientations_deg, weights, (*so_far.vectors, vectors))
