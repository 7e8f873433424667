"""One search by the dense filter: views in; belief, decision and next best view out. It reads no image itself.

When it ends, it takes two last steps, which compare its views with enrolled ones, pixel by pixel. It asks for enrolled
views (`NeedEnrolledViews`); its driver brings them. `DenseSession.end` is the decision after the steps:

- `verify`, for a doubtful leader. The open-set score compares descriptors of 8 x 8 cells. An unknown object may
  resemble an enrolled one at this coarse scale, although its details do not fit. For each view, the enrolled views at
  the estimated pose are registered to it. The fit is the share of the view's contrast that they explain, in colours
  that light hardly changes. The fit of the leader, and its difference from the fit of the next candidates, are added to
  the open-set score with weights.
- `compare_leaders`, for the two leaders of a search that does not end with one object.

The comparisons themselves are in `hbr.dense.local_difference`.

If the object was replaced or rotated by hand, the search begins again with the views since then (`hbr.dense.change`).

Decisions: docs/decisions/0013, docs/decisions/0016, docs/decisions/0015, docs/decisions/0017.
"""

from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import ClassVar, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.angles import size_deg, wrap180, wrap360
from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.dense.change import Change, changed
from hbr.dense.filter import KEPT, Belief, completed, update_belief
from hbr.dense.index import DenseIndex
from hbr.dense.local_difference import NEAREST, LocalDecision, LocalView, Pixels, chosen_views, compare_objects, fit
from hbr.dense.next_view import NextBestView, next_best_view
from hbr.dense.pose import poses_of
from hbr.dense.stopping import Outcome, StopDecision, StoppingRule, StopReason, fitted_before
from hbr.descriptors import descriptor
from hbr.descriptors.together import like_enrollment

#: Numbers of compared candidates beside the leader, and of segmentations of each view.
_OTHERS: Final = 3  # more: a surer lead; each needs the enrolled images of one more object
_SEGMENTATIONS: Final = 2  # more: a wrong box does less harm; each costs a registration of every candidate
#: Weights of the open-set score, of the leader's fit, and of its difference from that of other candidates; an offset.
#: Fitted like `hbr.dense.stopping.fitted_before`: the result is a log-odds.
_WEIGHTS: Final = (0.714, 9.438, 4.995)
_OFFSET: Final = -5.416
#: Log-odds from which an object is found, and below which it is unknown: that of 1 in 100 enrolled objects.
FOUND_FROM: Final = 0.0
#: Log-odds from which an object is found where the bench may be that of the enrollment: there an enrolled object fits
#: much better. In searches for objects 1–50 after a mild change, enrolled ones reach 5.6 or more, others 1.1 or less.
FOUND_FROM_SAME_BENCH: Final = 3.0
UNKNOWN_BELOW: Final = -1.3
#: With a smaller open-set score, an object is unknown at any fit.
_HOPELESS: Final = -7.0
#: Share of the probability that the two leaders have together.
LEADERS: Final = 0.9  # with less, a third object is likely, and a difference of two decides nothing
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
    index, last_deg = belief.index, float(belief.orientation_deg[-1])
    candidates = [leader, *[one for one in belief.ranking().object_index.tolist() if one != leader][:_OTHERS]]
    seen: list[list[Pixels]] = []
    similarity = descriptor(index.views.descriptor).similarity
    means = []
    for candidate in candidates:
        pose_deg, *_ = poses_of(belief, candidate)
        azimuths_deg = [wrap360(pose_deg + o - last_deg) for o in belief.orientation_deg.tolist()]
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


#: Number of times that a search begins again because the object changed.
MOST_CHANGES: Final = 3  # more: a hand that stays in the picture holds up the bench; fewer: it uses up all of them
_WORTH_REDUCING: Final = 2  # of a smaller catalog, a reduced index saves less time than its making takes


