"""The thresholds of the stopping rule, from searches for the objects of a catalog among each other.

`rule_from_searches` sets the thresholds from the searches of `hbr.dense.leave_one_out`, and `fit_open_set` fits the
open-set score to changes of the bench.

Decision: docs/decisions/0015.
"""

from dataclasses import dataclass, replace
from math import ceil, floor, inf, nan
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hbr.core.arrays import FloatArray
from hbr.dense.filter import BETA, update_belief
from hbr.dense.index import DenseIndex
from hbr.dense.leave_one_out import (
    MOST_SEARCHES,
    STRENGTHS,
    LeaveOneOut,
    ShiftedSearches,
    Tasks,
    can_shift,
    fitting_searches,
    shifted_searches,
)
from hbr.dense.stopping import (
    Limitation,
    LimitationCode,
    OpenSetModel,
    ShiftRates,
    StoppingRule,
    fitted_before,
    open_set_score,
    usual_scores,
)

#: No search ends at a smaller confidence, even if all leave-one-out searches were right: real views may be less clear.
# lower: fewer views, and wrong answers where real views are less clear than enrolled ones
SMALLEST_MIN_CONFIDENCE: Final = 0.9
#: Confidence that ends a search if the catalog has too little data for the error rate that was asked for.
UNFITTED_MIN_CONFIDENCE: Final = 0.98
#: With fewer objects, no second candidate remains when one object is left out.
FEWEST_OBJECTS: Final = 3
#: With fewer objects, the open-set score is not fitted to changes of the bench: a share of 2 % needs this many objects.
FEWEST_OBJECTS_SHIFTED: Final = 50
#: The error rates that are allowed by default: wrong objects among those named, and enrolled objects called unknown.
# Smaller rates need more views for each answer, and more enrolled objects to be guaranteed.
ERROR_RATE: Final = 0.01
FALSE_REJECT: Final = 0.02
#: Largest share of objects that are not enrolled, and are accepted under changes of the bench.
FALSE_ACCEPT: Final = 0.02
#: Largest share of them that is accepted before the last view.
# an eighth of `FALSE_ACCEPT`: most of the errors are left to the last view, which knows most
_EARLY_ACCEPT: Final = 0.0025
#: Changes of the bench up to this strength are mild: enrolled objects must be accepted at the rate that was asked for.
_MILD: Final = 0.5
#: The strengths up to this one are those of a bench that has not changed.
_SAME: Final = 0.25


def conformal_threshold(scores: ArrayLike, false_reject: float) -> float:
    """Return the score below which at most the share ``false_reject`` of further scores of the same kind fall.

    The ⌊α(n + 1)⌋-th smallest of n scores; -inf if n is too small, that is, below 1/α - 1. The guarantee holds on
    average for scores that are exchangeable with these, for any distribution.

    Source: V. Vovk, A. Gammerman and G. Shafer, "Algorithmic Learning in a Random World", Springer 2005.

    Raises `ValueError`: the share is not between 0 and 1, or a score is not finite.
    """
    ordered = np.sort(np.asarray(scores, np.float64).ravel())
    if not 0 < false_reject < 1:
        raise ValueError(f"false_reject is {false_reject}; a share between 0 and 1 is needed, e.g. 0.02")
    if not np.isfinite(ordered).all():
        raise ValueError("a score is not finite; leave such searches out")
    place = floor(false_reject * (len(ordered) + 1) + 1e-9)
    return float(ordered[place - 1]) if place else -inf


def min_confidence_for(confidence: FloatArray, correct: NDArray[np.bool_], error_rate: float) -> float:
    """Return the smallest confidence at which at most the share ``error_rate`` of the ended searches is wrong.

    Each row is a search. It ends at the first view whose leading candidate has at least this confidence; searches that
    never reach it do not count. One error is added to those that occurred, because few searches guarantee little: with
    fewer than ``1 / error_rate`` searches the result is inf.
    """
    for least in np.unique(np.concatenate([[0.5], confidence[confidence > 0.5]])).tolist():
        ended, wrong = _ended(confidence, correct, least)
        if len(ended) and (wrong + 1) / (len(ended) + 1) <= error_rate:
            return float(least)
    return inf


