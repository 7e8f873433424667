"""Results of runs: hit rates by the number of views, decisions, pose errors, and comparisons of methods."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray
from hbr.dense.stopping import Outcome
from hbr.evaluation.poses import pose_rates
from hbr.evaluation.protocol import OUTCOMES, Method, Runs
from hbr.evaluation.statistics import bootstrap_difference, mcnemar_exact, wilson

_BEST: int = 10  # the paper's "Best 10"


@dataclass(frozen=True)
class Point:
    """Results of a method after `views` queries.

    Pose errors are those of the trials that found the object, None if there are none; the asymmetric ones are of
    objects without a symmetry. Intervals are Wilson's at 95 %, for independent trials.
    """

    views: int
    trials: int
    hits: int
    hit_rate: float
    hit_rate_low: float
    hit_rate_high: float
    best10_hits: int
    best10_rate: float
    best10_low: float
    best10_high: float
    travelled_mean_deg: float
    pose_error_median_deg: float | None
    pose_error_rmse_deg: float | None
    alike_error_median_deg: float | None
    alike_error_rmse_deg: float | None
    asymmetric_error_median_deg: float | None


@dataclass(frozen=True)
class Stopping:
    """Results of searches with an end: by a decision, or after all views.

    The paper's methods end when the margin per view reaches ``margin``; the dense filter ends by the stopping rule that
    was fitted to the enrolled views. A hit is a search that found the right object. ``unknown_rate``,
    ``ambiguous_rate`` and ``wrong_rate`` are the shares of searches with these outcomes, and ``ended_early`` is the
    share that ended before the last view. ``pose`` has the rates of `hbr.evaluation.poses.pose_rates` for the hits of
    the dense filter.
    """

    margin: float
    views_mean: float
    views_p95: float
    hit_rate: float
    hit_rate_low: float
    hit_rate_high: float
    unknown_rate: float
    ambiguous_rate: float
    wrong_rate: float
    travelled_mean_deg: float
    ended_early: float
    pose: dict[str, float | None]


@dataclass(frozen=True)
class MethodResult:
    """The results of one method."""

    method: Method
    curve: tuple[Point, ...]
    stopping: Stopping


@dataclass(frozen=True)
class Contest:
    """A comparison of two methods on the same trials; the difference is the first hit rate minus the second.

    The interval comes from resampled objects; McNemar's exact test is for independent trials.
    """

    first: str
    first_views: int
    second: str
    second_views: int
    trials: int
    first_rate: float
    second_rate: float
    difference: float
    difference_low: float
    difference_high: float
    only_first: int
    only_second: int
    p_value: float


#: Comparisons: first method, its views, second method, its views; None: all views.
QUESTIONS: tuple[tuple[str, int | None, str, int | None], ...] = (
    ("ahbr", 4, "hbr", None),
    ("hbr", 4, "hbr", None),
    ("ahbr", 4, "hbr", 4),
    ("ahbr", None, "hbr", None),
    ("hbr", None, "hbr-0", None),
    ("hbr", 4, "hbr-0", 4),
    ("hbr-orient", None, "hbr-0-orient", None),
    ("hbr", None, "hbr-visual", None),
    ("hbr", None, "hbr-orient", None),
    ("ahbr", 4, "coin", 4),
    ("ahbr", None, "coin", None),
    ("ahbr", 4, "sweep-90", 4),
    ("ahbr", 4, "sweep-45", 4),
    ("ahbr-90", 4, "sweep-90", 4),
    ("ahbr-90", 4, "sweep-45", 4),
    *(("dense", n, other, n) for n in (2, 3) for other in ("dense-90", "dense-45", "dense-coin", "dense-random")),
    *(("dense", n, other, n) for n in (2, 3) for other in ("dense-mutual", "dense-oracle")),
    *(("hmm", n, other, n) for n in (2, 4, None) for other in ("hmm-random", "hbr", "ahbr")),
)


def method_results(
    runs: Runs, methods: Sequence[Method], margin: float, min_views: int = 2
) -> tuple[MethodResult, ...]:
    """Return the results of every method.

    Parameters
    ----------
    runs : Runs
        The runs of `methods`, in their order.
    margin : float
        Margin per view that ends a search of the paper.
    min_views : int
        Smallest number of views of a search.
    """
    return tuple(
        MethodResult(method, tuple(_point(runs, m, n) for n in _steps(runs, m)), _stopping(runs, m, margin, min_views))
        for m, method in enumerate(methods)
    )


def contests(runs: Runs, methods: Sequence[Method], rng: np.random.Generator) -> tuple[Contest, ...]:
    """Return the comparisons of `QUESTIONS` for which there are methods and views; `rng` resamples objects."""
    place = {method.name: m for m, method in enumerate(methods)}
    all_views = runs.rank.shape[-1]
    answers = []
    # a random stream for each question, so that its interval does not depend on the other questions
    for (first, first_views, second, second_views), own in zip(QUESTIONS, rng.spawn(len(QUESTIONS)), strict=True):
        a, b = first_views or all_views, second_views or all_views
        if first not in place or second not in place or max(a, b) > all_views:
            continue
        hits_a = runs.rank[place[first], ..., a - 1] == 1
        hits_b = runs.rank[place[second], ..., b - 1] == 1
        low, high = bootstrap_difference(hits_a, hits_b, own)
        only_a, only_b = int((hits_a & ~hits_b).sum()), int((hits_b & ~hits_a).sum())
        answers.append(
            Contest(
                first=first,
                first_views=a,
                second=second,
                second_views=b,
                trials=hits_a.size,
                first_rate=float(hits_a.mean()),
                second_rate=float(hits_b.mean()),
                difference=float(hits_a.mean() - hits_b.mean()),
                difference_low=low,
                difference_high=high,
                only_first=only_a,
                only_second=only_b,
                p_value=mcnemar_exact(only_a, only_b),
            )
        )
    return tuple(answers)


def pose_rmse_by_object(runs: Runs, method: int, *, similar: bool) -> FloatArray:
    """Return each object's RMS pose error after all views, from the trials that found it; nan if there are none."""
    last = _steps(runs, method)[-1]
    errors = (runs.alike_error_deg if similar else runs.pose_error_deg)[method, ..., last]
    hits = runs.rank[method, ..., last] == 1
    total = np.where(hits, errors, 0.0) ** 2
    count = hits.sum(axis=1)
    mean: FloatArray = np.divide(total.sum(axis=1), count, out=np.full(len(count), np.nan), where=count > 0)
    return np.sqrt(mean)


