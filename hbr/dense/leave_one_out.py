"""Searches for every enrolled object with its own views: the sample from which a stopping rule is fitted."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.dense.filter import BETA, Belief
from hbr.dense.index import BINS, DenseIndex

#: Weight of the margin in the open-set score, and of the leader's usual score.
_MARGIN_WEIGHT: Final = 0.5
_USUAL_WEIGHT: Final = 1.0
#: Distances of queries from their enrolled views, as shares of a step: the multiples of this number, modulo 1.
_GOLDEN: Final = 0.618034
#: Distance between the views of a search.
_STEP_DEG: Final = 90.0


Scores = TypeVar("Scores", float, FloatArray)


@dataclass(frozen=True, eq=False)
class Leaders:
    """The leading candidate after each view of each search, arrays (searches, views).

    Attributes
    ----------
    object_index : integer array
        The leading candidate.
    score, margin : float64 array
        Its score per view, and that score minus the second one.
    """

    object_index: IndexArray
    score: FloatArray
    margin: FloatArray

    @classmethod
    def of(cls, found: list[tuple[int, float, float]], shape: tuple[int, int]) -> "Leaders":
        """Return the leading candidates that `leader` found after each view of each search."""
        object_index, score, margin = zip(*found, strict=True)
        return cls(np.reshape(object_index, shape), np.reshape(score, shape), np.reshape(margin, shape))

    def open_set_score(self, usual_scores: FloatArray) -> FloatArray:
        """Return the open-set score after each view of each search, (searches, views).

        Parameters
        ----------
        usual_scores : float64 array (objects, views)
            As `usual_scores` returns it.
        """
        views = np.arange(self.score.shape[1])
        usual = usual_scores[self.object_index, views]
        return open_set_score(self.score, self.margin, usual, np.median(usual_scores, axis=0))


def open_set_score(score: Scores, margin: Scores, usual: Scores, typical: Scores) -> Scores:
    """Return the open-set score of a leading candidate.

    It is the score plus half of the margin, minus the amount by which the leader usually scores more than other
    objects. An unknown object resembles several enrolled objects a little; an enrolled object resembles one of them
    closely. An object that looks the same from all sides usually scores more, so it must match better.

    Parameters
    ----------
    score, margin
        As in `Leaders`.
    usual
        The usual score of the leader, see `usual_scores`.
    typical
        The median of the usual scores of all objects.
    """
    return score + _MARGIN_WEIGHT * margin - _USUAL_WEIGHT * (usual - typical)


Task = tuple[int, float]
"""The place of a searched object in the index, and the distance of the queries in the search before it."""


class Found(NamedTuple):
    """The searches for one object; each list has the views of the first search, then those of the second, ..."""

    known: list[tuple[int, float, float]]
    unknown: list[tuple[int, float, float]]
    confidence: list[float]
    correct: list[bool]


Tasks = Callable[[Callable[[Task], Found], Sequence[Task]], Iterable[tuple[Task, Found]]]
"""Applies a function to each task, for example in other processes; yields each task with its result, in any order."""


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
    seen: LevelArray | None = None,
    searches: int = 4,
    most_objects: int | None = None,
    step_deg: float = _STEP_DEG,
    weight: float | None = None,
    progress: Callable[[int, int], object] | None = None,
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
    seen : uint8 array (n, length), optional
        Each enrolled view as a search would see it: from a second session, or described again under the bench's noise
        and blur. The enrolled views themselves by default.
    searches : int
        Searches for each object; their first views are spread around it.
    most_objects : int, optional
        Largest number of objects that are searched for, evenly spread, among all objects.
    step_deg : float
        Distance between the views of a search.
    weight : float, optional
        Weight of each view after the first, if the views are nearly the same evidence. All views of a search then have
        the same distance from their enrolled views, because two sessions differ in all views in the same way.
    progress : callable, optional
        Called before each object with the number of objects done, and of all.
    tasks : Tasks, optional
        Applies the search for an object to each task.

    Raises
    ------
    ValueError
        There are fewer than two objects, or none with enough views.
    """
    if len(index) < 2:
        raise ValueError(f"{len(index)} object; leave-one-out searches need at least two")
    shape = len(index.views), index.length
    if seen is not None and seen.shape != shape:
        raise ValueError(f"seen has shape {seen.shape}; the catalog's views have {shape}")
    # List the objects to search for; each continues the sequence of distances, so that tasks are independent.
    counts = np.bincount(index.views.object_index)[index.object_index]
    places = np.flatnonzero(counts >= (max(views, 2) if weight is None else 2))
    if most_objects is not None and len(places) > most_objects:
        places = places[np.linspace(0, len(places) - 1, most_objects).astype(int)]
    todo, aside = [], 0.0
    for place, count in zip(places.tolist(), counts[places].tolist(), strict=True):
        todo.append((place, aside))
        drawn = views if weight is None else 1  # shares of a step that each search draws
        for _ in range(drawn * len(np.unique(np.arange(searches) * count // searches))):
            aside = (aside + _GOLDEN) % 1
    # Search, then join the results in the order of the objects.
    work = partial(_searches_for, index, beta, views, seen, searches, step_deg, weight)
    by_place: dict[int, Found] = {}
    for (place, _), found in ((one, work(one)) for one in todo) if tasks is None else tasks(work, todo):
        if progress is not None:
            progress(len(by_place), len(todo))
        by_place[place] = found
    searched, known, unknown, confidence, correct = [], [], [], [], []
    for place, _ in todo:
        one = by_place[place]
        searched += [int(index.object_index[place])] * (len(one.known) // views)
        known += one.known
        unknown += one.unknown
        confidence += one.confidence
        correct += one.correct
    if not known:
        raise ValueError(f"no object has {max(views, 2)} views; enroll more of each, or search with fewer views")
    each = -1, views
    return LeaveOneOut(
        len(index.views.object_names),
        np.array(searched),
        Leaders.of(known, each),
        Leaders.of(unknown, each),
        np.reshape(confidence, each),
        np.reshape(correct, each),
        beta,
    )


def _searches_for(
    index: DenseIndex,
    beta: float,
    views: int,
    seen: LevelArray | None,
    searches: int,
    step_deg: float,
    weight: float | None,
    task: Task,
) -> Found:
    """Search for the object at one place of the index."""
    place, aside = task
    rows = index.views.of(int(index.object_index[place]))
    rows = rows[np.argsort(index.views.azimuth_deg[rows], kind="stable")]
    azimuth_deg = index.views.azimuth_deg[rows]
    starts = np.unique(np.arange(searches) * len(rows) // searches).tolist()
    spreads = [spread(azimuth_deg, start, views, step_deg, again=weight is not None) for start in starts]
    used = np.unique(spreads)
    levels = index.views.levels(rows[used]) if seen is None else seen[rows[used]]
    similar = dict(zip(used.tolist(), index.compared.similarity(levels), strict=True))
    others = np.delete(index.object_index, place)
    found = Found([], [], [], [])
    for start, chosen in zip(starts, spreads, strict=True):
        support = np.zeros((len(index), BINS), np.float32)
        aside = aside if weight is None else (aside + _GOLDEN) % 1
        for n, i in enumerate(chosen):
            # The query lies beside its enrolled view, towards alternating neighbours.
            aside = (aside + _GOLDEN) % 1 if weight is None else aside
            neighbour = rows[(i + (1 if n % 2 else -1)) % len(rows)]
            moved = similar[i].copy()
            moved[rows[i]] -= aside * (moved[rows[i]] - moved[neighbour])
            added = index.support(moved, float(azimuth_deg[i] - azimuth_deg[start]))
            support += added if weight is None or n == 0 else added * np.float32(weight)
            weights = None if weight is None else np.concatenate([[1.0], np.full(n, weight)])
            belief = Belief(index, support, azimuth_deg[chosen[: n + 1]], weights)
            scores, probability = belief.scores(), belief.posterior(beta).sum(axis=1)
            found.known.append(leader(index.object_index, scores))
            found.unknown.append(leader(others, np.delete(scores, place)))
            found.confidence.append(float(probability.max()))
            found.correct.append(bool(probability.argmax() == place))
    return found


def leader(object_index: IndexArray, scores: FloatArray) -> tuple[int, float, float]:
    """Return the leading candidate, its score and its margin: the whole score without a second candidate."""
    best = int(scores.argmax())
    margin = scores[best] - np.partition(scores, -2)[-2] if len(scores) > 1 else scores[best]
    return int(object_index[best]), float(scores[best]), float(margin)


def usual_scores(leaders: Leaders, correct: NDArray[np.bool_], objects: int) -> FloatArray:
    """Return each object's median score in the searches that found it, (objects, views); else the median of all."""
    usual = np.full((objects, leaders.score.shape[1]), np.nan)
    for n in range(usual.shape[1]):
        for j in np.unique(leaders.object_index[correct[:, n], n]).tolist():
            usual[j, n] = np.median(leaders.score[correct[:, n] & (leaders.object_index[:, n] == j), n])
        found = usual[~np.isnan(usual[:, n]), n]
        usual[np.isnan(usual[:, n]), n] = np.median(found) if len(found) else 0.0
    return usual


def spread(
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