def rule_from_searches(
    searches: LeaveOneOut,
    *,
    error_rate: float = ERROR_RATE,
    false_reject: float = FALSE_REJECT,
    objects: int | None = None,
) -> StoppingRule:
    """Fit the rule that keeps the error rates in leave-one-out searches.

    If there is too little data for a rate, the rule does what the data allows and states a limitation: a search ends at
    `UNFITTED_MIN_CONFIDENCE`, and objects that score less than every search did are unknown.

    Parameters
    ----------
    error_rate, false_reject : float
        Share of wrong objects among those named, and of enrolled objects called unknown.
    objects : int, optional
        Number of objects that were searched for, if they were only a sample of those in the model set.
    """
    count, views = searches.confidence.shape
    objects = searches.objects if objects is None else objects
    usual = usual_scores(searches.known, searches.correct, searches.objects)
    known, unknown = searches.known.open_set_score(usual), searches.unknown.open_set_score(usual)
    limitations = []
    if objects < searches.objects:
        limitations.append(Limitation(LimitationCode.SAMPLED, {"searched": objects, "objects": searches.objects}))

    # Thresholds for unknown objects; with too few searches, the smallest score of all.
    thresholds = tuple(conformal_threshold(known[:, n], false_reject) for n in range(views))
    if thresholds[-1] == -inf:
        reached = 1 / (count + 1)
        thresholds = tuple(conformal_threshold(known[:, n], reached + 1e-9) for n in range(views))
        values = {"rate": false_reject, "searches": count, "needed": ceil(1 / false_reject) - 1, "reached": reached}
        limitations.append(Limitation(LimitationCode.FALSE_REJECT_RATE, values))

    min_confidence, limitation = fit_min_confidence(searches, error_rate)
    if limitation is not None:
        limitations.append(limitation)
    if objects < FEWEST_OBJECTS:
        limitations.append(Limitation(LimitationCode.UNKNOWN_NOT_MEASURED))
    return StoppingRule(
        beta=searches.beta,
        min_confidence=min_confidence,
        usual_scores=usual,
        open_set_thresholds=thresholds,
        error_rate=error_rate,
        false_reject=false_reject,
        false_accept=float((unknown[:, -1] >= thresholds[-1]).mean()) if objects >= FEWEST_OBJECTS else nan,
        searches=count,
        limitations=tuple(limitations),
    )


def fit_min_confidence(searches: LeaveOneOut, error_rate: float) -> tuple[float, Limitation | None]:
    """Return the confidence that ends a search, and a limitation if the searches do not guarantee the rate."""
    found = max(SMALLEST_MIN_CONFIDENCE, min_confidence_for(searches.confidence, searches.correct, error_rate))
    if found <= 1:
        return found, None
    count, needed = len(searches.confidence), ceil(1 / error_rate)
    ended, wrong = _ended(searches.confidence, searches.correct, UNFITTED_MIN_CONFIDENCE)
    values = {"rate": error_rate, "searches": count, "needed": needed, "min_confidence": UNFITTED_MIN_CONFIDENCE}
    code = LimitationCode.ERROR_RATE if count < needed else LimitationCode.SIMILAR_OBJECTS
    return UNFITTED_MIN_CONFIDENCE, Limitation(code, {**values, "wrong": wrong, "ended": len(ended)})


