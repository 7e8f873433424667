"""The last step of a search that does not end with one object: its two leaders, compared pixel by pixel.

The bench, its replay and `rig eval` take this step in the same way.

Decision: docs/decisions/0057.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.angles import wrap180, wrap360
from hbr.core.arrays import FloatArray, IndexArray
from hbr.dense.filter import Belief
from hbr.dense.local_difference import NEAREST, LocalDecision, LocalView, chosen_views, compare_objects, poses_of
from hbr.dense.stopping import Outcome

#: Share of the probability that the two leaders have together.
LEADERS: Final = 0.9
#: Near twins score nearly the same: with a larger margin, an unknown object is not compared with the two leaders.
TWIN_MARGIN: Final = 0.02

LeaderViews = Callable[[int, Sequence[float]], Sequence[LocalView]]
"""Returns the enrolled views of an object, by its index in the views' names, near some azimuths."""


def near(own_deg: ArrayLike, azimuths_deg: Sequence[float]) -> IndexArray:
    """Return the indices of the views, at ``own_deg`` (n,), that a comparison near some azimuths needs, by azimuth.

    There is one more than `NEAREST` for each azimuth, because the comparison leaves one out.
    """
    own_deg = np.asarray(own_deg, np.float64)
    away_deg = np.abs(wrap180(own_deg - np.asarray(azimuths_deg)[:, None]))
    wanted = np.unique(np.argsort(away_deg, axis=1, kind="stable")[:, : NEAREST + 1])
    places: IndexArray = wanted[np.argsort(own_deg[wanted], kind="stable")]
    return places


@dataclass(frozen=True, eq=False)
class LeaderComparison:
    """The two leaders of a search, compared.

    Attributes
    ----------
    leaders : (int, int)
        The likelier one first, as indices of the views' names.
    compared : tuple of int
        Which views of the search were compared.
    views : pair of sequences of LocalView
        The enrolled views of both leaders.
    found : LocalDecision
        What the comparison found.
    outcome : Outcome
        Outcome of the search after the comparison.
    winner : int or None
        The leader that was found, as an index of the views' names; None if the comparison names none.
    """

    leaders: tuple[int, int]
    compared: tuple[int, ...]
    views: tuple[Sequence[LocalView], Sequence[LocalView]]
    found: LocalDecision
    outcome: Outcome
    winner: int | None


def compare_leaders(
    belief: Belief,
    outcome: Outcome,
    orientations_deg: Sequence[float],
    view: Callable[[int], LocalView],
    leader_views: LeaderViews,
    *,
    beta: float,
    max_error: float,
) -> LeaderComparison | None:
    """Compare the two leaders of a search that is ambiguous, or that calls near twins unknown; None if it has no two.

    If two near twins are enrolled, the leading one has a small margin, and the open-set score is low. Therefore an
    object that fits one of them up to noise is not unknown.

    Parameters
    ----------
    belief
        After the last view.
    outcome
        Outcome with which the search would end.
    orientations_deg
        Orientation of each view of the search.
    view
        Returns a view of the search.
    leader_views
        Returns enrolled views.
    beta
        As for `Belief.posterior`.
    max_error
        Largest probability that a decision is wrong.
    """
    if outcome not in (Outcome.AMBIGUOUS, Outcome.UNKNOWN):
        return None
    probability = belief.posterior(beta).sum(axis=1)
    if outcome is Outcome.UNKNOWN and _margin(belief.scores(), probability) > TWIN_MARGIN:
        return None
    order = np.argsort(-probability, kind="stable")[:2]
    if len(order) < 2 or float(probability[order].sum()) < LEADERS:
        return None
    first, second = belief.index.object_index[order].tolist()
    compared = chosen_views(orientations_deg)
    rotations_deg = [tuple(deg - orientations_deg[-1] for deg in poses_of(belief, one)) for one in (first, second)]
    near = [
        [float(wrap360(orientations_deg[n] + added_deg)) for added_deg in rotations for n in compared]
        for rotations in rotations_deg
    ]
    views = leader_views(first, near[0]), leader_views(second, near[1])
    if min(map(len, views)) <= NEAREST:
        return None
    queries = [view(n) for n in compared]
    found = compare_objects(queries, views, (rotations_deg[0], rotations_deg[1]), max_error=max_error)
    winner: int | None = None
    if outcome is Outcome.AMBIGUOUS or (found.fits and found.twins):
        if found.winner is not None:
            outcome, winner = Outcome.FOUND, (first, second)[found.winner]
        else:
            outcome = Outcome.AMBIGUOUS
    return LeaderComparison((first, second), tuple(compared), views, found, outcome, winner)


def _margin(scores: FloatArray, probability: FloatArray) -> float:
    """Return by how much the score of the likeliest object exceeds all others."""
    best = int(np.lexsort((-scores, -probability))[0])
    return float(scores[best] - np.delete(scores, best).max(initial=0.0))