class DenseSession:
    """A search for one object, the same for the bench, for replay and for evaluation.

    Parameters
    ----------
    index : DenseIndex
        The enrolled views.
    rule : StoppingRule
        Decides when the search ends.
    max_views : int
        Views after which it ends in any case, counted from the last change of the object.
    most_changes : int
        Number of times that the search begins again because the object changed; 0: all views count for one object.

    Attributes
    ----------
    belief : Belief
        After at least one view.
    left_out : int
        Number of views, from the first one on, that the belief leaves out because the object changed after them.
    change : Change, optional
        The change that the last view showed.
    decision : StopDecision
        The rule's last decision: at rest, after the last view.
    present : StopDecision
        What the rule would decide after the last view, if it decided after each one.
    is_new_decision : bool
        Whether the last view led to a decision.
    verification : Verification, optional
        The verification of the leader after the last view, if there was one.
    comparison : LeaderComparison, optional
        The comparison of the two leaders after the last view, if there was one.
    """

    belief: Belief
    decision: StopDecision
    present: StopDecision
    is_new_decision = True
    verification: Verification | None = None
    comparison: LeaderComparison | None = None
    left_out = 0
    change: Change | None = None
    _NEWEST: ClassVar[int] = 2
    """Number of decisions since which the object may have changed."""

    def __init__(
        self, index: DenseIndex, rule: StoppingRule, *, max_views: int = 8, most_changes: int = MOST_CHANGES
    ) -> None:
        self.rule = rule
        self.max_views = max_views
        self._changes_left = most_changes
        # If a search ends after one or two views, an index of a part of the views costs more time than it saves.
        self._kept = KEPT if len(index) > _WORTH_REDUCING * KEPT else len(index)
        self._index = index
        self._so_far: DenseIndex | Belief = index
        self._before: deque[Belief] = deque(maxlen=self._NEWEST)
        self._disturbed: set[int] = set()
        self._reliable = True
        self._same_bench: bool | None = None
        self._like_enrollment: bool | None = None

    def add(
        self,
        levels: LevelArray,
        orientation_deg: float,
        *,
        earlier: Sequence[LevelArray] | None = None,
        reliable: bool = True,
        same_bench: bool | None = None,
        segmented_by: str | None = None,
        disturbed: bool = False,
    ) -> StopDecision:
        """Add the next view, as for `update_belief`, and return the rule's last decision.

        Parameters
        ----------
        levels : uint8 array (length,) or (h, length)
            The view; a row for each of several segmentations.
        orientation_deg : float
            Orientation of the camera around the object, from any zero that all views share.
        earlier : sequence of uint8 arrays, optional
            New descriptions of all earlier views, because they were segmented again, and better.
        reliable : bool
            Whether the views were segmented reliably (`hbr.ViewsTogether.reliable`). If not, the search does not end
            while it may take more views.
        same_bench : bool, optional
            Whether the bench is that of the enrollment; None: not known.
        segmented_by : str, optional
            The `hbr.segmentation.Method` of the view. The rule considers the bench only with a method that segments
            like the enrollment (`hbr.descriptors.together.like_enrollment`).
        disturbed : bool
            Whether the table moved without a command since the view before, as if by hand.
        """
        self._reliable, self._same_bench = reliable, same_bench
        self._like_enrollment = same_bench if segmented_by is None else like_enrollment(segmented_by, same_bench)
        self.verification = self.comparison = None  # they were for the views before
        if earlier is not None:
            self._replace(earlier)
        self._begin_view(orientation_deg)
        self._extend(levels, orientation_deg)
        if disturbed:
            self._disturbed.add(self.belief.queries - 1)
        self.change = self._changed()
        self.present = self._decide()
        if self.is_new_decision:
            self.decision = self.present
            if self.decision.outcome is not Outcome.CONTINUE:
                self._complete()
            self.present = self.decision
        return self.decision

    def _changed(self) -> Change | None:
        """Begin again with the newest views if they show another object."""
        if not (self._changes_left and self.is_new_decision):
            return None
        found = changed(self.belief, self._before, beta=self.rule.beta, disturbed=self._disturbed)
        if found is None:
            return None
        self._changes_left -= 1
        newest = self.belief.levels[found.first :], self.belief.orientation_deg[found.first :].tolist()
        found = found._replace(first=self.left_out + found.first)
        self.left_out = found.first
        self._forget()
        for levels, orientation_deg in zip(*newest, strict=True):
            self._begin_view(orientation_deg)
            self._extend(levels, orientation_deg)
        self.is_new_decision = True
        return found

    def _forget(self) -> None:
        """Forget all views."""
        self._so_far = self._index
        self._before.clear()
        self._disturbed.clear()

    def _begin_view(self, orientation_deg: float) -> None:
        """Set ``is_new_decision`` for the next view."""

    def _extend(self, levels: LevelArray, orientation_deg: float) -> None:
        """Add a view to the belief."""
        if self.is_new_decision and isinstance(self._so_far, Belief):
            self._before.append(self._so_far)
        self._so_far = self.belief = update_belief(
            levels, orientation_deg, self._so_far, kept=self._kept, weight=self._weight(orientation_deg)
        )

    def _replace(self, queries: Sequence[LevelArray]) -> None:
        """Compute the belief again from other descriptions of the same views."""
        before = self._so_far.levels if isinstance(self._so_far, Belief) else ()
        if len(queries) != self.left_out + len(before):
            raise ValueError(f"{len(queries)} earlier views; the search has {self.left_out + len(before)}")
        queries = queries[self.left_out :]
        if all(np.array_equal(a, b) for a, b in zip(queries, before, strict=True)):
            return
        orientations_deg = self.belief.orientation_deg.tolist()
        self._so_far = self._index
        self._before.clear()
        for query, orientation_deg in zip(queries, orientations_deg, strict=True):
            self._extend(query, orientation_deg)

    def next_best_view(self, rotations_deg: ArrayLike | None = None, seconds: ArrayLike | None = None) -> NextBestView:
        """Return the rotation to the next best view, as `hbr.next_best_view` does."""
        return next_best_view(self.belief, beta=self.rule.beta, rotations_deg=rotations_deg, seconds=seconds)

    def end(self) -> StopDecision:
        """Return the decision with which the search ends here, even if the rule would continue.

        The last steps that were taken after the last view count.
        """
        decision = self.decision
        if decision.outcome is Outcome.CONTINUE:
            self._complete()
            decision = self._decide(last=True)
        if self.verification is not None:
            decision = self.verification.decided(decision, self.found_from)
        return decision if self.comparison is None else self.comparison.decided(decision)

    @property
    def found_from(self) -> float:
        """Log-odds from which a verified leader is found."""
        return FOUND_FROM if self._same_bench is False else FOUND_FROM_SAME_BENCH

    @property
    def is_doubtful(self) -> bool:
        """Whether the search must verify its leader before it ends (`hbr.dense.session.is_doubtful`)."""
        return is_doubtful(self.rule, self.end(), self.belief.queries, self.belief.index.views.descriptor)

    def verify(self, queries: Queries, measured: Verification | None = None) -> Asking[Verification | None]:
        """Verify a doubtful leader, pixel by pixel; None without doubt.

        A fit that was ``measured`` before is used instead of enrolled views.
        """
        self.verification = None
        if measured is None and self.is_doubtful:
            measured = yield from verify(self.belief, self.end().object_index, queries)
        self.verification = measured
        return measured

    def compare(self, queries: Queries) -> Asking[LeaderComparison | None]:
        """Compare the two leaders, pixel by pixel, if the search does not end with one object; else None."""
        self.comparison = None
        outcome, rule = self.end().outcome, self.rule
        self.comparison = yield from compare_leaders(
            self.belief, outcome, queries, beta=rule.beta, max_error=rule.error_rate
        )
        return self.comparison

    def _weight(self, orientation_deg: float) -> float | None:  # noqa: ARG002
        """Return the weight of the next view; None: 1."""
        return None

    def _decide(self, *, last: bool = False) -> StopDecision:
        return self._by_rule(self.belief, self.belief.queries if last else self.max_views)

    def _by_rule(self, belief: Belief, max_views: int) -> StopDecision:
        return self.rule.decide(belief, max_views=max_views, reliable=self._reliable, same_bench=self._like_enrollment)

    def _complete(self) -> None:
        """Decide again before an end if an object that was left out after the first view can be first or second."""
        if len(self.belief.index) == len(self._index):
            return
        found = completed(self.belief, self._index)
        if found is not self.belief:
            self._so_far = self.belief = found
            self.decision = self._decide()
