"""Searches whose object is replaced or rotated by hand: how soon they notice it, and how often they do so wrongly.

Each search takes some views of one object, and then views of another one, or of the same one after a rotation by hand.
It does not end before, so that there is a rate for every object. At rest, the search chooses its views. In motion, the
table rotates to one side, and the photographs on the way are its frames. The search is that of the bench, with its test
whether the object changed (`hbr.dense.change`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from hbr.core.angles import size_deg, wrap180
from hbr.core.arrays import FloatArray, LevelArray
from hbr.dense.arc import ArcSession, frame_weight
from hbr.dense.filter import Belief, update_belief
from hbr.dense.index import DenseIndex
from hbr.dense.session import DenseSession
from hbr.dense.stopping import Outcome
from hbr.evaluation.condition import enrolled_levels, query_levels
from hbr.evaluation.experiment import Experiment, Kind
from hbr.evaluation.photographs import Dataset
from hbr.evaluation.protocol import generator, index_of, views_of_trial
from hbr.evaluation.statistics import wilson
from hbr.evaluation.trials import all_views
from hbr.model.views import Views


class _Way(NamedTuple):
    """A way to search: the first and last number of views before a change, those since, and those without a change."""

    name: str
    first: int
    last: int
    since: int
    stays: int


#: At rest, as many views as a search on the bench takes at most; in motion, the longest arc, and a quarter revolution.
_WAYS: Final = (_Way("at rest", 1, 3, 3, 8), _Way("in motion", 3, 21, 18, 42))
_FRAME_DEG: Final = 5.0  # the photographs of COIL-100
_MOTION_EVERY: Final = 5  # a trial in motion takes as long as several at rest
#: What happens to the object, and whether the objects before and after it are enrolled.
_CASES: Final = (
    ("stays", True, True),
    ("stays", False, False),
    ("replaced", True, True),
    ("replaced", True, False),
    ("replaced", False, True),
    ("replaced", False, False),
    ("rotated", True, True),
)
_LEAST_ROTATION_DEG: Final = 30.0  # by hand


@dataclass(frozen=True, slots=True)
class ReplacedSearch:
    """One search.

    Attributes
    ----------
    way, case, before_enrolled, after_enrolled
        How it was made.
    running : bool
        Whether its stopping rule would have let it go on until the change.
    noticed : int or None
        Number of views since the change with which it began again; None: it did not.
    wrong, wrong_running : bool
        Whether it began again while the object was the same, and whether its stopping rule would not have ended it yet.
    right, right_without : bool
        Whether the object on the table leads after the last view, and whether it does so without the test.
    """

    way: str
    case: str
    before_enrolled: bool
    after_enrolled: bool
    running: bool
    noticed: int | None
    wrong: bool
    wrong_running: bool
    right: bool
    right_without: bool


class _Described(NamedTuple):
    enrolled: LevelArray
    queries: LevelArray


class _Queries(NamedTuple):
    """The views of an object that are not enrolled."""

    levels: LevelArray
    azimuth_deg: FloatArray


class _Model(NamedTuple):
    enrolled: Views
    queries: tuple["_Queries", ...]


def _enroll(experiment: Experiment, dataset: Dataset, j: int) -> _Described:
    condition, seed = experiment.condition, experiment.protocol.seed
    return _Described(enrolled_levels(dataset, j, condition), query_levels(dataset, j, condition, seed))


def _model(experiment: Experiment, dataset: Dataset, described: list[_Described]) -> _Model:
    views = all_views(experiment, dataset, [one.enrolled for one in described])
    is_enrolled = views_of_trial(views, experiment.protocol)
    queries = []
    for j, one in enumerate(described):
        free = ~is_enrolled[rows := views.of(j)]
        queries.append(_Queries(one.queries[free], views.azimuth_deg[rows][free]))
    return _Model(views.select(is_enrolled), tuple(queries))


def _search(
    experiment: Experiment, dataset: Dataset, model: _Model, _now_ns: Callable[[], int], j: int
) -> list[ReplacedSearch]:
    enrolled, others = index_of(model.enrolled), [k for k in range(len(dataset.objects)) if k != j]
    results = []
    for trial in range(experiment.protocol.trials):
        for way in _WAYS[: 1 if trial % _MOTION_EVERY else 2]:
            for number, (case, before, after) in enumerate(_CASES):
                rng = generator(
                    experiment.protocol.seed, dataset.objects[j].name, "trial", trial * len(_CASES) + number
                )
                pair = (j, int(rng.choice(others)) if case == "replaced" else j)
                absent = [k for k, is_enrolled in zip(pair, (before, after), strict=True) if not is_enrolled]
                index = enrolled.only(np.flatnonzero(~np.isin(enrolled.object_index, absent)))
                found = _searched(experiment, model, index, way, case, pair, rng)
                results.append(ReplacedSearch(way.name, case, before, after, *found))
    return results


def _searched(
    experiment: Experiment,
    model: _Model,
    index: DenseIndex,
    way: _Way,
    case: str,
    pair: tuple[int, int],
    rng: np.random.Generator,
) -> tuple[bool, int | None, bool, bool, bool, bool]:
    """Search once, and return the last fields of `ReplacedSearch`; ``pair`` has the objects before and after."""
    is_moving = way.name == "in motion"
    session = ArcSession(index) if is_moving else DenseSession(index)
    without: DenseIndex | Belief = index
    starts_deg = rng.uniform(0, 360, 2)
    if case == "rotated":
        starts_deg[1] = starts_deg[0] + rng.uniform(_LEAST_ROTATION_DEG, 360 - _LEAST_ROTATION_DEG)
    before = way.stays if case == "stays" else int(rng.integers(way.first, way.last + 1))
    running, noticed, wrong, wrong_running, camera_deg = True, None, False, False, 0.0
    for n in range(before if case == "stays" else before + way.since):
        after = int(n >= before)
        queries = model.queries[pair[after]]
        away_deg = wrap180(queries.azimuth_deg - starts_deg[after] - camera_deg)
        place = int(np.abs(away_deg).argmin())
        measured_deg = camera_deg + float(away_deg[place]) + rng.normal(0, experiment.protocol.sigma_deg)
        weight = None
        if is_moving and isinstance(without, Belief):
            weight = frame_weight(float(size_deg(without.orientation_deg - measured_deg).min()))
        without = update_belief(queries.levels[place], measured_deg, without, weight=weight)
        session.add(queries.levels[place], measured_deg)
        if session.change is not None and after:
            noticed = noticed or n - before + 1
        elif session.change is not None:
            wrong, wrong_running = True, wrong_running or running
        if not after:
            running = running and session.decision.outcome is Outcome.CONTINUE
        camera_deg += _FRAME_DEG if is_moving else session.next_best_view().rotation_deg
    assert isinstance(without, Belief)
    leads = [int(one.index.object_index[one.likeliest()[0]]) for one in (session.belief, without)]
    return running, noticed, wrong, wrong_running, leads[0] == pair[1], leads[1] == pair[1]


def _results(
    experiment: Experiment, dataset: Dataset, _model: _Model, found: list[list[ReplacedSearch]]
) -> dict[str, Any]:
    searches = [one for own in found for one in own]
    rows = [_row(way, *case, searches) for way in _WAYS for case in _CASES]
    return {"settings": experiment.settings(dataset), "rows": rows}


def _row(way: _Way, case: str, before: bool, after: bool, searches: list[ReplacedSearch]) -> dict[str, Any]:
    """Return the shares of the searches of one case, with Wilson's intervals of the main ones."""
    key = (way.name, case, before, after)
    own = [one for one in searches if (one.way, one.case, one.before_enrolled, one.after_enrolled) == key]
    running = [one for one in own if one.running]

    def share(name: str, some: list[ReplacedSearch], is_so: Callable[[ReplacedSearch], bool]) -> dict[str, float]:
        hits, (low, high) = sum(map(is_so, some)), (0.0, 1.0)
        if some:
            low, high = wilson(hits, len(some))
        return {name: hits / max(1, len(some)), f"{name}_low": low, f"{name}_high": high}

    def noticed_within(part: float) -> Callable[[ReplacedSearch], bool]:
        return lambda one: one.noticed is not None and one.noticed <= way.since * part

    row: dict[str, Any] = dict(zip(("way", "case", "before_enrolled", "after_enrolled"), key, strict=True))
    row |= {"searches": len(own), "running": len(running)}
    for third in (1, 2, 3):
        row |= share(f"noticed_{third}", own, noticed_within(third / 3))
    row |= share("noticed_running", running, noticed_within(1))
    row |= share("wrong", own, lambda one: one.wrong)
    row |= share("wrong_running", own, lambda one: one.wrong_running)
    row |= share("right", own, lambda one: one.right)
    return row | share("right_without", own, lambda one: one.right_without)


REPLACED: Final = Kind(_enroll, _model, _search, _results)
