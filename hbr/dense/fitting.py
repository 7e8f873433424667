"""The thresholds of the stopping rule, from searches for the objects of a catalog among each other.

`leave_one_out` searches with the enrolled views, as if the camera had been beside them. `shifted_searches` searches
with views that are changed as another bench would change their description (`hbr.descriptors.base.Shift`), often by
several segmentations. Both evaluate each search twice: among all objects, and as if its object were not enrolled.
`rule_from_searches` sets the thresholds from these searches, and `fit_open_set` fits the open-set score to changes of
the bench.

Decision: docs/decisions/0015.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import ceil, floor, inf, nan
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.dense.filter import BETA, Belief, update_belief
from hbr.dense.index import BINS, DenseIndex, unit_rows
from hbr.dense.stopping import (
    NUMBERS,
    Leaders,
    Limitation,
    LimitationCode,
    OpenSetModel,
    ShiftRates,
    StoppingRule,
    evidence,
    fitted_before,
    leader,
    open_set_score,
    usual_scores,
)
from hbr.descriptors import descriptor
from hbr.descriptors.base import Shift

#: Distances of queries from their enrolled views, as shares of a step: the multiples of this number, modulo 1.
_GOLDEN: Final = 0.618034  # the golden ratio: its multiples are evenly spread for every number of them
#: Distance between the views of a search.
# as the sweep of a search at rest; views that are nearer are too alike to be counted as several
_STEP_DEG: Final = 90.0
#: Numbers of each view of a leave-one-out search: what `leader` returns among all objects and among the others, the
#: probability of the likeliest object, and whether that is the searched one.
NUMBERS_OF_VIEW: Final = 8
#: Strengths of the changes of the bench, in turn; 1 is a hard change.
STRENGTHS: Final = (0.0, 0.25, 0.5, 1.0, 1.3)
#: Probabilities of one, two and three segmentations of a view, as searches without an empty-table image have them.
_SEVERAL: Final = (0.45, 0.35, 0.2)
#: Strength of the change in further segmentations, which are worse: relative to the first one, and the smallest.
_WORSE: Final = 1.6
_LEAST_WORSE: Final = 0.7
#: With more views, the whitened descriptions of all of them would take too much memory.
_MOST_VIEWS: Final = 20_000
_SEED: Final = 20  # any number: the same catalog must give the same rule

Task = tuple[int, float]
"""The place of a searched object in the index, and the distance of the queries in the search before it."""
Tasks = Callable[[Callable[[Task], FloatArray], Sequence[Task]], Iterable[tuple[Task, FloatArray]]]
"""Applies a function to each task, for example in other processes; yields each task with its result, in any order. The
results are float64 arrays (searches, views, 8)."""


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """Searches for every object with its own enrolled views; arrays of (searches, views).

    Attributes
    ----------
    objects : int
        Names in the model set.
    searched : integer array (searches,)
        The object of each search.
    known : Leaders
        Among all enrolled objects.
    unknown : Leaders
        The same searches as if the searched object were not enrolled.
    confidence : float64 array
        Probability of the leading candidate among all objects.
    correct : bool array
        Whether the leading candidate is the searched object.
    beta : float
        As for `Belief.posterior`.
    """

    objects: int
    searched: IndexArray
    known: Leaders
    unknown: Leaders
    confidence: FloatArray
    correct: NDArray[np.bool_]
    beta: float


def leave_one_out(
    index: DenseIndex,
    *,
    beta: float = BETA,
    views: int = 4,
    searches: int = 4,
    most_objects: int | None = None,
    step_deg: float = _STEP_DEG,
    weight: float | None = None,
    tasks: Tasks | None = None,
) -> LeaveOneOut:
    """Search for every object with its own enrolled views, as if the camera had been beside their azimuths.

    A query beside an enrolled view, at the share u of a step, is less similar to that view by u times the difference
    to its neighbour. Real queries are at most half a step away; u is spread over 0..1 because light and noise make
    views differ, too.

    Parameters
    ----------
    index : DenseIndex
        Of at least two objects. Objects with fewer than ``views`` views, or with a single one, are not searched for.
    beta : float
        As for `Belief.posterior`.
    views : int
        Views of a search.
    searches : int
        Searches for each object; their first views are spread around it.
    most_objects : int, optional
        Largest number of objects that are searched for, evenly spread, among all objects.
    step_deg : float
        Distance between the views of a search.
    weight : float, optional
        Weight of each view after the first, if the views are nearly the same evidence. All views of a search then have
        the same distance from their enrolled views, because two sessions differ in all views in the same way.
    tasks : Tasks, optional
        Applies the search for an object to each task.

    Raises
    ------
    ValueError
        There are fewer than two objects, or none with enough views.
    """
    if len(index) < 2:
        raise ValueError(f"{len(index)} object; leave-one-out searches need at least two")
    # List the objects to search for; each continues the sequence of distances, so that tasks are independent.
    places = np.flatnonzero(index.view_counts >= (max(views, 2) if weight is None else 2))
    if not len(places):
        raise ValueError(f"no object has {max(views, 2)} views; enroll more of each, or search with fewer views")
    if most_objects is not None and len(places) > most_objects:
        places = places[np.linspace(0, len(places) - 1, most_objects).astype(int)]
    todo, aside = [], 0.0
    for place, count in zip(places.tolist(), index.view_counts[places].tolist(), strict=True):
        todo.append((place, aside))
        drawn = views if weight is None else 1  # shares of a step that each search draws
        for _ in range(drawn * len(_starts(searches, count))):
            aside = (aside + _GOLDEN) % 1
    # Search, then join the results in the order of the objects.
    work = partial(_searches_for, index, beta, views, searches, step_deg, weight)
    done = ((one, work(one)) for one in todo) if tasks is None else tasks(work, todo)
    by_place = {place: found for (place, _), found in done}
    numbers = np.concatenate([by_place[place] for place, _ in todo])
    return LeaveOneOut(
        len(index.views.object_names),
        np.repeat(index.object_index[places], [len(by_place[place]) for place, _ in todo]),
        Leaders.of(numbers[..., :3]),
        Leaders.of(numbers[..., 3:6]),
        numbers[..., 6],
        numbers[..., 7] > 0,
        beta,
    )


def _searches_for(
    index: DenseIndex, beta: float, views: int, searches: int, step_deg: float, weight: float | None, task: Task
) -> FloatArray:
    """Search for the object at one place of the index; return the numbers of each view, (searches, views, 8)."""
    place, aside = task
    rows = index.rows_of(place)
    azimuth_deg = index.views.azimuth_deg[rows]
    spreads = [
        _spread(azimuth_deg, start, views, step_deg, again=weight is not None) for start in _starts(searches, len(rows))
    ]
    used = np.unique(spreads)
    similar = dict(zip(used.tolist(), index.compared.similarity(index.views.levels(rows[used])), strict=True))
    others = np.delete(index.object_index, place)
    numbers = np.empty((len(spreads), views, NUMBERS_OF_VIEW))
    for search, chosen in enumerate(spreads):
        support = np.zeros((len(index), BINS), np.float32)
        aside = aside if weight is None else (aside + _GOLDEN) % 1
        for n, i in enumerate(chosen):
            # The query lies beside its enrolled view, towards alternating neighbours.
            aside = (aside + _GOLDEN) % 1 if weight is None else aside
            neighbour = rows[(i + (1 if n % 2 else -1)) % len(rows)]
            moved = similar[i].copy()
            moved[rows[i]] -= aside * (moved[rows[i]] - moved[neighbour])
            added = index.support(moved, float(azimuth_deg[i] - azimuth_deg[chosen[0]]))
            support += added if weight is None or n == 0 else added * np.float32(weight)
            weights = None if weight is None else np.concatenate([[1.0], np.full(n, weight)])
            belief = Belief(index, support, azimuth_deg[chosen[: n + 1]], weights)
            scores, (likeliest, confidence) = belief.scores(), belief.likeliest(beta)
            known, unknown = leader(index.object_index, scores), leader(others, np.delete(scores, place))
            numbers[search, n] = (*known, *unknown, confidence, likeliest == place)
    return numbers


def _starts(searches: int, views: int) -> list[int]:
    """Return the first views of the searches for an object, spread around it."""
    starts: list[int] = np.unique(np.arange(searches) * views // searches).tolist()
    return starts


def _spread(
    azimuth_deg: FloatArray, start: int, count: int, step_deg: float = _STEP_DEG, *, again: bool = False
) -> list[int]:
    """Return the indices of ``count`` views, a step apart, from ``start`` on; all different unless ``again`` is set."""
    chosen = [start]
    for n in range(1, count):
        away = np.abs((azimuth_deg - azimuth_deg[start] - n * step_deg + 180) % 360 - 180)
        if not again:
            away[chosen] = np.inf
        chosen.append(int(away.argmin()))
    return chosen


@dataclass(frozen=True, eq=False)
class ShiftedSearches:
    """Searches under changes of the bench, one after the other.

    Attributes
    ----------
    strength : float64 array (searches,)
        Of the change, as an element of `STRENGTHS`.
    known, unknown : float64 arrays (searches, views, 7)
        The numbers of `hbr.dense.stopping.NUMBERS`, with the object enrolled, and without it.
    correct : bool array (searches, views)
        Whether the object is the leading candidate, if it is enrolled.
    """

    strength: FloatArray
    known: FloatArray
    unknown: FloatArray
    correct: NDArray[np.bool_]


def can_shift(index: DenseIndex) -> bool:
    """Return whether the descriptor can compute its levels on another bench."""
    kind = descriptor(index.views.descriptor)
    row = index.views.levels(np.array([0]))[0]
    hard = Shift.drawn(np.random.default_rng(_SEED), 2.0)
    return not np.array_equal(kind.shifted(row, hard), row)


def shifted_searches(index: DenseIndex, *, views: int, searches: int) -> ShiftedSearches:
    """Search for the objects of an index in turn, each time with the same number of views.

    Objects with fewer views are left out. Every object is searched for under each strength before one is repeated.
    """
    rng = np.random.default_rng(_SEED)
    places = np.flatnonzero(index.view_counts >= max(2, views)).tolist()
    if not places:
        raise ValueError(f"no object has {max(2, views)} views; enroll more of each, or search with fewer views")
    every = np.arange(len(index.views))
    white = index.whitening.white(index.views.levels(every)) if len(every) <= _MOST_VIEWS else None
    strength = np.empty(searches)
    known, unknown = np.empty((2, searches, views, len(NUMBERS)))
    correct = np.empty((searches, views), np.bool_)
    for n in range(searches):
        rows = index.rows_of(place := places[n % len(places)])
        azimuth_deg = index.views.azimuth_deg[rows]
        chosen = _spread(azimuth_deg, int(rng.integers(len(rows))), views)
        # a different strength in each round, and for neighbouring objects
        strength[n] = STRENGTHS[(n // len(places) + n) % len(STRENGTHS)]
        pairs = [index.views.levels(rows[[i, (i + 1) % len(rows)]]) for i in chosen]
        queries = [_segmentations(index, pair, strength[n], rng) for pair in pairs]
        known[n], unknown[n], correct[n] = _numbers(index, place, queries, azimuth_deg[chosen], white)
    return ShiftedSearches(strength, known, unknown, correct)


def _segmentations(index: DenseIndex, pair: LevelArray, strength: float, rng: np.random.Generator) -> LevelArray:
    """Return a view between two enrolled ones, on a changed bench, by one to three segmentations, a row for each."""
    shifted = descriptor(index.views.descriptor).shifted
    more = int(rng.choice(len(_SEVERAL), p=_SEVERAL))
    rows = []
    for one in [strength, *[max(_LEAST_WORSE, _WORSE * strength)] * more]:
        share = rng.uniform(0, 0.5)  # of the entries that come from the second view
        between = np.where(rng.random(pair.shape[1]) < share, pair[1], pair[0]).astype(np.uint8)
        rows.append(shifted(between, Shift.drawn(rng, one)))
    return np.stack(rows)


def _numbers(
    index: DenseIndex, place: int, queries: list[LevelArray], azimuth_deg: FloatArray, white: FloatArray | None
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return the numbers of a search after each view, with its object and without it, and where the object leads.

    Without the object, the whitening leaves out its views, too: they would make it less similar to the others than an
    unknown object is.
    """

    def whitened(some: IndexArray) -> FloatArray:
        return index.whitening.white(index.views.levels(some)) if white is None else white[some]

    left_out = index.whitening.without(index.rows_of(place))
    in_white = [index.whitening.white(query) for query in queries]
    units, others = [unit_rows(one) for one in in_white], [left_out(one) for one in in_white]
    support = np.zeros((len(index), BINS), np.float32)
    known, unknown = np.zeros((2, len(queries), len(NUMBERS)))
    correct = np.zeros(len(queries), np.bool_)
    for n, query in enumerate(queries):
        support += index.support(index.similarity(query), float(azimuth_deg[n] - azimuth_deg[0]))
        belief = Belief(index, support, azimuth_deg[: n + 1])
        best, known[n] = evidence(belief, units[: n + 1], lambda some: unit_rows(whitened(some)))
        _, unknown[n] = evidence(belief, others[: n + 1], lambda some: left_out(whitened(some)), place)
        correct[n] = best == place
    return known, unknown, correct


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
#: Views of a leave-one-out search, if most objects have enough; searches of a fit.
FITTED_VIEWS: Final = 4
MOST_SEARCHES: Final = 400  # more: the rate is known better; the time of `rig catalog fit` grows in proportion
#: Largest number of objects that a fit searches for: it then measures a rate of 1 % to a third of its value.
MOST_OBJECTS: Final = 1000


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


def fitting_searches(
    index: DenseIndex,
    *,
    most_searches: int = MOST_SEARCHES,
    sample: int | None = None,
    tasks: Tasks | None = None,
) -> LeaveOneOut | None:
    """Return the leave-one-out searches of a fit; None if objects cannot be compared with each other."""
    chosen = searched_objects(index, most_searches, sample)
    if chosen is None:
        return None
    some, each, views = chosen
    return leave_one_out(
        some,
        views=min(FITTED_VIEWS, views),
        searches=each,
        most_objects=MOST_OBJECTS,
        tasks=tasks,
    )


def searched_objects(
    index: DenseIndex, most_searches: int, sample: int | None = None
) -> tuple[DenseIndex, int, int] | None:
    """Return an index of the objects to search for among each other, the searches for each, and their usual views.

    None if objects cannot be compared with each other. A ``sample`` is spread evenly; by default all are searched for.
    """
    usual_views = int(np.median(index.view_counts))
    if len(index) < 2 or usual_views < 2:
        return None
    each = max(1, min(most_searches // len(index), int(index.view_counts.max())))
    if sample is not None:
        index = index.only(np.unique(np.linspace(0, len(index) - 1, max(2, sample)).astype(int)))
    return index, each, usual_views


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
