"""The last steps of a search: comparisons of its views with enrolled ones, pixel by pixel.

A search asks for enrolled views (`NeedEnrolledViews`); its driver brings them. There are two steps:

- `verify`, for a doubtful leader. The open-set score compares descriptors of 8 x 8 cells. An unknown object may
  resemble an enrolled one at this coarse scale, although its details do not fit. For each view, the enrolled views at
  the estimated pose are registered to it. The fit is the share of the view's contrast that they explain, in colours
  that light hardly changes (`hbr.dense.pixel_fit`). The fit of the leader, and its difference from the fit of the next
  candidates, are added to the open-set score with weights.
- `compare_leaders`, for the two leaders of a search that does not end with one object (`hbr.dense.local_difference`).

Decisions: docs/decisions/0057, docs/decisions/0059, docs/decisions/0060.
"""

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.angles import size_deg, wrap180, wrap360
from hbr.core.arrays import FloatArray, IndexArray
from hbr.dense.filter import Belief
from hbr.dense.local_difference import NEAREST, LocalDecision, LocalView, chosen_views, compare_objects
from hbr.dense.open_set import fitted_before
from hbr.dense.pixel_fit import Pixels, fit
from hbr.dense.pose import poses_of
from hbr.dense.stopping import Outcome, StopDecision, StoppingRule, StopReason
from hbr.descriptors import descriptor

#: Numbers of compared candidates beside the leader, and of segmentations of each view.
_OTHERS: Final = 3
_SEGMENTATIONS: Final = 2
#: Weights of the open-set score, of the leader's fit, and of its difference from that of other candidates; an offset.
#: Fitted like `hbr.dense.open_set.fitted_before`: the result is a log-odds.
_WEIGHTS: Final = (0.714, 9.438, 4.995)
_OFFSET: Final = -5.416
#: Log-odds from which an object is found, and below which it is unknown: that of 1 in 100 enrolled objects.
FOUND_FROM: Final = 0.0
#: Log-odds from which an object is found on the bench of the enrollment, where an enrolled object fits much better. In
#: searches for objects 1–50 after a mild change, enrolled objects reach 5.6 or more, left-out objects 1.1 or less.
FOUND_FROM_SAME_BENCH: Final = 3.0
UNKNOWN_BELOW: Final = -1.3
#: With a smaller open-set score, an object is unknown at any fit.
_HOPELESS: Final = -7.0
#: Share of the probability that the two leaders have together.
LEADERS: Final = 0.9
#: Near twins score nearly the same: with a larger margin, an unknown object is not compared with the two leaders.
TWIN_MARGIN: Final = 0.02

_Result = TypeVar("_Result")


class NeedEnrolledViews(NamedTuple):
    """A search needs the enrolled views of an object, by its index in the views' names, near some azimuths.

    The answer is None if they cannot be read: the search then ends without them.
    """

    object_index: int
    azimuths_deg: tuple[float, ...]


Asking = Generator[NeedEnrolledViews, Sequence[LocalView] | None, _Result]
"""A step of a search that asks for enrolled views, and returns its result."""
Queries = Callable[[int], Sequence[LocalView]]
"""Returns a view of a search by each of its segmentations, the likeliest first."""


def answered(
    step: Asking[_Result], enrolled: Callable[[int, Sequence[float]], Sequence[LocalView] | None] = lambda *_: None
) -> _Result:
    """Return the result of a step; ``enrolled`` returns the enrolled views of an object near some azimuths."""
    try:
        need = next(step)
        while True:
            need = step.send(enrolled(*need))
    except StopIteration as end:
        result: _Result = end.value
        return result


def near(own_deg: ArrayLike, azimuths_deg: Sequence[float]) -> IndexArray:
    """Return the indices of the views, at ``own_deg`` (n,), that a comparison near some azimuths needs, by azimuth.

    There is one more than `NEAREST` for each azimuth, because the comparison leaves one out.
    """
    own_deg = np.asarray(own_deg, np.float64)
    away_deg = np.abs(wrap180(own_deg - np.asarray(azimuths_deg)[:, None]))
    wanted = np.unique(np.argsort(away_deg, axis=1, kind="stable")[:, : NEAREST + 1])
    places: IndexArray = wanted[np.argsort(own_deg[wanted], kind="stable")]
    return places