def fit_open_set(rule: StoppingRule, searches: ShiftedSearches, model: OpenSetModel | None = None) -> StoppingRule:
    """Return the rule with an open-set score that is fitted to changes of the bench.

    The weights are those of a ``model``, or fitted to these searches.

    Before the last view, an object is accepted only with a score that almost no unknown object reaches, because another
    view costs little. After the last view the threshold is lower: at most 2 % of the unknown objects are accepted in
    all, over changes of all strengths and no change. If enrolled objects are so similar to each other that more than
    ``false_reject`` of them would not reach a threshold after a mild change, the threshold is lower. Objects are
    unknown if their score is below that of nearly all searches for enrolled objects; between the thresholds they are
    ambiguous.

    On a bench that is known to have changed, the searches without a change do not count. On a bench that is known to be
    the same, only the searches with the smallest changes and the rule's own thresholds count.
    """
    model = model or OpenSetModel.fitted(searches.known, searches.correct, searches.unknown)
    known, unknown = model.scores(searches.known), model.scores(searches.unknown)
    found = np.where(searches.correct, known, -np.inf)
    count, views = known.shape
    is_mild = searches.strength <= _MILD
    highest = float(np.quantile(np.maximum(found[is_mild].max(axis=1), known.min()), rule.false_reject))
    thresholds = np.minimum(_accepted_from(unknown), highest)
    changed = np.minimum(_accepted_from(unknown[searches.strength > 0]), thresholds)
    same = np.minimum(_accepted_from(unknown[searches.strength <= _SAME]), highest)
    share = max(rule.false_reject, 1.001 / (count + 1))
    unknown_below = np.array([conformal_threshold(known[:, n], share) for n in range(views)])
    unknown_below = np.minimum(unknown_below, thresholds)
    # the thresholds of a search that knows whether the bench has changed
    limits = np.where(searches.strength[:, None] > 0, changed, same)
    is_accepted, is_false = (np.any(scores >= limits, axis=1) for scores in (found, unknown))
    is_rejected = (known < limits).all(axis=1) & (known[:, -1] < unknown_below[-1])
    rates = [
        ShiftRates(strength, int(own.sum()), *(int(what[own].sum()) for what in (is_accepted, is_rejected, is_false)))
        for strength in STRENGTHS
        for own in [searches.strength == strength]
    ]
    return replace(
        rule,
        open_set=model,
        open_set_thresholds=tuple(thresholds.tolist()),
        unknown_thresholds=tuple(unknown_below.tolist()),
        changed_bench_thresholds=tuple(changed.tolist()),
        same_bench_thresholds=tuple(same.tolist()),
        leave_one_out_thresholds=rule.open_set_thresholds,
        false_accept=float(is_false.mean()),
        rates=tuple(rates),
    )


def with_false_accepts(rule: StoppingRule, searches: LeaveOneOut) -> StoppingRule:
    """Return the rule, with a limitation if it accepts too many left-out objects before the last view."""
    before = searches.unknown.open_set_score(rule.usual_scores)[:, :-1]
    accepted = int((before >= max(rule.open_set_thresholds)).any(axis=1).sum())
    if accepted <= FALSE_ACCEPT * len(before):
        return rule
    values = {"rate": FALSE_ACCEPT, "accepted": accepted, "searches": len(before)}
    return replace(rule, limitations=(*rule.limitations, Limitation(LimitationCode.FALSE_ACCEPT_RATE, values)))


def _accepted_from(unknown: FloatArray) -> FloatArray:
    """Return the scores from which an object is accepted after 1, 2, ... views.

    Of objects that are not enrolled, with the scores (searches, views), at most `FALSE_ACCEPT` are accepted.
    """
    count, views = unknown.shape
    thresholds = np.empty(views)
    is_accepted = np.zeros(count, np.bool_)
    if views > 1:
        before = unknown[:, :-1].max(axis=1)
        thresholds[:-1] = -conformal_threshold(-before, max(_EARLY_ACCEPT, 1.001 / (count + 1)))
        is_accepted = before >= thresholds[0]
    at_end = np.where(is_accepted, np.finfo(np.float64).max, unknown[:, -1])
    thresholds[-1] = -conformal_threshold(-at_end, max(FALSE_ACCEPT, 2.001 / (count + 1)))
    return np.minimum.accumulate(thresholds)


@dataclass(frozen=True, eq=False)
class FittedRule:
    """A stopping rule with its results in the leave-one-out searches that it was fitted to.

    Attributes
    ----------
    rule : StoppingRule
        Its ``limitations`` say what it does not guarantee.
    views
        Views of each search.
    ended, wrong
        Searches that ended by their confidence, and how many of them with a wrong object.
    mean_views
        Views that the ended searches took; nan if none ended.
    rejected
        Searches for enrolled objects that ended as unknown after the last view.
    accepted
        Searches for left-out objects that did not end as unknown; None if there are too few objects to measure that.
    confused : tuple of (str, str)
        Left-out objects and the objects that the rule confused them with, the most frequent pairs first.
    searched : int
        Objects that were searched for.
    """

    rule: StoppingRule
    views: int = 1
    ended: int = 0
    wrong: int = 0
    mean_views: float = nan
    rejected: int = 0
    accepted: int | None = None
    confused: tuple[tuple[str, str], ...] = ()
    searched: int = 0


