"""The comparison of the two leaders of a search that does not end with one object, pixel by pixel.

Decision: docs/decisions/0057.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hbr.core.angles import wrap360
from hbr.core.arrays import FloatArray
from hbr.dense.enrolled_views import Asking, NeedEnrolledViews, Queries
from hbr.dense.filter import Belief
from hbr.dense.local_difference import NEAREST, LocalDecision, LocalView, chosen_views, compare_objects, poses_of
from hbr.dense.stopping import Outcome, StopDecision, StopReason

#: Share of the probability that the two leaders have together.
LEADERS: Final = 0.9
#: Near twins score nearly the same: with a larger margin, an unknown object is not compared with the two leaders.
TWIN_MARGIN: Final = 0.02


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
    max_error : float
        Largest probability that a decision is wrong.
    """

    leaders: tuple[int, int]
    compared: tuple[int, ...]
    views: tuple[Sequence[LocalView], Sequence[LocalView]]
    found: LocalDecision
    outcome: Outcome
    winner: int | None
    max_error: float

    def decided(self, decision: StopDecision) -> StopDecision:
        """Return the decision that replaces the given one; its probability is that of the comparison."""
        if self.winner is None:
            changed = self.outcome is not decision.outcome
            return replace(decision, outcome=self.outcome, reason=StopReason.LOCAL_DIFFERENCE) if changed else decision
        return replace(
            decision,
            outcome=Outcome.FOUND,
            reason=StopReason.LOCAL_DIFFERENCE,
            object_index=self.winner,
            probability=1.0 - self.found.error_bound,
            min_confidence=1.0 - self.max_error,
        )


def compare_leaders(
    belief: Belief, outcome: Outcome, queries: Queries, *, beta: float, max_error: float
) -> Asking[LeaderComparison | None]:
    """Compare the two leaders of a search that is ambiguous, or that calls near twins unknown; None if it has no two.

    If two near twins are enrolled, the leading one has a small margin, and the open-set score is low. Therefore an
    object that fits one of them up to noise is not unknown.

    Parameters
    ----------
    belief
        After the last view.
    outcome
        Outcome with which the search would end.
    queries
        The views of the search.
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
    orientations_deg = belief.orientation_deg.tolist()
    compared = chosen_views(orientations_deg)
    rotations_deg = [tuple(deg - orientations_deg[-1] for deg in poses_of(belief, one)) for one in (first, second)]
    enrolled = []
    for leader, rotations in zip((first, second), rotations_deg, strict=True):
        near_deg = [float(wrap360(orientations_deg[n] + added_deg)) for added_deg in rotations for n in compared]
        views = yield NeedEnrolledViews(leader, tuple(near_deg))
        if views is None:
            return None
        enrolled.append(views)
    if min(map(len, enrolled)) <= NEAREST:
        return None
    both = enrolled[0], enrolled[1]
    likeliest = [queries(n)[0] for n in compared]
    found = compare_objects(likeliest, both, (rotations_deg[0], rotations_deg[1]), max_error=max_error)
    winner: int | None = None
    if outcome is Outcome.AMBIGUOUS or (found.fits and found.twins):
        if found.winner is not None:
            outcome, winner = Outcome.FOUND, (first, second)[found.winner]
        else:
            outcome = Outcome.AMBIGUOUS
    return LeaderComparison((first, second), tuple(compared), both, found, outcome, winner, max_error)


def _margin(scores: FloatArray, probability: FloatArray) -> float:
    """Return by how much the score of the likeliest object exceeds all others."""
    best = int(np.lexsort((-scores, -probability))[0])
    return float(scores[best] - np.delete(scores, best).max(initial=0.0))
