"""The trials of an evaluation: searches for an object without the enrolled views near the queries.

All random values (first views, sensor errors, coins) are drawn once for each object and trial, so that they are equal
for all methods.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Final, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap180
from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.dense.calibration import calibrate_stopping_rule
from hbr.dense.filter import Belief, update_belief
from hbr.dense.index import DenseIndex
from hbr.dense.next_view import most_informative_rotation
from hbr.dense.session import DenseSession
from hbr.dense.stopping import Outcome, StoppingRule
from hbr.descriptors import descriptor
from hbr.evaluation.draws import generator
from hbr.evaluation.methods import Method
from hbr.model.symmetry import symmetry
from hbr.model.views import Views
from hbr.paper.hough import Ranking, retrieve
from hbr.paper.index import ViewIndex, largest
from hbr.paper.next_view import Side, next_view

Removal = Literal["near", "paper79", "queries"]
#: Codes of `Runs.outcome`.
OUTCOMES: Final = (Outcome.CONTINUE, Outcome.FOUND, Outcome.UNKNOWN, Outcome.AMBIGUOUS)
_STEP_DEG: Final = {"sweep-45": 45.0, "sweep-90": 90.0, "ahbr-90": 90.0}


@dataclass(frozen=True)
class Protocol:
    """The settings of the trials.

    Attributes
    ----------
    trials : int
        Number of trials for each object.
    max_views : int
        Number of queries in a trial; there are results after each query.
    removal : {"near", "paper79", "queries"}
        Enrolled views of the object that are removed before the search: those closer than `near_deg` to any query so
        far; the queries and the next view of each (79 % of 72 views stay after 8 queries); the queries.
    near_deg : float
        The distance for ``near``.
    sigma_deg : float
        Standard deviation of the error of each measured orientation.
    drift_deg : float
        Drift of the measured orientation with each view.
    seed : int
        Seed of all random values.
    enrolled : int or None
        Number of enrolled views of each object, at equal distances; queries are taken from the other views. None: all
        views are enrolled, including the queries.
    absent : tuple of str
        Names of objects that are not enrolled, to measure unknown objects; only with the dense filter.
    """

    trials: int = 10
    max_views: int = 8
    removal: Removal = "near"
    near_deg: float = 10.0
    sigma_deg: float = 2.0
    drift_deg: float = 0.0
    seed: int = 0
    enrolled: int | None = None
    absent: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.trials < 1 or self.max_views < 1:
            raise ValueError(f"{self.trials} trials of {self.max_views} views; at least one of each is needed")
        if self.removal not in get_args(Removal):
            raise ValueError(f"removal {self.removal!r} is unknown; use one of {', '.join(get_args(Removal))}")
        if not (0 < self.near_deg <= 180 and 0 <= self.sigma_deg < np.inf and np.isfinite(self.drift_deg)):
            raise ValueError(
                f"near_deg is {self.near_deg}, sigma_deg {self.sigma_deg}, drift_deg {self.drift_deg}; needed are a "
                "value above 0 and up to 180, one of at least 0, and a finite one"
            )
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; a whole number of at least 0 is needed")
        if self.enrolled is not None and self.enrolled < 1:
            raise ValueError(f"{self.enrolled} enrolled views; at least 1 is needed")


@dataclass(frozen=True, eq=False)
class Runs:
    """The results of the trials: arrays of shape (methods, objects, trials, views).

    Attributes
    ----------
    rank : int32
        Rank of the true object, 1 if it leads; 0 if it is not a candidate, -1 after the last view of the method.
    pose_error_deg : float64
        Distance of the estimated from the true orientation of the true object, 0..180; nan if it is not a candidate.
    alike_error_deg : float64
        The same for the nearest orientation in which the object looks like in the true one.
    period_deg : float64
        Symmetry of the true object, from all its views (`hbr.model.symmetry.symmetry`): 360 if it is not symmetric;
        nan if it has too few views.
    margin : float64
        `hbr.score_margin` of the leading object per view; with the dense filter, its score minus the second score.
    best : int32
        The leading object, as an index of the views' names.
    score : float64
        Its score per view.
    outcome : int8
        Decision of the stopping rule with the dense filter, as an index of `OUTCOMES`; -1 with the paper's voting.
    travelled_deg : float64
        Sum of the rotations since the first view, without signs.
    step_ns : int64
        Time of retrieval and decision in the first trial of each object, and with the dense filter in all; else 0. The
        other trials of the paper's voting share the retrieval lists. 0 without a timer.
    """

    rank: NDArray[np.int32]
    pose_error_deg: FloatArray
    alike_error_deg: FloatArray
    period_deg: FloatArray
    margin: FloatArray
    best: NDArray[np.int32]
    score: FloatArray
    outcome: NDArray[np.int8]
    travelled_deg: FloatArray
    step_ns: NDArray[np.int64]

    @classmethod
    def blank(cls, methods: int, objects: int, trials: int, views: int) -> "Runs":
        """Return runs without any result."""
        filled = {"rank": (-1, np.int32), "best": (-1, np.int32), "outcome": (-1, np.int8), "step_ns": (0, np.int64)}
        shape = (methods, objects, trials, views)
        return cls(*(np.full(shape, *filled.get(item.name, (np.nan, np.float64))) for item in fields(cls)))

    def of(self, objects: slice) -> "Runs":
        """Return the runs of some objects."""
        return Runs(*(getattr(self, item.name)[:, objects] for item in fields(self)))

    @classmethod
    def concatenate(cls, parts: Sequence["Runs"]) -> "Runs":
        """Return the runs of the objects of all parts, in their order."""
        return cls(*(np.concatenate([getattr(part, item.name) for part in parts], axis=1) for item in fields(cls)))


@dataclass(frozen=True)
class _Draws:
    """The random values of one trial."""

    order: IndexArray
    error_deg: FloatArray
    coins: NDArray[np.bool_]


class _Model(NamedTuple):
    """The views that a search looks among: some of all views."""

    views: Views
    mask: NDArray[np.bool_]
    """Which of all views they are."""
    place: IndexArray
    """Where each of them is among them."""


def run_object(
    object_index: int,
    queries: LevelArray,
    views: Views,
    methods: Sequence[Method],
    protocol: Protocol,
    *,
    rule: StoppingRule | None = None,
    now_ns: Callable[[], int] = lambda: 0,
) -> Runs:
    """Search for one object with all methods, in all trials, and return the runs of this object.

    Parameters
    ----------
    object_index : int
        The object.
    queries : uint8 array (n, 144)
        Descriptors of its photographs as queries, one for each of its views, in the order of `views.of`.
    views : Views
        The complete model set.
    methods : sequence of Method
        The methods of the search.
    protocol : Protocol
        The settings of the trials.
    rule : StoppingRule, optional
        The rule for methods of the dense filter; default: `rule_of_trial`.
    now_ns : callable
        Monotonic time, for `Runs.step_ns`.

    Raises
    ------
    ValueError
        The object has too few views, or the number of queries is another one.
    """
    if rule is None and any(method.dense for method in methods):
        rule = rule_of_trial(views, protocol)
    trial = _Trials(object_index, queries, views, protocol, rule, now_ns)
    runs = Runs.blank(len(methods), 1, protocol.trials, protocol.max_views)
    for t in range(protocol.trials):
        draws = trial.draw(t)
        models: dict[bytes, _Model] = {}
        for m, method in enumerate(methods):
            trial.run(method, draws, models, runs, (m, 0, t))
    return runs


class _Trials:
    def __init__(
        self,
        object_index: int,
        queries: LevelArray,
        views: Views,
        protocol: Protocol,
        rule: StoppingRule | None,
        now_ns: Callable[[], int],
    ) -> None:
        self._object, self._queries, self._views = object_index, queries, views
        self._protocol, self._rule, self._now_ns = protocol, rule, now_ns
        self._rows = views.of(object_index)
        self._azimuth_deg = views.azimuth_deg[self._rows]
        name = views.object_names[object_index]
        self._enrolled = views_of_trial(views, protocol)
        self._is_unknown = name in protocol.absent
        self._free = np.flatnonzero(~self._enrolled[self._rows]) if protocol.enrolled else np.arange(len(self._rows))
        self._index: DenseIndex | None = None
        if len(queries) != len(self._rows):
            raise ValueError(f"{len(queries)} queries for the {len(self._rows)} views of {name}; one each is needed")
        if len(self._free) <= protocol.max_views:
            raise ValueError(
                f"{name} has {len(self._free)} views; for {protocol.max_views} queries it needs more that are free"
            )
        self._ring = np.argsort(self._azimuth_deg, kind="stable")
        own = views.descriptors[self._rows]
        compared = descriptor(views.descriptor)
        self._alike = _similar_views(compared.similarity(own, own), self._ring)
        symmetric = symmetry(views, object_index, similarity=compared.similarity)
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
        count = self._protocol.max_views
        return _Draws(
            order=rng.permutation(self._free)[:count],
            error_deg=rng.normal(0, self._protocol.sigma_deg, count) + self._protocol.drift_deg * np.arange(count),
            coins=rng.random(count) < 0.5,
        )

    def run(
        self, method: Method, draws: _Draws, models: dict[bytes, _Model], runs: Runs, at: tuple[int, int, int]
    ) -> None:
        """Store the results of one trial with one method in `runs`."""
        if method.dense:
            self._run_dense(method, draws, runs, at)
            return
        if self._protocol.absent:
            raise ValueError(f"{method.label} cannot search for unknown objects; use methods of the dense filter")
        seen = [int(draws.order[0])]
        travelled_deg = 0.0
        last = min(self._protocol.max_views, method.views or self._protocol.max_views)
        for n in range(last):
            keep = self._keep(np.array(seen))
            key = keep.tobytes()
            if key not in models:
                models[key] = self._model(keep)
            # a new index for each method: lists of another method would shorten the measured time
            model = models[key]
            index = ViewIndex(model.views)
            is_measured = at[2] == 0
            if not is_measured:
                self._share_lists(index, model, seen, method.list_length)
            measured_deg = self._azimuth_deg[seen] + draws.error_deg[: n + 1]
            start_ns = self._now_ns()
            ranking = retrieve(
                self._queries[seen],
                measured_deg,
                index,
                omega=method.omega,
                list_length=method.list_length,
                extension=method.extension,
            )
            following = self._next(method, draws, seen, ranking) if n + 1 < last else seen[-1]
            runs.step_ns[*at, n] = self._now_ns() - start_ns if is_measured else 0
            self._record(ranking.object_index, ranking.pose_deg, seen, runs, (*at, n))
            self._record_margin(ranking, seen, keep, runs, (*at, n))
            runs.travelled_deg[*at, n] = travelled_deg
            travelled_deg += abs(float(wrap180(self._azimuth_deg[following] - self._azimuth_deg[seen[-1]])))
            seen.append(following)

    def _share_lists(self, index: ViewIndex, model: _Model, seen: list[int], list_length: int) -> None:
        """Let an index know the retrieval lists, from the similarities to all views that are computed once."""
        for i in seen:
            if (i, list_length) not in self._nearest_views:
                longest = list_length + len(self._rows)  # at most the object's own views are missing
                self._nearest_views[i, list_length] = largest(self._similar[i], longest)[0]
            nearest = self._nearest_views[i, list_length]
            rows = nearest[model.mask[nearest]][:list_length]
            index.remember(self._queries[i], model.place[rows], self._similar[i, rows])

    def _run_dense(self, method: Method, draws: _Draws, runs: Runs, at: tuple[int, int, int]) -> None:
        assert self._rule is not None
        if self._index is None or self._index.omega != method.omega:
            self._index = DenseIndex(self._views.select(self._enrolled), omega=method.omega)
        seen = [int(draws.order[0])]
        travelled_deg = 0.0
        last = min(self._protocol.max_views, method.views or self._protocol.max_views)
        session = DenseSession(self._index, self._rule, max_views=last)
        for n in range(last):
            # Views near the newest query leave the model for the earlier queries, too.
            gone = self._rows[~self._keep(np.array(seen)) & self._enrolled[self._rows]]
            measured_deg = (self._azimuth_deg[seen] + draws.error_deg[: n + 1]).tolist()
            if len(gone):
                fewer = self._index.without(np.cumsum(self._enrolled)[gone] - 1)
                session = DenseSession(fewer, self._rule, max_views=last)
                for i, angle_deg in zip(seen[:-1], measured_deg, strict=False):
                    session.add(self._queries[i], angle_deg)
            start_ns = self._now_ns()
            decision = session.add(self._queries[seen[-1]], measured_deg[-1])
            following = self._next_dense(method, draws, seen, session) if n + 1 < last else seen[-1]
            runs.step_ns[*at, n] = self._now_ns() - start_ns
            ranking = session.belief.ranking()
            self._record(ranking.object_index, ranking.pose_deg, seen, runs, (*at, n))
            runs.score[*at, n] = ranking.scores[0]
            runs.margin[*at, n] = ranking.scores[0] - (ranking.scores[1] if len(ranking.scores) > 1 else 0.0)
            runs.outcome[*at, n] = OUTCOMES.index(decision.outcome)
            runs.travelled_deg[*at, n] = travelled_deg
            travelled_deg += abs(float(wrap180(self._azimuth_deg[following] - self._azimuth_deg[seen[-1]])))
            seen.append(following)

    def _next_dense(self, method: Method, draws: _Draws, seen: list[int], session: DenseSession) -> int:
        match method.strategy:
            case "next-best-view":
                return self._nearest(seen, session.next_best_view().rotation_deg)
            case "next-best-view-coin":
                rotation_deg = abs(session.next_best_view().rotation_deg)
                return self._nearest(seen, rotation_deg if draws.coins[len(seen)] else -rotation_deg)
            case "mutual":
                return self._nearest(seen, most_informative_rotation(session.belief))
            case "oracle":
                return self._oracle(seen, session.belief)
            case _:
                if method.strategy in _STEP_DEG:
                    return self._nearest(seen, _STEP_DEG[method.strategy])
                return int(draws.order[len(seen)])

    def _oracle(self, seen: list[int], belief: Belief) -> int:
        """Return the photograph with the largest lead of the true object, of every third photograph."""
        left = np.setdiff1d(self._free, seen)[::3]
        margins = []
        for i in left.tolist():
            scores = update_belief(self._queries[i], float(self._azimuth_deg[i]), belief).scores()
            own = belief.index.object_index == self._object
            margins.append(scores[own].max(initial=-np.inf) - scores[~own].max(initial=-np.inf))
        return int(left[int(np.argmax(margins))])

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
        if not keep.any() and not self._is_unknown:
            name = self._views.object_names[self._object]
            raise ValueError(
                f"after {len(seen)} queries no view of {name} is left; use fewer views or removal 'queries'"
            )
        return keep

    def _model(self, keep: NDArray[np.bool_]) -> _Model:
        """Return the enrolled views, of the searched object only those to keep."""
        mask = self._enrolled.copy()
        mask[self._rows] = keep
        return _Model(self._views.select(mask), mask, np.cumsum(mask) - 1)

    def _next(self, method: Method, draws: _Draws, seen: list[int], ranking: Ranking) -> int:
        """Return the next query: a photograph that was not a query yet."""
        if method.active and len(seen) > 1:
            coin: Side = "left" if draws.coins[len(seen)] else "right"
            rotation_deg = next_view(ranking, side=coin if method.strategy == "coin" else None).rotation_deg
        elif method.strategy in _STEP_DEG:
            rotation_deg = _STEP_DEG[method.strategy]
        else:
            return int(draws.order[len(seen)])
        return self._nearest(seen, rotation_deg)

    def _nearest(self, seen: list[int], rotation_deg: float) -> int:
        """Return the possible query that is nearest to a rotation from the last one."""
        away_deg = np.full(len(self._rows), np.inf)
        wanted_deg = self._azimuth_deg[seen[-1]] + rotation_deg
        away_deg[self._free] = np.abs(wrap180(self._azimuth_deg[self._free] - wanted_deg))
        away_deg[seen] = np.inf
        return int(away_deg.argmin())

    def _record(
        self, objects: IndexArray, pose_deg: FloatArray, seen: list[int], runs: Runs, at: tuple[int, int, int, int]
    ) -> None:
        place = np.flatnonzero(objects == self._object)
        runs.rank[at] = place[0] + 1 if len(place) else 0
        runs.best[at] = objects[0]
        runs.period_deg[at] = self._period_deg
        if len(place):
            away_deg = np.abs(wrap180(pose_deg[place[0]] - self._azimuth_deg))
            runs.pose_error_deg[at] = away_deg[seen[-1]]
            runs.alike_error_deg[at] = away_deg[self._alike[seen[-1]]].min()

    def _record_margin(
        self, ranking: Ranking, seen: list[int], keep: NDArray[np.bool_], runs: Runs, at: tuple[int, int, int, int]
    ) -> None:
        runs.score[at] = ranking.scores[0] / len(seen)
        # hbr.score_margin, from similarities that are computed once for all trials
        reach = self._reach[:, seen].sum(axis=1)
        reach[self._object] = self._own_similar[seen][:, keep].max(axis=1).sum()
        reach[ranking.object_index[0]] = -np.inf
        runs.margin[at] = (ranking.scores[0] - reach.max()) / len(seen)


def rule_of_trial(views: Views, protocol: Protocol) -> StoppingRule:
    """Return the stopping rule, calibrated on the views that are enrolled in all trials, as on a bench."""
    return calibrate_stopping_rule(DenseIndex(views.select(views_of_trial(views, protocol)))).rule


def views_enrolled(azimuth_deg: FloatArray, count: int) -> NDArray[np.bool_]:
    """Return which views are the nearest to `count` equally spaced azimuths, bool (n,)."""
    mask = np.zeros(len(azimuth_deg), np.bool_)
    if len(azimuth_deg):
        away_deg = np.abs(wrap180(azimuth_deg[:, None] - np.arange(count) * 360 / count))
        mask[away_deg.argmin(axis=0)] = True
    return mask


def views_of_trial(views: Views, protocol: Protocol) -> NDArray[np.bool_]:
    """Return which views are enrolled in all trials, bool (n,): those of absent objects are not."""
    mask = ~np.isin(views.object_index, [j for j, name in enumerate(views.object_names) if name in protocol.absent])
    if protocol.enrolled is not None:
        for j in range(len(views.object_names)):
            rows = views.of(j)
            mask[rows] &= views_enrolled(views.azimuth_deg[rows], protocol.enrolled)
    return mask


def _similar_views(similar: FloatArray, ring: IndexArray) -> NDArray[np.bool_]:
    """Return for each view which views are at least as similar to it as one of its two neighbours, bool (n, n)."""
    before, after = np.empty_like(ring), np.empty_like(ring)
    before[ring], after[ring] = np.roll(ring, 1), np.roll(ring, -1)
    rows = np.arange(len(ring))
    alike: NDArray[np.bool_] = similar >= np.minimum(similar[rows, before], similar[rows, after])[:, None]
    alike[rows, rows] = True  # also for a view without texture and colour
    return alike
