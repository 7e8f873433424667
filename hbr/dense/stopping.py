"""The stopping rule of the dense search: it ends searches and rejects unknown objects at measured error rates.

`hbr.dense.fitting` sets the thresholds, and `StoppingRule.decide` applies them after each view of a search.

Decisions: docs/decisions/0026, docs/decisions/0060.
"""

from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np

from hbr.core.arrays import FloatArray
from hbr.dense.filter import Belief
from hbr.dense.open_set import OpenSetModel, evidence, leader, open_set_score


class Outcome(StrEnum):
    """What a search does after a view: continue, or end with one of three answers."""

    CONTINUE = "continue"
    FOUND = "found"
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"


class StopReason(StrEnum):
    """The reason why a search continues or ends."""

    CONFIDENT = "confident"
    NOT_CONFIDENT = "not-confident"
    BELOW_OPEN_SET_THRESHOLD = "below-open-set-threshold"
    BADLY_SEGMENTED = "badly-segmented"
    MARGIN = "margin"
    MAX_VIEWS = "max-views"
    NO_ROTATION_LEFT = "no-rotation-left"
    LOCAL_DIFFERENCE = "local-difference"
    PIXEL_FIT = "pixel-fit"
    UNCHANGED_BENCH = "unchanged-bench"
    CUSTOM = "custom"


@dataclass(frozen=True, slots=True)
class StopDecision:
    """The decision of the stopping rule after a view, and the numbers that it compared.

    Attributes
    ----------
    outcome, reason
        What to do, and why.
    object_index : int
        The leading candidate, for every outcome.
    probability, min_confidence : float
        Its probability among the enrolled objects, and the probability that ends a search. It is the confidence of an
        answer only if the object is found.
    open_set_score, open_set_threshold : float
        A number that is high for enrolled objects, and the score below which an object is unknown; with a threshold of
        -inf no object is unknown.
    """

    outcome: Outcome
    reason: StopReason
    object_index: int
    probability: float
    min_confidence: float
    open_set_score: float
    open_set_threshold: float


class LimitationCode(StrEnum):
    """The kinds of limitations: each names something that a stopping rule does not guarantee."""

    SAMPLED = "sampled"
    FALSE_REJECT_RATE = "false-reject-rate"
    ERROR_RATE = "error-rate"
    FALSE_ACCEPT_RATE = "false-accept-rate"
    SIMILAR_OBJECTS = "similar-objects"
    UNKNOWN_NOT_MEASURED = "unknown-not-measured"
    ONE_OBJECT = "one-object"
    SINGLE_VIEWS = "single-views"


@dataclass(frozen=True, slots=True)
class Limitation:
    """A rate that a stopping rule does not guarantee, with the numbers that are the reason.

    Attributes
    ----------
    code
        What is not guaranteed.
    values
        ``sampled``: ``searched`` of ``objects``. ``false-reject-rate``: ``rate`` asked for, ``searches`` done and
        ``needed``, ``reached`` rate. ``error-rate`` and ``similar-objects``: ``rate``, ``searches``, ``needed``,
        ``min_confidence``, and ``wrong`` of ``ended`` searches. ``false-accept-rate``: ``rate``, and ``accepted`` of
        ``searches`` for left-out objects.
    """

    code: LimitationCode
    values: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ShiftRates:
    """Rates in leave-one-out searches under a change of the bench.

    Attributes
    ----------
    strength : float
        Of the change; 1 is a hard one.
    searches : int
        Searches for enrolled objects, and as many for the same objects as if they were not enrolled.
    accepted, rejected : int
        Enrolled objects that were accepted after at most all views, and that were called unknown.
    false_accepts : int
        Objects that were not enrolled, and were accepted.
    """

    strength: float
    searches: int
    accepted: int
    rejected: int
    false_accepts: int


def by_confidence(is_enough: bool, *, last: bool, reliable: bool) -> tuple[Outcome, StopReason]:
    """Return what a search does whose open-set score is high enough, from whether its confidence is enough, too."""
    if is_enough and (reliable or last):
        return Outcome.FOUND, StopReason.CONFIDENT
    if last:
        return Outcome.AMBIGUOUS, StopReason.MAX_VIEWS
    return Outcome.CONTINUE, StopReason.BADLY_SEGMENTED if is_enough else StopReason.NOT_CONFIDENT


