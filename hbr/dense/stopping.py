"""The stopping rule of the dense search: when a search ends, and when an object is unknown, at measured error rates.

`leave_one_out` searches for every object of a catalog, `fit_stopping_rule` sets the thresholds from these searches, and
`StoppingRule.decide` applies them after each view of a search.

Decision: docs/decisions/0026.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from math import ceil, floor, inf, nan
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hbr.core.arrays import FloatArray
from hbr.dense.filter import BETA, Belief, DenseIndex, update_belief
from hbr.dense.leave_one_out import Found, Leaders, LeaveOneOut, Task, leader, leave_one_out, usual_scores

#: No search ends at a smaller confidence, however well the leave-one-out searches went: real views may be less clear.
SMALLEST_MIN_CONFIDENCE: Final = 0.9
#: Confidence that ends a search if the catalog has too little data for the error rate that was asked for.
UNCALIBRATED_MIN_CONFIDENCE: Final = 0.98
#: With fewer objects, leaving one out leaves no second candidate.
FEWEST_OBJECTS: Final = 3
#: Views of a leave-one-out search, if most objects have enough; searches in a calibration.
CALIBRATED_VIEWS: Final = 4
MOST_SEARCHES: Final = 400


class Outcome(StrEnum):
    """What to do after a view: continue, or end with one of three answers."""

    CONTINUE = "continue"
    FOUND = "found"
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"


class StopReason(StrEnum):
    """Why a search continues or ends."""

    CONFIDENT = "confident"
    NOT_CONFIDENT = "not-confident"
    BELOW_OPEN_SET_THRESHOLD = "below-open-set-threshold"
    MARGIN = "margin"
    MAX_VIEWS = "max-views"
    NO_ROTATION_LEFT = "no-rotation-left"
    CUSTOM = "custom"
    EARLIER_VERSION = "earlier-version"


@dataclass(frozen=True, slots=True)
class StopDecision:
    """What the stopping rule decided after a view, and the numbers it compared.

    Attributes
    ----------
    outcome, reason
        What to do, and why.
    object_index : int
        The leading candidate, for every outcome.
    confidence, min_confidence : float
        Its probability among the enrolled objects, and the one that ends a search.
    open_set_score, open_set_threshold : float
        How closely the views resemble an enrolled object, and below what score an object is unknown; a threshold of
        -inf calls no object unknown.
    """

    outcome: Outcome
    reason: StopReason
    object_index: int
    confidence: float
    min_confidence: float
    open_set_score: float
    open_set_threshold: float


class LimitationCode(StrEnum):
    """What a stopping rule does not guarantee."""

    SAMPLED = "sampled"
    FALSE_REJECT_RATE = "false-reject-rate"
    ERROR_RATE = "error-rate"
    SIMILAR_OBJECTS = "similar-objects"
    UNKNOWN_NOT_MEASURED = "unknown-not-measured"
    ONE_OBJECT = "one-object"
    SINGLE_VIEWS = "single-views"
    EARLIER_VERSION = "earlier-version"


@dataclass(frozen=True, slots=True)
class Limitation:
    """A rate that a stopping rule does not guarantee, with the numbers that say why.

    Attributes
    ----------
    code
        What is not guaranteed.
    values
        ``sampled``: ``searched`` of ``objects``. ``false-reject-rate``: ``rate`` asked for, ``searches`` done and
        ``needed``, ``reached`` rate. ``error-rate`` and ``similar-objects``: ``rate``, ``searches``, ``needed``,
        ``min_confidence``, and ``wrong`` of ``ended`` searches. ``earlier-version``: ``text``.
    """

    code: LimitationCode
    values: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class StoppingRule:
    """When a search ends, and which objects are unknown.

    Attributes
    ----------
    beta : float
        As for `Belief.posterior`.
    min_confidence : float
        Confidence that ends a search.
    usual_scores : float64 array (objects, views)
        What each object scores when it is searched for, after 1, 2, ... views.
    open_set_thresholds : tuple of float
        Open-set scores after 1, 2, ... views below which an object is unknown; the last one is for all further views.
        -inf calls no object unknown.
    error_rate, false_reject : float
        The rates asked for: wrong objects among those named, and enrolled objects called unknown.
    false_accept : float
        Measured share of left-out objects that were not called unknown after all views; nan if not measured.
    searches : int
        Leave-one-out searches that the rule comes from.
    limitations : tuple of Limitation
        What the rule does not guarantee; empty if it guarantees both rates.
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

    def decide(self, belief: Belief, *, max_views: int = 8, decisions: int | None = None) -> StopDecision:
        """Decide whether a search ends after these views; ``decisions`` counts instead of them in a search in motion.

        An object is found if it is confident and reaches the open-set threshold. Before the last calibrated view the
        highest of all thresholds counts: an unknown object that passes the first threshold gets another view, which
        costs an enrolled object little. From the last calibrated view on, an object below the threshold is unknown,
        however many views are left: no false-reject rate was measured for those. After ``max_views`` an object that is
        not confident is ambiguous.
        """
        probability = belief.posterior(self.beta).sum(axis=1)
        best = int(probability.argmax())
        calibrated = len(self.open_set_thresholds)
        decisions = belief.queries if decisions is None else decisions
        n = min(decisions, calibrated) - 1
        leaders = Leaders.of([leader(belief.index.object_index, belief.scores())], (1, 1))
        score = float(leaders.open_set_score(self.usual_scores[:, n : n + 1])[0, 0])
        early = decisions < min(calibrated, max_views)
        threshold = max(self.open_set_thresholds) if early else self.open_set_thresholds[n]
        confidence = float(probability[best])
        if score < threshold:
            outcome = Outcome.CONTINUE if early else Outcome.UNKNOWN
            reason = StopReason.BELOW_OPEN_SET_THRESHOLD
        elif confidence >= self.min_confidence:
            outcome, reason = Outcome.FOUND, StopReason.CONFIDENT
        elif decisions < max_views:
            outcome, reason = Outcome.CONTINUE, StopReason.NOT_CONFIDENT
        else:
            outcome, reason = Outcome.AMBIGUOUS, StopReason.MAX_VIEWS
        object_index = int(belief.index.object_index[best])
        return StopDecision(outcome, reason, object_index, confidence, self.min_confidence, score, threshold)


