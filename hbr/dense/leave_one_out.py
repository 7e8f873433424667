"""Searches for the objects of a catalog among each other, from which a stopping rule is fitted.

`leave_one_out` searches with the enrolled views, as if the camera had been beside them. `shifted_searches` searches
with views that are changed as another bench would change their description (`hbr.descriptors.base.Shift`), often by
several segmentations. Both evaluate each search twice: among all objects, and as if its object were not enrolled.
`hbr.dense.fitting` sets the thresholds from these searches.

Decision: docs/decisions/0015.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.dense.filter import BETA, Belief
from hbr.dense.index import BINS, DenseIndex, unit_rows
from hbr.dense.stopping import NUMBERS, Leaders, evidence, leader
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
#: Views of a leave-one-out search, if most objects have enough; searches of a fit.
FITTED_VIEWS: Final = 4
MOST_SEARCHES: Final = 400  # more: the rate is known better; the time of `rig catalog fit` grows in proportion
#: Largest number of objects that a fit searches for: it then measures a rate of 1 % to a third of its value.
MOST_OBJECTS: Final = 1000

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
        queries = [_segmentations(index, pair, strength[n], rng, n) for pair in pairs]
        known[n], unknown[n], correct[n] = _numbers(index, place, queries, azimuth_deg[chosen], white)
    return ShiftedSearches(strength, known, unknown, correct)


def _segmentations(
    index: DenseIndex, pair: LevelArray, strength: float, rng: np.random.Generator, bench: int
) -> LevelArray:
    """Return a view between two enrolled ones, on a changed bench, by one to three segmentations, a row for each."""
    shifted = descriptor(index.views.descriptor).shifted
    more = int(rng.choice(len(_SEVERAL), p=_SEVERAL))
    rows = []
    for one in [strength, *[max(_LEAST_WORSE, _WORSE * strength)] * more]:
        share = rng.uniform(0, 0.5)  # of the entries that come from the second view
        between = np.where(rng.random(pair.shape[1]) < share, pair[1], pair[0]).astype(np.uint8)
        rows.append(shifted(between, Shift.drawn(rng, one, bench)))
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