def fit_stopping_rule(
    index: DenseIndex,
    *,
    error_rate: float = ERROR_RATE,
    false_reject: float = FALSE_REJECT,
    most_searches: int = MOST_SEARCHES,
    most_shifted_searches: int = MOST_SEARCHES,
    sample: int | None = None,
    tasks: Tasks | None = None,
) -> FittedRule:
    """Search for the enrolled objects among each other, and return the rule that is fitted to these searches.

    Parameters
    ----------
    index : DenseIndex
        Of at least one object.
    error_rate, false_reject
        As for `rule_from_searches`.
    most_searches
        Total number of searches, from different first views. Each object is searched for at least once; if there are
        more than `MOST_OBJECTS`, this many of them, evenly spread.
    most_shifted_searches
        Searches under changes of the bench, from which the open-set score is fitted (`fit_open_set`).
    sample
        Number of objects to search for, among each other; by default all.
    tasks
        As for `leave_one_out`.
    """
    searches = fitting_searches(index, most_searches=most_searches, sample=sample, tasks=tasks)
    if searches is None:
        return FittedRule(_rule_without_candidates(index, error_rate, false_reject))
    objects = len(index) if sample is None else min(len(index), max(2, sample))
    rule = rule_from_searches(searches, error_rate=error_rate, false_reject=false_reject, objects=objects)
    ended, wrong = _ended(searches.confidence, searches.correct, rule.min_confidence)
    found = FittedRule(
        rule,
        views=searches.confidence.shape[1],
        ended=len(ended),
        wrong=wrong,
        mean_views=float(ended.mean() + 1) if len(ended) else nan,
        searched=len(np.unique(searches.searched)),
    )
    if sample is None and len(index) >= FEWEST_OBJECTS_SHIFTED and can_shift(index):
        shifted = shifted_searches(index, views=found.views, searches=most_shifted_searches)
        rule = with_false_accepts(rule, searches)
        rule = fit_open_set(rule, shifted, fitted_before(index.views.descriptor, found.views))
        rejected = sum(one.rejected for one in rule.rates)  # in searches under changes of the bench
        return replace(found, rule=rule, rejected=rejected, accepted=sum(one.false_accepts for one in rule.rates))
    known, unknown = (part.open_set_score(rule.usual_scores)[:, -1] for part in (searches.known, searches.unknown))
    accepted = unknown >= rule.open_set_thresholds[-1]
    pairs = np.stack([searches.searched, searches.unknown.object_index[:, -1]], axis=1)[accepted]
    confused, first, times = np.unique(pairs, axis=0, return_index=True, return_counts=True)
    names = index.views.object_names
    return replace(
        found,
        rejected=int((known < rule.open_set_thresholds[-1]).sum()),
        accepted=int(accepted.sum()) if objects >= FEWEST_OBJECTS else None,
        confused=tuple((names[a], names[b]) for a, b in confused[np.lexsort((first, -times))].tolist()),
    )


def _rule_without_candidates(index: DenseIndex, error_rate: float, false_reject: float) -> StoppingRule:
    """Return the rule of a catalog whose objects cannot be compared: it has one object, or single views.

    A single object is found if its score reaches the scores of its own views, which are left out one by one. With
    single views, no object is called unknown.
    """
    threshold, searches, code = -inf, 0, LimitationCode.SINGLE_VIEWS
    usual = np.zeros((len(index.views.object_names), 1))
    if len(index) == 1 and len(index.views) > 1:
        code, searches = LimitationCode.ONE_OBJECT, len(index.views)
        levels, azimuth_deg = index.views.descriptors, index.views.azimuth_deg
        left_out = [
            float(update_belief(levels[row], azimuth_deg[row], index.without(np.array([row]))).scores()[0])
            for row in range(searches)
        ]
        threshold = min(open_set_score(score, score, 0.0, 0.0) for score in left_out)  # all of it is the margin
    return StoppingRule(
        beta=BETA,
        min_confidence=UNFITTED_MIN_CONFIDENCE,
        usual_scores=usual,
        open_set_thresholds=(threshold,),
        error_rate=error_rate,
        false_reject=false_reject,
        false_accept=nan,
        searches=searches,
        limitations=(Limitation(code),),
    )


def _ended(confidence: FloatArray, correct: NDArray[np.bool_], min_confidence: float) -> tuple[NDArray[np.intp], int]:
    """Return the view (from 0) after which each ended search ends at this confidence, and the number of wrong ones."""
    ends = confidence >= min_confidence
    at = np.flatnonzero(ends.any(axis=1))
    view = ends[at].argmax(axis=1)
    return view, int((~correct[at, view]).sum())