def conformal_threshold(scores: ArrayLike, false_reject: float) -> float:
    """Return the score below which no more than this share of further scores of the same kind fall.

    The ⌊α(n + 1)⌋-th smallest of n scores; -inf if n is too small, that is, below 1/α - 1. The guarantee holds on
    average for scores that are exchangeable with these, for any distribution.

    Source: V. Vovk, A. Gammerman and G. Shafer, "Algorithmic Learning in a Random World", Springer 2005.

    Raises
    ------
    ValueError
        The share is not between 0 and 1, or a score is not finite.
    """
    ordered = np.sort(np.asarray(scores, np.float64).ravel())
    if not 0 < false_reject < 1:
        raise ValueError(f"false_reject is {false_reject}; a share between 0 and 1 is needed, e.g. 0.02")
    if not np.isfinite(ordered).all():
        raise ValueError("a score is not finite; leave such searches out")
    place = floor(false_reject * (len(ordered) + 1) + 1e-9)
    return float(ordered[place - 1]) if place else -inf


def min_confidence_for(confidence: FloatArray, correct: NDArray[np.bool_], error_rate: float) -> float:
    """Return the smallest confidence that ends searches with no more than this share of wrong ones.

    A search, a row, ends at the first view whose leading candidate has at least this confidence; searches that never
    reach it do not count. One more error is counted than there was, so that few searches guarantee little: with fewer
    than ``1 / error_rate`` searches the result is inf.
    """
    for least in np.unique(np.concatenate([[0.5], confidence[confidence > 0.5]])).tolist():
        ends = confidence >= least
        at = np.flatnonzero(ends.any(axis=1))
        wrong = int((~correct[at, ends[at].argmax(axis=1)]).sum())
        if len(at) and (wrong + 1) / (len(at) + 1) <= error_rate:
            return float(least)
    return inf


