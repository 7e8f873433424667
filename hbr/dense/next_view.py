"""The next best view: the rotation after which the strongest hypotheses of the belief are least similar.

Decision: docs/decisions/0014.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.angles import size_deg, wrap360
from hbr.core.arrays import FloatArray, IndexArray
from hbr.dense.filter import Belief
from hbr.dense.index import BINS

#: λ: how reliably a view separates two objects that look different.
# chosen together with `_NEAR_DEG` and the cost of a second; no rate changes much with them (decision 0014)
SHARPNESS: Final = 50.0
#: Largest number of compared hypotheses, and the share of the belief that is not compared.
# 60, or one for each peak, are worse: the bins of one arc represent what is unknown (decision 0014)
_STRONGEST: Final = 16
_NEGLIGIBLE: Final = 1e-3  # smaller: more hypotheses are compared, which can hardly change the choice
#: Most weight of an object that is not enrolled, relative to all enrolled ones.
_MOST_ODDS: Final = 1.0  # more: the enrolled candidates are separated later
#: Distance in degrees up to which a view near an earlier one adds little.
_NEAR_DEG: Final = 15.0
#: Rotations in steps of 5 degrees, the shorter way round.
ALL_ROTATIONS_DEG: Final = np.delete(np.arange(-BINS // 2 + 1.0, BINS // 2 + 1), BINS // 2 - 1) * (360 / BINS)
ALL_ROTATIONS_DEG.flags.writeable = False


Hypotheses = tuple[FloatArray, IndexArray, IndexArray]
"""Probability, place of the object and bin of each hypothesis, (m,)."""


@dataclass(frozen=True, eq=False)
class NextBestView:
    """A rotation, or an arc of a search in motion, and the numbers of the decision for it."""

    rotation_deg: float
    """Rotation of the camera around the object, counter-clockwise."""
    orientation_deg: float
    """The orientation after it, from the zero of the queries' orientations, in [0, 360)."""
    pair: tuple[int, int] | None
    """(int, int) or None: the two objects that it separates most: index of each in the views' names, the likelier
    first. None if the strongest hypotheses are all of one object."""
    rotations_deg: FloatArray
    confusion: FloatArray
    cost: FloatArray
    """float64 arrays (a,): all rotations that were weighed; the logarithm of the probability that two objects are still
    confused after each; the cost of the motion, in the same unit."""
    similarity: FloatArray | None
    """float64 array (a,), or None: similarity of the pair's views after each rotation; None if there is no pair, and
    for an arc."""


def next_best_view(
    belief: Belief,
    *,
    rotations_deg: ArrayLike | None = None,
    seconds: ArrayLike | None = None,
    not_enrolled: float = 0.0,
) -> NextBestView:
    """Choose the rotation with the lowest sum of expected confusion and cost.

    For hypotheses p, p' of different objects, a rotation a leaves the confusion
    Σ p p' exp(-λ ν(a) √(κ(a) κ'(a)) (1 - T(view(a), view'(a)))), where ν(a) = 1 - exp(-½ (d / 15°)²) discounts a view
    at the distance d from the nearest earlier one, and κ(a) = exp(-½ (e / 15°)²) one at the distance e from the nearest
    enrolled view, because nothing is known about the views between. The object may also be one that is not enrolled.
    The sum has a pair of the leader and this one, by its odds, as if it looked from all sides like the leader's views
    at the earlier queries. The logarithm of the confusion and the time in seconds are added up; of equal sums, the
    earlier rotation is chosen.

    Parameters
    ----------
    belief : Belief
        After at least one query.
    rotations_deg : array (a,), optional
        Possible rotations, e.g. within the cable budget; by default every 5 degrees, the shorter way round.
    seconds : array (a,), optional
        Time of each by the bench's motion model; by default at 90 degrees per second.
    not_enrolled : float
        Probability that the object is not enrolled.

    Raises
    ------
    ValueError
        There is no rotation to choose from, or the number of times is another one.
    """
    angles_deg = ALL_ROTATIONS_DEG
    if rotations_deg is not None:
        angles_deg = np.asarray(rotations_deg, np.float64)
        if angles_deg.ndim != 1 or not len(angles_deg) or not np.isfinite(angles_deg).all():
            raise ValueError(
                f"rotations_deg is {angles_deg}; at least one finite rotation is needed, check the cable's limits"
            )
    cost = np.abs(angles_deg) / 90
    if seconds is not None:
        cost = np.asarray(seconds, np.float64)
        if cost.shape != angles_deg.shape or not np.isfinite(cost).all():
            raise ValueError(
                f"{len(angles_deg)} rotations and times of shape {cost.shape}; one finite time each is needed"
            )

    # Weigh each rotation: expected confusion plus cost.
    here_deg = float(belief.orientation_deg[-1])
    landing_deg = here_deg + angles_deg
    apart_deg = size_deg(landing_deg[:, None] - belief.orientation_deg).min(axis=1)
    novelty = 1 - np.exp(-0.5 * (apart_deg / _NEAR_DEG) ** 2)
    hypotheses = strongest(belief.posterior)
    pairs = pairs_after(belief, angles_deg, hypotheses)
    remaining = pairs.probability * np.exp(-SHARPNESS * (novelty[:, None] * pairs.known) * (1 - pairs.similar))
    confusion = 2 * remaining.sum(axis=1)
    odds = min(not_enrolled / max(1 - not_enrolled, _NEGLIGIBLE), _MOST_ODDS)
    if odds > _NEGLIGIBLE:
        confusion += odds * _with_what_was_seen(belief, angles_deg, novelty, hypotheses)
    # one enrolled object alone: a new side helps to find its azimuth
    confusion = log_confusion(confusion) if confusion.any() else -SHARPNESS * novelty
    # Choose the best one, and name the pair that it separates most.
    chosen = int((confusion + cost).argmin())
    pair: tuple[int, int] | None = None
    similarity: FloatArray | None = None
    if len(pairs.probability):
        most = int((pairs.probability - remaining[chosen]).argmax())
        pair, similarity = pairs.named(most), pairs.similar[:, most]
    rotation_deg = float(angles_deg[chosen])
    return NextBestView(rotation_deg, wrap360(here_deg + rotation_deg), pair, angles_deg, confusion, cost, similarity)


