"""The trials of an evaluation: searches for an object without the enrolled views near the queries.

All random values (first views, sensor errors, coins) are drawn once for each object and trial, so that they are equal
for all methods.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap180
from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.dense.filter import BETA, Belief, update_belief
from hbr.dense.index import DenseIndex
from hbr.dense.next_view import ALL_ROTATIONS_DEG, expected_views, strongest
from hbr.dense.pixel_fit import LocalView
from hbr.dense.pose import azimuth_of, pose
from hbr.dense.session import DenseSession, answered, near
from hbr.dense.stopping import Outcome
from hbr.descriptors import descriptor
from hbr.evaluation.condition import Condition, levels_of
from hbr.evaluation.experiment import Experiment, Kind
from hbr.evaluation.photographs import Dataset
from hbr.evaluation.poses import stated_pose
from hbr.evaluation.protocol import OUTCOMES, Method, Protocol, Runs, generator, views_of_trial
from hbr.evaluation.results import results_of
from hbr.model.symmetry import symmetry
from hbr.model.views import Views
from hbr.paper.hmm import CONFIDENT, PoseModel, update_poses
from hbr.paper.hough import Ranking, retrieve
from hbr.paper.index import ViewIndex, largest
from hbr.paper.next_view import Side, next_view
from hbr.segmentation import segment

_STEP_DEG: Final = {"sweep-45": 45.0, "sweep-90": 90.0, "ahbr-90": 90.0}


@dataclass(frozen=True)
class _Draws:
    """The random values of one trial."""

    order: IndexArray
    error_deg: FloatArray
    coins: NDArray[np.bool_]


class _Model(NamedTuple):
    """The enrolled views of a search: a selection of all views."""

    views: Views
    mask: NDArray[np.bool_]
    """Indices of the selected views among all."""
    gone: IndexArray
    """Indices of the other views, ascending."""

    def place(self, rows: IndexArray) -> IndexArray:
        """Return the places of these views, indices among all, in the selection."""
        place: IndexArray = rows - np.searchsorted(self.gone, rows)
        return place


class LocalPhotographs:
    """The photographs of a data set, cut out when a search asks for them (`hbr.dense.session`).

    ``seed`` is that of the queries, as for `hbr.evaluation.condition.levels_of`.
    """

    def __init__(self, dataset: Dataset, condition: Condition, seed: int) -> None:
        self._dataset, self._condition, self._seed = dataset, condition, seed
        self._known: dict[tuple[int, int], LocalView] = {}

    @property
    def possible(self) -> bool:
        """Whether the descriptor describes an object that is cut out, as on the bench."""
        return not descriptor(self._condition.descriptor).whole_image

    def query(self, object_index: int, number: int, azimuth_deg: float) -> LocalView:
        """Return a photograph of an object, counted from 0, as a view of a search at this orientation."""
        return self._local_view(object_index, number, azimuth_deg, self._seed)

    def enrolled(self, object_index: int, numbers: IndexArray, azimuths_deg: Sequence[float]) -> list[LocalView]:
        """Return the enrolled views nearest to each azimuth, of the photographs with these numbers, by azimuth."""
        own_deg = self._dataset.objects[object_index].azimuth_deg
        chosen = numbers[near(own_deg[numbers], azimuths_deg)].tolist()
        for number in chosen:
            if (object_index, number) not in self._known:
                view = self._local_view(object_index, number, float(own_deg[number]))
                self._known[object_index, number] = view
        return [self._known[object_index, number] for number in chosen]

    def _local_view(self, j: int, number: int, azimuth_deg: float, seed: int | None = None) -> LocalView:
        image, name = self._dataset.image(j, number), self._dataset.objects[j].name
        cut = segment(self._condition.shown(image, name, number, seed))
        return LocalView(cut.crop, cut.mask, azimuth_deg)


def run_object(
    object_index: int,
    queries: LevelArray,
    views: Views,
    methods: Sequence[Method],
    protocol: Protocol,
    *,
    photographs: LocalPhotographs | None = None,
    now_ns: Callable[[], int] = lambda: 0,
) -> Runs:
    """Search for one object of ``views`` with all methods, in all trials, and return the runs of this object.

    ``queries``, uint8 (n, length), are its photographs as queries, one for each of its views, in the order of
    `views.of`. With ``photographs``, a search of the dense filter compares its two leaders as on the bench; without
    them it keeps its answer. ``now_ns`` is a monotonic time, for `Runs.step_ns`.

    Raises
    ------
    ValueError
        The object has too few views, or the number of queries is another one.
    """
    trials = _Trials(object_index, queries, views, protocol, now_ns, photographs)
    trials.runs = Runs.blank(len(methods), 1, protocol.trials, protocol.max_views)
    for t in range(protocol.trials):
        draws = trials.draw(t)
        trials.models = {}  # those of other trials are seldom the same
        for m, method in enumerate(methods):
            trials.run(method, draws, (m, 0, t))
    return trials.runs


At = tuple[int, int, int]
"""Method, object and trial: where the results of a trial belong in `Runs`."""


class _Trials:
    """The trials of one object, with all that its trials share.

    Before `run`: ``runs`` takes the results, ``models`` keeps the enrolled views of a trial by those that stay.
    """

    runs: Runs
    models: dict[bytes, _Model]

    def __init__(
        self,
        object_index: int,
        queries: LevelArray,
        views: Views,
        protocol: Protocol,
        now_ns: Callable[[], int],
        photographs: LocalPhotographs | None = None,
    ) -> None:
        self._photographs = photographs
        self._object, self._queries, self._views = object_index, queries, views
        self._protocol, self._now_ns = protocol, now_ns
        self._rows = views.of(object_index)
        self._azimuth_deg = views.azimuth_deg[self._rows]
        name = views.object_names[object_index]
        self._enrolled = views_of_trial(views, protocol)
        self._free = np.flatnonzero(~self._enrolled[self._rows]) if protocol.enrolled else np.arange(len(self._rows))
        if len(queries) != len(self._rows):
            raise ValueError(f"{len(queries)} queries for the {len(self._rows)} views of {name}; one each is needed")
        if len(self._free) <= protocol.max_views:
            raise ValueError(
                f"{name} has {len(self._free)} views; for {protocol.max_views} queries it needs more that are free"
            )
        # All similarities are computed once: every method and trial of this object uses them.
        self._ring = np.argsort(self._azimuth_deg, kind="stable")
        own = views.descriptors[self._rows]
        compared = descriptor(views.descriptor)
        self._neighbourhood = _similar_views(compared.similarity(own, own), self._ring)
        symmetric = symmetry(views, object_index)
        self._period_deg = np.nan if symmetric is None else symmetric.period_deg
        similar = compared.similarity(queries, views.descriptors)
        similar[:, ~self._enrolled] = -np.inf
        self._similar = similar
        self._nearest_views: dict[tuple[int, int], IndexArray] = {}
        self._own_similar = similar[:, self._rows]
        objects = range(len(views.object_names))
        self._reach = np.stack([similar[:, views.of(j)].max(axis=1, initial=-np.inf) for j in objects])

    def draw(self, trial: int) -> _Draws:
        rng = generator(self._protocol.seed, self._views.object_names[self._object], "trial", trial)
        count, measured_deg = self._protocol.max_views, self._protocol.rotation_errors_deg
        order = rng.permutation(self._free)[:count]
        error_deg = rng.normal(0, self._protocol.sigma_deg, count) + self._protocol.drift_deg * np.arange(count)
        coins = rng.random(count) < 0.5
        if measured_deg:  # drawn last, so that the other values do not depend on it
            error_deg = np.cumsum(rng.choice(measured_deg, count))
        return _Draws(order, error_deg, coins)

    def run(self, method: Method, draws: _Draws, at: At) -> None:
        """Store the results of one trial with one method in `runs`."""
        if method.dense:
            self._run_dense(method, draws, at)
            return
        if method.hmm:
            self._run_hmm(method, draws, at)
            return
        runs, last = self.runs, self._last(method)
        for n, seen, keep, measured_deg in self._queries_of(draws, last, at):
            # a new index for each method: lists of another method would shorten the measured time
            model = self._model(keep)
            # Only the first repetition is timed; the others may share lists.
            is_measured = at[2] == 0
            index = ViewIndex(model.views, self._protocol.index if is_measured else "flat")
            if is_measured and self._protocol.index == "tree":
                index.build()  # not in the measured time
            if not is_measured:
                self._share_lists(index, model, seen, method.list_length)
            start_ns = self._now_ns()
            ranking = retrieve(
                self._queries[seen],
                measured_deg,
                index,
                omega=method.omega,
                list_length=method.list_length,
                extension=method.extension,
            )
            planned_deg = self._planned_deg(method, draws, seen, ranking) if n + 1 < last else None
            following = self._next(draws, seen, planned_deg, last)
            runs.step_ns[*at, n] = self._now_ns() - start_ns if is_measured else 0
            self._record(ranking.object_index, ranking.pose_deg, seen, (*at, n))
            self._record_margin(ranking, seen, keep, (*at, n))
            seen.append(following)

    def _last(self, method: Method) -> int:
        return min(self._protocol.max_views, method.views or self._protocol.max_views)

    def _queries_of(
        self, draws: _Draws, last: int, at: At
    ) -> Iterator[tuple[int, list[int], NDArray[np.bool_], FloatArray]]:
        """Yield after each query its number, all queries so far, which own views stay, and all measured orientations.

        The caller appends the next query; the way to it is recorded here.
        """
        seen = [int(draws.order[0])]
        travelled_deg = 0.0
        for n in range(last):
            self.runs.travelled_deg[*at, n] = travelled_deg
            yield n, seen, self._keep(np.array(seen)), self._azimuth_deg[seen] + draws.error_deg[: n + 1]
            travelled_deg += abs(float(wrap180(self._azimuth_deg[seen[-1]] - self._azimuth_deg[seen[-2]])))

    def _share_lists(self, index: ViewIndex, model: _Model, seen: list[int], list_length: int) -> None:
        """Store the retrieval lists in an index, from the similarities to all views, which are computed once."""
        for i in seen:
            if (i, list_length) not in self._nearest_views:
                longest = list_length + len(self._rows)  # only the object's own views can be missing
                self._nearest_views[i, list_length] = largest(self._similar[i], longest)[0]
            nearest = self._nearest_views[i, list_length]
            rows = nearest[model.mask[nearest]][:list_length]
            index.remember(self._queries[i], model.place(rows), self._similar[i, rows])

    def _run_hmm(self, method: Method, draws: _Draws, at: At) -> None:
        runs, last = self.runs, self._last(method)
        for n, seen, keep, measured_deg in self._queries_of(draws, last, at):
            chosen = self._model(keep)
            model = PoseModel(chosen.views)
            _ = model.compared  # an index is not built in the measured time
            similar = self._similar[seen][:, chosen.mask]
            start_ns = self._now_ns()
            # Views near the newest query leave the model for the earlier queries, too.
            belief = update_poses(similar[0], measured_deg[0], model)
            for i in range(1, n + 1):
                belief = update_poses(similar[i], measured_deg[i], belief)
            is_planned = method.strategy == "least-risk" and n + 1 < last
            planned_deg = belief.next_view().rotation_deg if is_planned else None
            following = self._next(draws, seen, planned_deg, last)
            runs.step_ns[*at, n] = self._now_ns() - start_ns
            objects, log_probability, pose_deg = belief.ranking()
            self._record(objects, pose_deg, seen, (*at, n))
            leading = np.exp(log_probability[:2])
            runs.score[*at, n] = leading[0]
            runs.margin[*at, n] = leading[0] - leading[1:].sum()
            runs.outcome[*at, n] = OUTCOMES.index(Outcome.FOUND if leading[0] >= CONFIDENT else Outcome.CONTINUE)
            seen.append(following)

    def _run_dense(self, method: Method, draws: _Draws, at: At) -> None:
        index = _index_of_trial(self._views, self._protocol, method.omega)
        runs, last = self.runs, self._last(method)
        session = DenseSession(index, max_views=last, most_changes=0)
        ended = False
        for n, seen, keep, measured in self._queries_of(draws, last, at):
            # Views near the newest query leave the model for the earlier queries, too.
            gone = self._rows[~keep & self._enrolled[self._rows]]
            measured_deg = measured.tolist()
            if len(gone):
                fewer = index.without(np.cumsum(self._enrolled)[gone] - 1)
                session = DenseSession(fewer, max_views=last, most_changes=0)
                for i, angle_deg in zip(seen[:-1], measured_deg, strict=False):
                    session.add(self._queries[i], angle_deg)
            start_ns = self._now_ns()
            newest = seen[-1]
            session.add(self._queries[newest], measured_deg[-1])
            planned_deg = self._planned_dense_deg(method, draws, seen, session) if n + 1 < last else None
            following = self._next(draws, seen, planned_deg, last)
            runs.step_ns[*at, n] = self._now_ns() - start_ns
            ranking = session.belief.ranking()
            objects = ranking.object_index.tolist()
            pose_deg = [azimuth_of(session.belief, j) if j == self._object else np.nan for j in objects]
            self._record(ranking.object_index, np.array(pose_deg), seen, (*at, n))
            # The numbers after this view; until the first end, pixels count, too.
            runs.score[*at, n] = ranking.scores[0]
            runs.margin[*at, n] = ranking.scores[0] - (ranking.scores[1] if len(ranking.scores) > 1 else 0.0)
            if not ended:
                self._verify(session, seen, measured_deg, keep)
            runs.named[*at, n] = session.decision.object_index == self._object
            runs.outcome[*at, n] = OUTCOMES.index(session.decision.outcome)
            if not ended and session.decision.outcome is not Outcome.CONTINUE:
                ended = True
                stated = pose(session.belief, self._object)
                true_deg = float(self._azimuth_deg[newest])
                runs.stated[*at, n] = stated_pose(stated, true_deg, self._azimuth_deg[keep])
            seen.append(following)

    def _verify(
        self, session: DenseSession, seen: list[int], measured_deg: list[float], keep: NDArray[np.bool_]
    ) -> None:
        """Compare pixels as on the bench."""
        photographs = self._photographs
        if photographs is None:
            return

        def queries(n: int) -> list[LocalView]:
            return [photographs.query(self._object, seen[n], measured_deg[n])]

        def enrolled(leader: int, azimuths_deg: Sequence[float]) -> list[LocalView]:
            own = keep if leader == self._object else self._enrolled[self._views.of(leader)]
            return photographs.enrolled(leader, np.flatnonzero(own), azimuths_deg)

        answered(session.verify(queries), enrolled)

    def _planned_dense_deg(self, method: Method, draws: _Draws, seen: list[int], session: DenseSession) -> float | None:
        match method.strategy:
            case "next-best-view":
                return session.next_best_view().rotation_deg
            case "next-best-view-coin":
                rotation_deg = abs(session.next_best_view().rotation_deg)
                return rotation_deg if draws.coins[len(seen)] else -rotation_deg
            case "mutual":
                return most_informative_rotation(session.belief)
            case "oracle":
                return self._oracle_deg(seen, session.belief)
        return _STEP_DEG.get(method.strategy)

    def _oracle_deg(self, seen: list[int], belief: Belief) -> float:
        """Return the way to the photograph with the largest lead of the true object, of every third photograph."""
        left = np.setdiff1d(self._free, seen)[::3]
        margins = []
        for i in left.tolist():
            scores = update_belief(self._queries[i], float(self._azimuth_deg[i]), belief).scores()
            own = belief.index.object_index == self._object
            margins.append(scores[own].max(initial=-np.inf) - scores[~own].max(initial=-np.inf))
        return float(self._azimuth_deg[left[int(np.argmax(margins))]] - self._azimuth_deg[seen[-1]])

    def _keep(self, seen: IndexArray) -> NDArray[np.bool_]:
        """Return which of the object's views stay enrolled after these queries, bool (n,)."""
        keep = self._enrolled[self._rows].copy()
        keep[seen] = False
        match self._protocol.removal:
            case "near":
                away_deg = np.abs(wrap180(self._azimuth_deg[:, None] - self._azimuth_deg[seen]))
                keep &= (away_deg >= self._protocol.near_deg).all(axis=1)
            case "paper79":
                place = np.argsort(self._ring)
                keep[self._ring[(place[seen] + 1) % len(self._ring)]] = False
            case "queries":
                pass
        if not keep.any():
            name = self._views.object_names[self._object]
            raise ValueError(
                f"after {len(seen)} queries no view of {name} is left; use fewer views or removal 'queries'"
            )
        return keep

    def _model(self, keep: NDArray[np.bool_]) -> _Model:
        """Return the enrolled views; of the searched object, only those that stay."""
        key = keep.tobytes()
        if key not in self.models:
            mask = self._enrolled.copy()
            mask[self._rows] = keep
            self.models[key] = _Model(self._views.select(mask), mask, np.flatnonzero(~mask))
        return self.models[key]

    def _planned_deg(self, method: Method, draws: _Draws, seen: list[int], ranking: Ranking) -> float | None:
        if method.active and len(seen) > 1:
            coin: Side = "left" if draws.coins[len(seen)] else "right"
            side = coin if method.strategy == "coin" else None
            return next_view(ranking, side=side, sectors=method.sectors).rotation_deg
        return _STEP_DEG.get(method.strategy)

    def _next(self, draws: _Draws, seen: list[int], rotation_deg: float | None, last: int) -> int:
        """Return the next query: the possible one nearest to a rotation from the last one, or None: a random one.

        After the ``last`` query of a trial it is that query again.
        """
        if len(seen) == last:
            return seen[-1]
        if rotation_deg is None:
            return int(draws.order[len(seen)])
        away_deg = np.full(len(self._rows), np.inf)
        wanted_deg = self._azimuth_deg[seen[-1]] + rotation_deg
        away_deg[self._free] = np.abs(wrap180(self._azimuth_deg[self._free] - wanted_deg))
        away_deg[seen] = np.inf
        return int(away_deg.argmin())

    def _record(self, objects: IndexArray, pose_deg: FloatArray, seen: list[int], at: tuple[int, ...]) -> None:
        runs, place = self.runs, np.flatnonzero(objects == self._object)
        runs.rank[at] = place[0] + 1 if len(place) else 0
        runs.named[at] = objects[0] == self._object
        runs.period_deg[at] = self._period_deg
        if len(place):
            away_deg = np.abs(wrap180(pose_deg[place[0]] - self._azimuth_deg))
            runs.pose_error_deg[at] = away_deg[seen[-1]]
            runs.alike_error_deg[at] = away_deg[self._neighbourhood[seen[-1]]].min()

    def _record_margin(self, ranking: Ranking, seen: list[int], keep: NDArray[np.bool_], at: tuple[int, ...]) -> None:
        runs = self.runs
        runs.score[at] = ranking.scores[0] / len(seen)
        # hbr.score_margin, from similarities that are computed once for all trials
        reach = self._reach[:, seen].sum(axis=1)
        reach[self._object] = self._own_similar[seen][:, keep].max(axis=1).sum()
        reach[ranking.object_index[0]] = -np.inf
        runs.margin[at] = (ranking.scores[0] - reach.max()) / len(seen)