def fit_stopping_rule(
    searches: LeaveOneOut, *, error_rate: float = 0.01, false_reject: float = 0.02, objects: int | None = None
) -> StoppingRule:
    """Fit the rule that keeps the error rates in leave-one-out searches.

    If there is too little data for a rate, the rule does what the data allows and states a limitation: a search ends at
    `UNCALIBRATED_MIN_CONFIDENCE`, and objects that score less than every search did are unknown.

    Parameters
    ----------
    searches : LeaveOneOut
        As `leave_one_out` returns it.
    error_rate, false_reject : float
        Share of wrong objects among those named, and of enrolled objects called unknown.
    objects : int, optional
        How many objects were searched for, if that was only a sample of those in the model set.
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

    # Confidence that ends a search.
    min_confidence = max(SMALLEST_MIN_CONFIDENCE, min_confidence_for(searches.confidence, searches.correct, error_rate))
    if min_confidence > 1:
        min_confidence, needed = UNCALIBRATED_MIN_CONFIDENCE, ceil(1 / error_rate)
        ended, wrong = _ended(searches, min_confidence)
        values = {"rate": error_rate, "searches": count, "needed": needed, "min_confidence": min_confidence}
        code = LimitationCode.ERROR_RATE if count < needed else LimitationCode.SIMILAR_OBJECTS
        limitations.append(Limitation(code, {**values, "wrong": wrong, "ended": len(ended)}))
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


@dataclass(frozen=True, eq=False)
class CalibratedRule:
    """A stopping rule, and what it does in the leave-one-out searches that it comes from.

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
        Searches for left-out objects that did not; None if there are too few objects to measure that.
    confused : tuple of (str, str)
        Left-out objects and the objects they were taken for, the most frequent pairs first.
    """

    rule: StoppingRule
    views: int = 1
    ended: int = 0
    wrong: int = 0
    mean_views: float = nan
    rejected: int = 0
    accepted: int | None = None
    confused: tuple[tuple[str, str], ...] = ()


def calibrate_stopping_rule(
    index: DenseIndex,
    *,
    error_rate: float = 0.01,
    false_reject: float = 0.02,
    most_searches: int = MOST_SEARCHES,
    sample: int | None = None,
    progress: Callable[[int, int], object] | None = None,
    tasks: Callable[[Callable[[Task], Found], Sequence[Task]], Iterable[tuple[Task, Found]]] | None = None,
) -> CalibratedRule:
    """Search for the enrolled objects among each other, and return the rule that follows.

    Parameters
    ----------
    index : DenseIndex
        Of at least one object.
    error_rate, false_reject
        As for `fit_stopping_rule`.
    most_searches
        Searches in all, from different first views; each object is searched for at least once.
    sample
        Search only for so many objects, among each other.
    progress, tasks
        As for `leave_one_out`.
    """
    searches = calibration_searches(index, most_searches=most_searches, sample=sample, progress=progress, tasks=tasks)
    if searches is None:
        return CalibratedRule(_rule_without_candidates(index, error_rate, false_reject))
    objects = len(index) if sample is None else min(len(index), max(2, sample))
    rule = fit_stopping_rule(searches, error_rate=error_rate, false_reject=false_reject, objects=objects)
    known, unknown = (part.open_set_score(rule.usual_scores)[:, -1] for part in (searches.known, searches.unknown))
    ended, wrong = _ended(searches, rule.min_confidence)
    accepted = unknown >= rule.open_set_thresholds[-1]
    pairs = np.stack([searches.searched, searches.unknown.object_index[:, -1]], axis=1)[accepted]
    confused, first, times = np.unique(pairs, axis=0, return_index=True, return_counts=True)
    names = index.views.object_names
    return CalibratedRule(
        rule,
        views=searches.confidence.shape[1],
        ended=len(ended),
        wrong=wrong,
        mean_views=float(ended.mean() + 1) if len(ended) else nan,
        rejected=int((known < rule.open_set_thresholds[-1]).sum()),
        accepted=int(accepted.sum()) if objects >= FEWEST_OBJECTS else None,
        confused=tuple((names[a], names[b]) for a, b in confused[np.lexsort((first, -times))].tolist()),
    )


def calibration_searches(
    index: DenseIndex,
    *,
    most_searches: int = MOST_SEARCHES,
    sample: int | None = None,
    progress: Callable[[int, int], object] | None = None,
    tasks: Callable[[Callable[[Task], Found], Sequence[Task]], Iterable[tuple[Task, Found]]] | None = None,
) -> LeaveOneOut | None:
    """Return the leave-one-out searches of a calibration; None if objects cannot be compared with each other."""
    usual_views = int(np.median((~index.left_out).sum(axis=1)))
    if len(index) < 2 or usual_views < 2:
        return None
    places = np.arange(len(index))
    if sample is not None:
        places = np.unique(np.linspace(0, len(index) - 1, max(2, sample)).astype(int))
    return leave_one_out(
        index.only(places),
        views=min(CALIBRATED_VIEWS, usual_views),
        searches=max(1, min(most_searches // len(index), int(index.rows.shape[1]))),
        progress=progress,
        tasks=tasks,
    )


def _rule_without_candidates(index: DenseIndex, error_rate: float, false_reject: float) -> StoppingRule:
    """Return the rule of a catalog in which objects cannot be compared: one object, or single views.

    One object is found if it scores at least what its own views score when they are left out one by one. With single
    views no object is called unknown.
    """
    threshold, searches, code = -inf, 0, LimitationCode.SINGLE_VIEWS
    usual = np.zeros((len(index.views.object_names), 1))
    if len(index) == 1 and len(index.views) > 1:
        code, searches = LimitationCode.ONE_OBJECT, len(index.views)
        levels, azimuth_deg = index.views.descriptors, index.views.azimuth_deg
        left_out = [
            update_belief(levels[row], azimuth_deg[row], index.without(np.array([row]))).scores()
            for row in range(searches)
        ]
        leaders = Leaders.of([leader(index.object_index, scores) for scores in left_out], (searches, 1))
        threshold = float(leaders.open_set_score(usual).min())
    return StoppingRule(
        beta=BETA,
        min_confidence=UNCALIBRATED_MIN_CONFIDENCE,
        usual_scores=usual,
        open_set_thresholds=(threshold,),
        error_rate=error_rate,
        false_reject=false_reject,
        false_accept=nan,
        searches=searches,
        limitations=(Limitation(code),),
    )


def _ended(searches: LeaveOneOut, min_confidence: float) -> tuple[NDArray[np.intp], int]:
    """Return after which view (from 0) each ended search ends at this confidence, and how many of them are wrong."""
    ends = searches.confidence >= min_confidence
    at = np.flatnonzero(ends.any(axis=1))
    view = ends[at].argmax(axis=1)
    return view, int((~searches.correct[at, view]).sum())