@dataclass(frozen=True, eq=False)
class StoppingRule:
    """A rule that ends a search and decides which objects are unknown.

    Attributes
    ----------
    beta : float
        As for `Belief.posterior`.
    min_confidence : float
        Confidence that ends a search.
    usual_scores : float64 array (objects, views)
        Usual score of each object when it is searched for, after 1, 2, ... views.
    open_set_thresholds : tuple of float
        Open-set scores after 1, 2, ... views below which an object is unknown; the last one is for all further views.
        With -inf no object is unknown.
    error_rate, false_reject : float
        The rates asked for: wrong objects among those named, and enrolled objects called unknown.
    false_accept : float
        Measured share of left-out objects that were not called unknown after all views; nan if not measured.
    searches : int
        Leave-one-out searches that the rule comes from.
    limitations : tuple of Limitation
        What the rule does not guarantee; empty if it guarantees both rates.
    open_set : OpenSetModel, optional
        The weights of the open-set score. Without them the score is that of `hbr.dense.open_set.open_set_score`.
    unknown_thresholds : tuple of float
        With weights: open-set scores after 1, 2, ... views below which an object is unknown. Between them and
        ``open_set_thresholds`` it is ambiguous. Without weights both thresholds are one.
    changed_bench_thresholds, same_bench_thresholds : tuple of float
        With weights: ``open_set_thresholds`` for a bench that is known to have changed since the enrollment, and for
        one that is known to be the same.
    leave_one_out_thresholds : tuple of float
        With weights: scores of `hbr.dense.open_set.open_set_score` after 1, 2, ... views. On an unchanged bench,
        few enrolled objects score less, and an object that reaches the highest of them is found.
    rates : tuple of ShiftRates
        Measured rates under changes of the bench.
    """

    beta: float
    min_confidence: float
    usual_scores: FloatArray
    open_set_thresholds: tuple[float, ...]
    error_rate: float
    false_reject: float
    false_accept: float
    searches: int
    limitations: tuple[Limitation, ...] = ()
    open_set: OpenSetModel | None = None
    unknown_thresholds: tuple[float, ...] = ()
    changed_bench_thresholds: tuple[float, ...] = ()
    same_bench_thresholds: tuple[float, ...] = ()
    leave_one_out_thresholds: tuple[float, ...] = ()
    rates: tuple[ShiftRates, ...] = ()

    def decide(
        self, belief: Belief, *, max_views: int = 8, reliable: bool = True, same_bench: bool | None = None
    ) -> StopDecision:
        """Decide whether a search ends after these views.

        An object is found if its confidence and its open-set score reach their thresholds. Before the last fitted view
        the highest of all open-set thresholds counts: an unknown object that passes the first threshold gets
        another view, which costs an enrolled object little. From the last fitted view on, an object below the
        threshold is unknown, even if views are left: no false-reject rate was measured for those. After ``max_views``
        an object with too little confidence is ambiguous. If the views were not segmented reliably, the search
        continues until ``max_views``: another view costs little, and the background is then known. ``same_bench`` is
        whether the bench is that of the enrollment; None: not known. On the same bench, an object with enough
        confidence is also found if it reaches all leave-one-out thresholds, which are for an unchanged bench.
        """
        best, probability = belief.likeliest(self.beta)
        known = {True: self.same_bench_thresholds, False: self.changed_bench_thresholds, None: ()}[same_bench]
        thresholds = known or self.open_set_thresholds
        fitted = len(thresholds)
        views = belief.queries
        n = min(views, fitted) - 1
        score = self._open_set_score(belief, n)
        early, last = views < min(fitted, max_views), views >= max_views
        threshold = max(thresholds) if early else thresholds[n]
        unknown_below = min(threshold, self.unknown_thresholds[n]) if self.unknown_thresholds else threshold
        if score >= threshold:
            outcome, reason = by_confidence(probability >= self.min_confidence, last=last, reliable=reliable)
        else:
            outcome, reason = Outcome.UNKNOWN, StopReason.BELOW_OPEN_SET_THRESHOLD
            if not early and score >= unknown_below:
                outcome = Outcome.AMBIGUOUS
            if early or (outcome is Outcome.AMBIGUOUS and not last):
                outcome = Outcome.CONTINUE
            elif not (reliable or last):
                outcome, reason = Outcome.CONTINUE, StopReason.BADLY_SEGMENTED
        object_index = int(belief.index.object_index[best])
        decision = StopDecision(outcome, reason, object_index, probability, self.min_confidence, score, threshold)
        if same_bench and reliable and score < threshold and views <= fitted:
            return self._found_on_same_bench(belief, n, decision)
        return decision

    def _found_on_same_bench(self, belief: Belief, n: int, decision: StopDecision) -> StopDecision:
        """Return the decision by the leave-one-out score, which is for an unchanged bench."""
        if not self.leave_one_out_thresholds or decision.probability < self.min_confidence:
            return decision
        leading, score = self._leave_one_out_score(belief, n)
        threshold = max(self.leave_one_out_thresholds)
        if leading != decision.object_index or score < threshold:
            return decision
        return replace(
            decision,
            outcome=Outcome.FOUND,
            reason=StopReason.UNCHANGED_BENCH,
            open_set_score=score,
            open_set_threshold=threshold,
        )

    def _open_set_score(self, belief: Belief, n: int) -> float:
        if self.open_set is not None:
            levels, unit = belief.index.views.levels, belief.index.whitening.unit
            units = [unit(np.atleast_2d(query)) for query in belief.levels]
            _, numbers = evidence(belief, units, lambda rows: unit(levels(rows)))
            return self.open_set.score(numbers, belief.queries)
        return self._leave_one_out_score(belief, n)[1]

    def _leave_one_out_score(self, belief: Belief, n: int) -> tuple[int, float]:
        """Return the object with the highest score, and its open-set score as in the leave-one-out searches."""
        best, score, margin = leader(belief.index.object_index, belief.scores())
        return best, open_set_score(score, margin, float(self.usual_scores[best, n]), self._typical_scores[n])

    @cached_property
    def _typical_scores(self) -> list[float]:
        typical: list[float] = np.median(self.usual_scores, axis=0).tolist()
        return typical
