"""Searches by image after a change of the bench: rates of right decisions and of accepted unknown objects.

Objects are enrolled on one drawn bench. Each search is a visit to the same bench (mild change), or to one of twelve
other benches (hard change). It takes up to eight views: four that are 90° apart, and then those between them. Every
ninth object is never enrolled. Without a change, the photographs are used as they are, all objects are enrolled, and
the views of searches are those that are not enrolled. The drawn benches have texture and clutter, or all of them have
one plain backdrop with a visible platter.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache, lru_cache, partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap180
from hbr.core.arrays import ImageArray, LevelArray
from hbr.dense.index import DenseIndex
from hbr.dense.pixel_fit import LocalView
from hbr.dense.pose import pose
from hbr.dense.session import DenseSession, answered, near
from hbr.dense.stopping import Outcome
from hbr.descriptors.together import ViewsTogether
from hbr.drawing.bench import ENROLLMENT, HARD, MILD, DrawnBench, Visit
from hbr.evaluation.experiment import Experiment, Kind
from hbr.evaluation.photographs import Dataset, PhotographedObject, object_mask, read_photograph, without_specks
from hbr.evaluation.poses import StatedPose, pose_rates, stated_pose
from hbr.evaluation.protocol import generator, index_of, views_enrolled
from hbr.evaluation.statistics import bootstrap_mean
from hbr.model.views import Views
from hbr.segmentation import Background

#: Largest number of views of a search, as on the rig, and where they are relative to the first one.
MAX_VIEWS: Final = 8
_VIEWS_DEG: Final = np.array([0, 90, 180, 270, 45, 135, 225, 315], np.float64)
#: Views whose leading object is recorded, even if the search has ended.
_RANKED: Final = 4
_BENCHES: Final = 12  # more: the result depends less on one drawing; each process draws them once
_NEVER_ENROLLED: Final = 9  # every ninth object, so that rates of unknown objects have a number of cases, too
#: Objects whose enrolled views each process remembers for the last steps of searches, 4 MB each with 36 views.
_REMEMBERED: Final = 128
#: Shares of `summary` with an interval.
INTERVALS: Final = (
    *("hit_rate_1", "hit_rate_2", "hit_rate_4", "decided_right", "ambiguous", "called_unknown", "decided_wrong"),
    "left_out_accepted",
)


@dataclass(frozen=True)
class SearchResult:
    """A search, with the leading object after each view."""

    leaders: tuple[str, ...]
    """After 1, 2, 3 and 4 views."""
    outcome: Outcome
    decided: str
    """The leading object at the end."""
    views: int
    """Views until the end."""
    pose: StatedPose = field(default=StatedPose(0))
    """Of the leading object at the end."""
    verified: bool = False
    """Whether the last views were compared with enrolled ones, pixel by pixel (`hbr.dense.session`)."""
    probability: float = 0.0
    not_enrolled: float = 0.0
    """Stated probabilities of the decided object, and that the object is not enrolled."""
    left_out: Outcome | None = None
    """Outcome of the same search if the object is not enrolled; None if it never was."""
    left_out_probability: float | None = None
    left_out_not_enrolled: float | None = None
    """The stated probabilities of that search."""


@dataclass(frozen=True, eq=False)
class EnrolledViews:
    """The enrolled views of an object: levels uint8 (n, length), azimuths (n,), and what was cut out."""

    levels: LevelArray
    azimuth_deg: NDArray[np.float64]
    cut_outs: tuple[LocalView, ...]


class _Scene(NamedTuple):
    """What the camera sees during an enrollment or a search: frames and the empty table, uint8 (H, W, 3)."""

    frame: Callable[[PhotographedObject, int], ImageArray]
    """Of an object, and the place of the photograph that shows it."""
    empty: Callable[[], ImageArray] | None = None
    """None: the photographs as they are, which have no empty table."""


def enroll_changed(item: PhotographedObject, experiment: Experiment) -> EnrolledViews:
    """Return an object's enrolled views.

    Raises
    ------
    DatasetError
        A photograph cannot be used.
    """
    scene = _enrollment_scene(experiment)
    places = _enrolled_places(item, experiment)
    views, empty = ViewsTogether(experiment.condition.descriptor, several=False), _empty_table(scene, experiment)
    table = None if empty is None else Background(empty)
    for place in places:
        views.learn(scene.frame(item, place), table)
    views.revise()
    azimuths_deg = item.azimuth_deg[places]
    cuts = zip(views.segmentations, azimuths_deg.tolist(), strict=True)
    return EnrolledViews(
        np.stack([levels[0] for levels in views.levels]),
        azimuths_deg,
        tuple(LocalView(cut.crop, cut.mask, deg) for (cut, *_), deg in cuts),
    )


def search_changed(
    item: PhotographedObject,
    experiment: Experiment,
    index: DenseIndex,
    enrolled: Callable[[str], EnrolledViews],
) -> list[SearchResult]:
    """Search for an object, once for each trial.

    As on the rig, the empty-table image is compared with that of the enrollment. An enrolled object is also searched
    for as if it were not enrolled. ``enrolled`` returns the enrolled views of an object, for the pixel by pixel
    comparisons.

    Raises
    ------
    DatasetError
        A photograph cannot be used.
    """
    results = []
    left_out = _without(index, item.name)
    for views_so_far in searches(item, experiment):
        search = _Search(index, enrolled, views_so_far.most)
        without = None if left_out is None else _Search(left_out, enrolled, views_so_far.most)
        both = [search] if without is None else [search, without]
        for views, azimuth_deg in views_so_far.views:
            for one in both:
                one.add(views, azimuth_deg, views_so_far.other_bench)
            if all(one.is_done for one in both):
                break
        result = search.result()
        if without is not None:
            other = without.result()
            result = replace(
                result,
                left_out=other.outcome,
                left_out_probability=other.probability,
                left_out_not_enrolled=other.not_enrolled,
            )
        results.append(result)
    return results


class SearchViews(NamedTuple):
    """The views of a search."""

    views: Iterator[tuple[ViewsTogether, float]]
    """Yields the views so far, and the azimuth of the last one in degrees."""
    most: int
    """Number of views."""
    other_bench: bool
    """Whether its empty-table image certainly shows another bench than that of the enrollment."""


def searches(item: PhotographedObject, experiment: Experiment) -> Iterator[SearchViews]:
    """Yield a search for each trial.

    Raises
    ------
    DatasetError
        A photograph cannot be used.
    """
    enrolled_empty = _empty_table(_enrollment_scene(experiment), experiment)
    before = None if enrolled_empty is None else Background(enrolled_empty)
    for trial in range(experiment.protocol.trials):
        rng = generator(experiment.protocol.seed, item.name, "trial", trial)
        scene = _search_scene(experiment, rng)
        places = _query_places(item, experiment, rng.uniform(0, 360) + _VIEWS_DEG)
        empty = _empty_table(scene, experiment)
        other_bench = before is not None and empty is not None and before.shows_another_bench(empty)
        yield SearchViews(_views_so_far(item, experiment, scene, empty, places), len(places), other_bench)


def _views_so_far(
    item: PhotographedObject,
    experiment: Experiment,
    scene: _Scene,
    empty: ImageArray | None,
    places: Sequence[int],
) -> Iterator[tuple[ViewsTogether, float]]:
    views = ViewsTogether(experiment.condition.descriptor)
    table = None if empty is None else Background(empty)
    for place in places:
        views.add(scene.frame(item, place), table)
        yield views, item.photographs[place].azimuth_deg


class _Search:
    """A search that continues after its end, to record the leading object after each view."""

    def __init__(self, index: DenseIndex, enrolled: Callable[[str], EnrolledViews], most: int) -> None:
        self._session = DenseSession(index, max_views=most, most_changes=0)
        self._names = index.views.object_names
        self._enrolled = enrolled
        self._leaders: list[str] = []
        self._result: SearchResult | None = None

    def add(self, views: ViewsTogether, azimuth_deg: float, other_bench: bool) -> None:
        if self.is_done:
            return
        session = self._session
        *earlier, levels = views.levels
        session.add(levels, azimuth_deg, earlier=earlier, reliable=views.reliable, other_bench=other_bench)
        if len(self._leaders) < _RANKED:
            self._leaders.append(self._names[int(session.belief.ranking().object_index[0])])
        if self._result is not None:
            return
        orientations_deg = session.belief.orientation_deg.tolist()

        def queries(n: int) -> list[LocalView]:
            return [LocalView(one.crop, one.mask, orientations_deg[n]) for one in views.segmentations[n]]

        answered(session.verify(queries), self._near)
        if session.decision.outcome is not Outcome.CONTINUE:
            end = session.decision
            self._result = SearchResult(
                (),
                end.outcome,
                self._names[end.object_index],
                len(views.levels),
                self._stated(end.object_index),
                session.verification is not None,
                end.probability,
                end.not_enrolled,
            )

    @property
    def is_done(self) -> bool:
        return self._result is not None and len(self._leaders) == _RANKED

    def _stated(self, leader: int) -> StatedPose:
        belief = self._session.belief
        views = belief.index.views
        enrolled_deg = views.azimuth_deg[views.of(leader)]
        return stated_pose(pose(belief, leader), float(belief.orientation_deg[-1]), enrolled_deg)

    def _near(self, leader: int, azimuths_deg: Sequence[float]) -> list[LocalView]:
        enrolled = self._enrolled(self._names[leader])
        return [enrolled.cut_outs[place] for place in near(enrolled.azimuth_deg, azimuths_deg)]

    def result(self) -> SearchResult:
        assert self._result is not None  # after the last view
        return replace(self._result, leaders=tuple(self._leaders))


def _without(index: DenseIndex, name: str) -> DenseIndex | None:
    """Return the index as if an object were not enrolled; None if it is not."""
    if name not in index.views.object_names:
        return None
    # a new index: the space of this one contains the object's views
    return DenseIndex(index.views.select(index.views.object_index != index.views.object_names.index(name)))


def summary(
    known: dict[str, list[SearchResult]], unknown: dict[str, list[SearchResult]]
) -> dict[str, float | int | None]:
    """Return the rates of each outcome, for enrolled objects and for others, by names with units.

    Of all searches that ended with an object, for enrolled objects and for left-out ones, ``accepted_stated`` is the
    mean stated probability, and ``accepted_right`` the share of right ones. The keys ``..._not_enrolled`` have the mean
    stated probability that the object is not enrolled.
    """
    searches = [(name, one) for name, results in known.items() for one in results]
    others = [one for results in unknown.values() for one in results]
    count, unknown_count = max(1, len(searches)), max(1, len(others))
    found = [(name, one) for name, one in searches if one.outcome is Outcome.FOUND]
    left_out = [one for _, one in searches if one.left_out is not None]
    accepted = [one for one in left_out if one.left_out is Outcome.FOUND]
    stated = [one.probability for _, one in found] + [one.left_out_probability for one in accepted]
    return {
        "searches": len(searches),
        **{f"hit_rate_{n}": sum(one.leaders[n - 1] == name for name, one in searches) / count for n in (1, 2, _RANKED)},
        "decided_right": sum(one.decided == name for name, one in found) / count,
        "decided_wrong": sum(one.decided != name for name, one in found) / count,
        "called_unknown": sum(one.outcome is Outcome.UNKNOWN for _, one in searches) / count,
        "ambiguous": sum(one.outcome is Outcome.AMBIGUOUS for _, one in searches) / count,
        "verified": sum(one.verified for _, one in searches) / count,
        "mean_views": sum(one.views for _, one in found) / max(1, len(found)),
        **pose_rates(np.array([one.pose for name, one in found if one.decided == name], np.float64).reshape(-1, 4)),
        "unknown_searches": len(others),
        "unknown_accepted": sum(one.outcome is Outcome.FOUND for one in others) / unknown_count,
        "unknown_called_unknown": sum(one.outcome is Outcome.UNKNOWN for one in others) / unknown_count,
        "left_out_searches": len(left_out),
        "left_out_accepted": len(accepted) / max(1, len(left_out)),
        "accepted_searches": len(stated),
        "accepted_stated": _mean(stated),
        "accepted_right": _mean([one.decided == name for name, one in found] + [False] * len(accepted)),
        "enrolled_not_enrolled": _mean([one.not_enrolled for _, one in searches]),
        "left_out_not_enrolled": _mean([one.left_out_not_enrolled for one in left_out]),
    }


def _mean(values: Sequence[float | None]) -> float | None:
    return float(np.mean(np.array(values, np.float64))) if values else None


def intervals(known: dict[str, list[SearchResult]], rng: np.random.Generator) -> dict[str, float]:
    """Return the 95 % interval of each of `INTERVALS` for enrolled objects, by resampling them."""
    by_object = [summary({name: results}, {}) for name, results in known.items()]
    found: dict[str, float] = {}
    for share in INTERVALS:
        low, high = bootstrap_mean(np.array([one[share] for one in by_object]), rng)
        found |= {f"{share}_low": low, f"{share}_high": high}
    return found


def is_enrolled(place: int, experiment: Experiment) -> bool:
    """Return whether the object at this place of the data set is enrolled."""
    return experiment.change == "none" or (place + 1) % _NEVER_ENROLLED != 0


def _drawn_scene(visit: Visit) -> _Scene:
    """Return an object that is cut out of its photographs, on a drawn bench."""

    def frame(item: PhotographedObject, place: int) -> ImageArray:
        image = read_photograph(item.photographs[place].path)
        mask = without_specks(object_mask(image))
        return visit.photograph(image, mask, item.photographs[place].azimuth_deg).image

    return _Scene(frame, visit.empty)


def _own_scene(experiment: Experiment, seed: int | None = None) -> _Scene:
    """Return the photographs as they are; ``seed`` draws the noise of queries, None: they are enrolled."""
    shown = experiment.condition.shown
    return _Scene(lambda item, place: shown(item.photographs[place].read(), item.name, place, seed))


def _enrollment_scene(experiment: Experiment) -> _Scene:
    if experiment.change == "none":
        return _own_scene(experiment)
    return _drawn_scene(Visit(_enrollment_bench(experiment.plain), ENROLLMENT, np.random.default_rng(1)))


def _search_scene(experiment: Experiment, rng: np.random.Generator) -> _Scene:
    if experiment.change == "none":
        return _own_scene(experiment, experiment.protocol.seed)
    hard = experiment.change == "hard"
    bench = _benches(experiment.plain)[int(rng.integers(_BENCHES))] if hard else _enrollment_bench(experiment.plain)
    return _drawn_scene(Visit(bench, HARD if hard else MILD, rng))


def _empty_table(scene: _Scene, experiment: Experiment) -> ImageArray | None:
    """Return the empty-table image of a scene, None if the experiment uses none."""
    return scene.empty() if experiment.picture and scene.empty is not None else None


def _enrolled_places(item: PhotographedObject, experiment: Experiment) -> list[int]:
    count = experiment.protocol.enrolled or 0
    return nearest_photographs(item, np.arange(count) * 360 / count)


def _query_places(item: PhotographedObject, experiment: Experiment, azimuth_deg: NDArray[np.float64]) -> list[int]:
    """Return the photographs nearest to the azimuths; without a change, of those that are not enrolled.

    A search has no more views than there are such photographs.
    """
    if experiment.change != "none":
        return nearest_photographs(item, azimuth_deg)
    others = np.flatnonzero(~views_enrolled(item.azimuth_deg, experiment.protocol.enrolled or 0))
    if len(others) < _RANKED:
        raise ValueError(
            f"{item.name} has {len(others)} photographs that are not enrolled; a search needs {_RANKED}: enroll fewer"
        )
    left = replace(item, photographs=tuple(item.photographs[place] for place in others))
    return [int(others[place]) for place in nearest_photographs(left, azimuth_deg[: len(others)])]


def nearest_photographs(item: PhotographedObject, azimuth_deg: NDArray[np.float64]) -> list[int]:
    return [int(np.abs(wrap180(item.azimuth_deg - one)).argmin()) for one in azimuth_deg.tolist()]


@cache
def _enrollment_bench(plain: bool) -> DrawnBench:
    return DrawnBench.drawn(np.random.default_rng(7), textured=0.35, clutter=3, plain=plain)


@cache
def _benches(plain: bool) -> tuple[DrawnBench, ...]:
    return tuple(DrawnBench.drawn(np.random.default_rng(1000 + k), plain=plain) for k in range(_BENCHES))


def _enroll(experiment: Experiment, dataset: Dataset, j: int) -> tuple[LevelArray, NDArray[np.float64]] | None:
    if not is_enrolled(j, experiment):
        return None
    found = _enrolled(experiment, dataset, dataset.objects[j].name)
    return found.levels, found.azimuth_deg


@lru_cache(maxsize=_REMEMBERED)
def _enrolled(experiment: Experiment, dataset: Dataset, name: str) -> EnrolledViews:
    return enroll_changed(next(item for item in dataset.objects if item.name == name), experiment)


def _model(
    experiment: Experiment, dataset: Dataset, enrolled: list[tuple[LevelArray, NDArray[np.float64]] | None]
) -> Views:
    kind, found = experiment.condition.descriptor, zip(dataset.objects, enrolled, strict=True)
    parts = [Views.of_object(item.name, *own, kind) for item, own in found if own is not None]
    if len(parts) < 2:
        raise ValueError(f"{len(parts)} object is enrolled; at least two are needed")
    return Views.concatenate(parts)


def _search(
    experiment: Experiment, dataset: Dataset, model: Views, _now_ns: Callable[[], int], j: int
) -> list[SearchResult]:
    enrolled = partial(_enrolled, experiment, dataset)
    return search_changed(dataset.objects[j], experiment, index_of(model), enrolled)


def _results(experiment: Experiment, dataset: Dataset, views: Views, found: list[list[SearchResult]]) -> dict[str, Any]:
    searched = {item.name: results for item, results in zip(dataset.objects, found, strict=True)}
    words = f"{experiment.change}{', plain' * experiment.plain}, {'' if experiment.picture else 'no '}picture"

    def row(objects: str, of: Collection[str]) -> dict[str, Any]:
        some = {name: results for name, results in searched.items() if name in of}
        known = {name: results for name, results in some.items() if name in views.object_names}
        others = {name: results for name, results in some.items() if name not in known}
        rng = generator(experiment.protocol.seed, dataset.name, "bootstrap", 0)
        return {"change": words, "objects": objects, **summary(known, others), **intervals(known, rng)}

    rows = [row("all", searched)]
    if experiment.report is not None:
        first, last = experiment.report
        rows.append(row(f"{first}-{last}", [item.name for item in dataset.subset(first, last).objects]))
    return {
        "settings": experiment.settings(dataset),
        "rows": rows,
        "searches": {name: [asdict(one) for one in results] for name, results in searched.items()},
    }


BENCH_CHANGE: Final = Kind(_enroll, _model, _search, _results)