def _with_what_was_seen(
    belief: Belief, rotations_deg: FloatArray, novelty: FloatArray, hypotheses: Hypotheses
) -> FloatArray:
    """Return the confusion of the leader, (a,), with an object that looks like its views at the earlier queries."""
    own = hypotheses[1] == hypotheses[1][0]
    probability, place, bin_of = (part[own] for part in hypotheses)
    rows, away_deg = expected_views(belief, place, bin_of, rotations_deg)
    seen, _ = expected_views(belief, place, bin_of, belief.orientation_deg - belief.orientation_deg[-1])
    known = np.exp(-0.5 * (away_deg / _NEAR_DEG) ** 2)
    vectors, largest = belief.index.vectors, belief.index.space.largest.sum()
    similar = (vectors[rows.T] @ vectors[seen.T].transpose(0, 2, 1)).max(axis=2).T / largest
    confusion: FloatArray = np.exp(-SHARPNESS * novelty[:, None] * known * (1 - similar)) @ probability
    return confusion


class Pairs(NamedTuple):
    """The pairs of strong hypotheses of different objects, and what their views show after some rotations."""

    objects: IndexArray
    """integer array (2, p): index of both objects of each pair in the views' names, the likelier hypothesis first."""
    probability: FloatArray
    """float64 array (p,): product of their probabilities."""
    similar: FloatArray
    """float64 array (a, p): similarity of their views after each rotation."""
    known: FloatArray
    """float64 array (a, p): √(κ κ'), 0..1: to which share their views are known (`next_best_view`)."""

    def named(self, place: int) -> tuple[int, int]:
        """Return the two objects of the pair at this place."""
        return int(self.objects[0, place]), int(self.objects[1, place])


def pairs_after(belief: Belief, rotations_deg: FloatArray, hypotheses: Hypotheses) -> Pairs:
    """Return the pairs of strong hypotheses, after each of some rotations, float64 (a,)."""
    probability, place, bin_of = hypotheses
    first, second = _all_pairs(len(place))
    different = place[first] != place[second]
    first, second = first[different], second[different]
    rows, away_deg = expected_views(belief, place, bin_of, rotations_deg)
    known = np.exp(-0.5 * (away_deg / _NEAR_DEG) ** 2)
    similar = belief.index.among(rows)[:, first, second]
    return Pairs(
        belief.index.object_index[place[np.stack([first, second])]],
        probability[first] * probability[second],
        similar,
        np.sqrt(known[:, first] * known[:, second]),
    )


def log_confusion(confusion: FloatArray) -> FloatArray:
    """Return the logarithm of the probability of a confusion, (a,); also of 0."""
    logarithm: FloatArray = np.log(np.maximum(confusion, 1e-300))
    return logarithm


@lru_cache(maxsize=_STRONGEST)
def _all_pairs(count: int) -> tuple[IndexArray, IndexArray]:
    """Return two of ``count`` each; pairs with the same first one follow each other, as the comparison needs them."""
    return np.triu_indices(count, 1)


def strongest(posterior: FloatArray) -> Hypotheses:
    """Return the probability, the place of the object and the bin of the strongest hypotheses, the strongest first.

    Each of them is a peak of its object's probability; it represents the slopes beside it.
    """
    weight = _peak_weights(posterior).ravel()
    count = min(_STRONGEST, len(weight))
    # Near twins have equal weights up to the last digit, which depends on where arrays lie in the memory. So weights
    # are compared in single precision, and of equal ones the first counts.
    rank = weight.astype(np.float32)
    best = np.flatnonzero(rank >= np.partition(rank, -count)[-count])
    best = best[np.argsort(-rank[best], kind="stable")][:count]
    weight = weight[best]
    place, bin_of = np.divmod(best, posterior.shape[1])
    second = int((place != place[0]).argmax())  # a decision needs two objects, even if the second one is unlikely
    enough = max(1 + int(np.searchsorted(np.cumsum(weight), 1 - _NEGLIGIBLE)), second + 1)
    return weight[:enough], place[:enough], bin_of[:enough]


def _peak_weights(posterior: FloatArray) -> FloatArray:
    around = np.concatenate([posterior[:, -1:], posterior, posterior[:, :1]], axis=1)
    peaks = posterior * ((posterior >= around[:, :-2]) & (posterior >= around[:, 2:]))
    mass, total = posterior.sum(axis=1), peaks.sum(axis=1)
    share: FloatArray = np.divide(mass, total, out=np.zeros_like(mass), where=total > 0)
    return peaks * share[:, None]


def expected_views(
    belief: Belief, place: IndexArray, bin_of: IndexArray, angles_deg: FloatArray
) -> tuple[IndexArray, FloatArray]:
    """Return the enrolled view that each hypothesis expects after each rotation, (a, m), and its distance."""
    seen_deg = bin_of * (360.0 / BINS) + belief.rotated_deg + angles_deg[:, None]
    return belief.index.nearest_view(place, seen_deg)