@lru_cache(maxsize=1)
def _index_of_trial(views: Views, protocol: Protocol, omega: float) -> DenseIndex:
    """Return the index of the views that are enrolled in all trials, which each process makes once."""
    index = DenseIndex(views.select(views_of_trial(views, protocol)), omega=omega)
    _ = index.vectors  # they are not computed in the measured time
    return index


def _similar_views(similar: FloatArray, ring: IndexArray) -> NDArray[np.bool_]:
    """Return for each view which views are at least as similar to it as one of its two neighbours, bool (n, n)."""
    before, after = np.empty_like(ring), np.empty_like(ring)
    before[ring], after[ring] = np.roll(ring, 1), np.roll(ring, -1)
    rows = np.arange(len(ring))
    found: NDArray[np.bool_] = similar >= np.minimum(similar[rows, before], similar[rows, after])[:, None]
    found[rows, rows] = True  # a view without texture and colour has similarity 0 to itself
    return found


def most_informative_rotation(belief: Belief) -> float:
    """Choose the rotation whose view is expected to leave the least entropy: a baseline for `hbr.next_best_view`.

    If hypothesis h is true, the view after a rotation is the one that was enrolled there. The likelihood of hypothesis
    h' is then exp(β z(view_h, view_h') / √n).
    """
    probability, place, bin_of = strongest(belief.posterior)
    rows, _ = expected_views(belief, place, bin_of, ALL_ROTATIONS_DEG)
    # z relative to that of equal views
    z = belief.index.space.largest.sum() * (belief.index.among(rows) - 1)
    weights = probability * np.exp(BETA / np.sqrt(belief.queries + 1) * z)
    weights /= weights.sum(axis=2, keepdims=True)
    objects = (place[:, None] == np.unique(place)).astype(np.float64)
    shares = weights @ objects
    entropy = -(shares * np.log(np.maximum(shares, 1e-300))).sum(axis=2)
    return float(ALL_ROTATIONS_DEG[int((entropy @ probability).argmin())])