def step_median_ms(runs: Runs, method: int) -> list[float]:
    """Return the median time of a step after 1, 2, ... queries in the first trial of each object, in milliseconds."""
    return [float(np.median(runs.step_ns[method, :, 0, n])) * 1e-6 for n in _steps(runs, method)]


def _steps(runs: Runs, method: int) -> NDArray[np.intp]:
    """Return the indices of the queries that a method takes."""
    return np.flatnonzero((runs.rank[method] >= 0).all(axis=(0, 1)))


def _point(runs: Runs, method: int, n: int) -> Point:
    rank = runs.rank[method, ..., n]
    found = rank == 1
    hits, best10, trials = int(found.sum()), int(((rank >= 1) & (rank <= _BEST)).sum()), rank.size
    errors = runs.pose_error_deg[method, ..., n][found]
    similar = runs.alike_error_deg[method, ..., n][found]
    return Point(
        int(n) + 1,
        trials,
        hits,
        hits / trials,
        *wilson(hits, trials),
        best10,
        best10 / trials,
        *wilson(best10, trials),
        float(runs.travelled_deg[method, ..., n].mean()),
        _median(errors),
        _rms(errors),
        _median(similar),
        _rms(similar),
        _median(errors[runs.period_deg[method, ..., n][found] == 360]),
    )


def _stopping(runs: Runs, method: int, least_margin: float, min_views: int) -> Stopping:
    seen = _steps(runs, method)
    margin, outcome, named, travelled_deg = (
        part[method][..., seen].reshape(-1, len(seen))
        for part in (runs.margin, runs.outcome, runs.named, runs.travelled_deg)
    )
    # The dense search has an outcome at each view; the paper's ends by its margin.
    dense = bool((outcome >= 0).all())
    ends = outcome != OUTCOMES.index(Outcome.CONTINUE) if dense else (margin >= least_margin) & (seen + 1 >= min_views)
    end = np.where(ends.any(axis=1), ends.argmax(axis=1), len(seen) - 1)
    trial = np.arange(len(end))
    unknown, ambiguous = (outcome[trial, end] == OUTCOMES.index(one) for one in (Outcome.UNKNOWN, Outcome.AMBIGUOUS))
    found = ~unknown & ~ambiguous
    right = named[trial, end] & found
    hits = int(right.sum())
    stated = runs.stated[method][..., seen, :].reshape(-1, len(seen), 4)[trial, end][right]
    return Stopping(
        least_margin,
        float(end.mean()) + 1,
        float(np.quantile(end + 1, 0.95, method="higher")),
        hits / len(trial),
        *wilson(hits, len(trial)),
        float(unknown.mean()),
        float(ambiguous.mean()),
        float((found & ~right).mean()),
        float(travelled_deg[trial, end].mean()),
        float(ends[:, :-1].any(axis=1).mean()),
        pose_rates(stated[~np.isnan(stated[:, 0])]),
    )


def _median(errors_deg: FloatArray) -> float | None:
    return float(np.median(errors_deg)) if errors_deg.size else None


def _rms(errors_deg: FloatArray) -> float | None:
    return float(np.sqrt(np.mean(errors_deg**2))) if errors_deg.size else None


def results_of(
    runs: Runs, methods: Sequence[Method], margin: float, min_views: int, rng: np.random.Generator
) -> dict[str, Any]:
    """Return all results as JSON values, units in the keys; equal runs give equal values except ``wall_clock``.

    Arguments as for `method_results` and `contests`.
    """
    return {
        "methods": [
            {
                "name": result.method.name,
                "label": result.method.label,
                "curve": [asdict(point) for point in result.curve],
                "stopping": asdict(result.stopping),
                "pose_rmse_deg_by_object": _plain(pose_rmse_by_object(runs, m, similar=False)),
                "alike_rmse_deg_by_object": _plain(pose_rmse_by_object(runs, m, similar=True)),
            }
            for m, result in enumerate(method_results(runs, methods, margin, min_views))
        ],
        "contests": [asdict(contest) for contest in contests(runs, methods, rng)],
        "wall_clock": {"step_median_ms": {method.name: step_median_ms(runs, m) for m, method in enumerate(methods)}},
    }


def _plain(values: FloatArray) -> list[float | None]:
    return [None if np.isnan(value) else round(float(value), 3) for value in values]