@dataclass(frozen=True)
class Verification:
    """Fit of the leader's enrolled views to the views of a search.

    Attributes
    ----------
    object_index : int
        The leader.
    fit, others : float
        Mean fit of the leader and of the next candidates over the views, at most 1.
    """

    object_index: int
    fit: float
    others: float

    def score(self, open_set_score: float) -> float:
        """Return the log-odds that the leader is the object on the table, from the fits and the open-set score."""
        numbers = (open_set_score, self.fit, self.fit - self.others)
        return sum(weight * number for weight, number in zip(_WEIGHTS, numbers, strict=True)) + _OFFSET

    def decided(self, decision: StopDecision, least: float = FOUND_FROM) -> StopDecision:
        """Return the decision that replaces the given one; log-odds of at least ``least`` find the object."""
        score = self.score(decision.open_set_score)
        outcome = Outcome.UNKNOWN if score < UNKNOWN_BELOW else Outcome.AMBIGUOUS
        if score >= least and decision.probability >= decision.min_confidence:
            outcome = Outcome.FOUND
        return replace(decision, outcome=outcome, reason=StopReason.PIXEL_FIT)


def is_doubtful(rule: StoppingRule, decision: StopDecision, views: int, kind: str) -> bool:
    """Return whether a search must verify its leader before it ends.

    This is so if the open-set score of the decision with which it would end is too low for an answer after fewer views.
    The weights are for the scores that come with the program for a descriptor, the ``kind``. The rule has them if the
    catalog has enough objects.
    """
    fitted = len(rule.open_set_thresholds)
    model = fitted_before(kind, fitted)
    if model is None or rule.open_set is None or not np.array_equal(model.weights, rule.open_set.weights):
        return False
    if decision.outcome is Outcome.CONTINUE or views < fitted or decision.reason is StopReason.UNCHANGED_BENCH:
        return False
    return _HOPELESS < decision.open_set_score < max(rule.open_set_thresholds)


def verify(belief: Belief, leader: int, queries: Queries) -> Asking[Verification | None]:
    """Compare the views of a search with the enrolled views of its leader and of the next candidates; None without.

    The leader is an index of the views' names, and the queries are in the order of the belief's levels.
    """
    index, ranking = belief.index, belief.ranking()
    last_deg = float(belief.orientation_deg[-1])
    pose_deg = dict(zip(ranking.object_index.tolist(), ranking.pose_deg.tolist(), strict=True))
    candidates = [leader, *[one for one in ranking.object_index.tolist() if one != leader][:_OTHERS]]
    seen: list[list[Pixels]] = []
    similarity = descriptor(index.views.descriptor).similarity
    means = []
    for candidate in candidates:
        azimuths_deg = [wrap360(pose_deg[candidate] + o - last_deg) for o in belief.orientation_deg.tolist()]
        views = yield NeedEnrolledViews(candidate, tuple(azimuths_deg))
        if views is None:
            return None
        seen = seen or [[Pixels.of(one) for one in queries(n)] for n in range(belief.queries)]
        enrolled_deg = np.array([view.azimuth_deg for view in views])
        nearest = [_nearest(enrolled_deg, azimuth_deg).tolist() for azimuth_deg in azimuths_deg]
        prepared = {place: Pixels.of(views[place]) for place in set(chain(*nearest))}
        rows = index.views.of(candidate)
        fits = []
        for n, azimuth_deg in enumerate(azimuths_deg):
            own = rows[_nearest(index.views.azimuth_deg[rows], azimuth_deg)]
            alike: FloatArray = similarity(np.atleast_2d(belief.levels[n]), index.views.levels(own)).max(axis=1)
            likeliest = np.argsort(-alike, kind="stable")[:_SEGMENTATIONS].tolist()
            fits.append(max(fit(seen[n][one], prepared[place]) for one in likeliest for place in nearest[n]))
        means.append(float(np.mean(fits)))
    return Verification(leader, means[0], float(np.mean(means[1:])) if len(means) > 1 else 0.0)


def _nearest(own_deg: FloatArray, azimuth_deg: float) -> IndexArray:
    """Return the indices of the `NEAREST` views to an azimuth."""
    return np.argsort(size_deg(own_deg - azimuth_deg), kind="stable")[:NEAREST]


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
    object that fits one of them up to noise is not unknown. ``outcome`` is that with which the search would end, and
    ``max_error`` the largest probability that a decision is wrong.
    """
    if outcome not in (Outcome.AMBIGUOUS, Outcome.UNKNOWN):
        return None
    probability = belief.probability(beta)
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
    winner = None
    if outcome is Outcome.AMBIGUOUS or (found.fits and found.twins):
        winner = None if found.winner is None else (first, second)[found.winner]
        outcome = Outcome.AMBIGUOUS if winner is None else Outcome.FOUND
    return LeaderComparison((first, second), tuple(compared), both, found, outcome, winner, max_error)


def _margin(scores: FloatArray, probability: FloatArray) -> float:
    """Return by how much the score of the likeliest object exceeds all others."""
    best = int(np.lexsort((-scores, -probability))[0])
    return float(scores[best] - np.delete(scores, best).max(initial=0.0))