def enroll(experiment: Experiment, dataset: Dataset, j: int) -> LevelArray:
    """Describe all photographs of object `j` as enrolled views."""
    return levels_of(dataset, j, experiment.condition)


def all_views(experiment: Experiment, dataset: Dataset, enrolled: list[LevelArray]) -> Views:
    """Return the enrolled views of all objects."""
    kind = experiment.condition.descriptor
    objects = zip(dataset.objects, enrolled, strict=True)
    return Views.concatenate([Views.of_object(item.name, own, item.azimuth_deg, kind) for item, own in objects])


def _search(experiment: Experiment, dataset: Dataset, views: Views, now_ns: Callable[[], int], j: int) -> Runs:
    condition, protocol = experiment.condition, experiment.protocol
    photographs = LocalPhotographs(dataset, condition, protocol.seed)
    return run_object(
        j,
        levels_of(dataset, j, condition, protocol.seed),
        views,
        experiment.methods,
        protocol,
        photographs=photographs if photographs.possible else None,
        now_ns=now_ns,
    )


def _results(experiment: Experiment, dataset: Dataset, _model: object, found: list[Runs]) -> dict[str, Any]:
    runs, report = Runs.concatenate(found), experiment.report
    if report is not None:
        runs = runs.of(slice(report[0] - 1, report[1]))
    rng = generator(experiment.protocol.seed, dataset.name, "bootstrap", 0)
    return {
        "settings": experiment.settings(dataset),
        "reported": None if report is None else list(report),
        "bytes_per_view": descriptor(experiment.condition.descriptor).size_bytes,
        **results_of(runs, experiment.methods, experiment.margin, experiment.min_views, rng),
    }


TRIALS: Final = Kind(enroll, all_views, _search, _results)
