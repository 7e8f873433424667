"""Results of runs: hit rates by the number of views, decisions, pose errors, and comparisons of methods."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray
from hbr.dense.stopping import Outcome
from hbr.evaluation.poses import pose_rates
from hbr.evaluation.protocol import OUTCOMES, Method, Runs
from hbr.evaluation.statistics import bootstrap_difference, mcnemar_exact, wilson

Row = dict[str, Any]

_BEST: int = 10  # the paper's "Best 10"


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


def results_of(runs: Runs, methods: Sequence[Method], margin: float, min_views: int, rng: np.random.Generator) -> Row:
    """Return all results as JSON values, units in the keys; equal runs give equal values except ``wall_clock``.

    Arguments as for `method_results` and `contests`.
    """
    step_ms = {method.name: step_median_ms(runs, m) for m, method in enumerate(methods)}
    return {
        "methods": method_results(runs, methods, margin, min_views),
        "contests": contests(runs, methods, rng),
        "wall_clock": {"step_median_ms": step_ms},
    }


def method_results(runs: Runs, methods: Sequence[Method], margin: float, min_views: int = 2) -> list[Row]:
    """Return the results of every method; ``runs`` are those of ``methods``, in their order.

    A search of the paper ends at this margin per view, after at least ``min_views``.
    """
    return [
        {
            "name": method.name,
            "label": method.label,
            "curve": [_point(runs, m, n) for n in _steps(runs, m)],
            "stopping": _stopping(runs, m, margin, min_views),
            "pose_rmse_deg_by_object": _rmse_by_object(runs.pose_error_deg, runs, m),
            "alike_rmse_deg_by_object": _rmse_by_object(runs.alike_error_deg, runs, m),
        }
        for m, method in enumerate(methods)
    ]


def contests(runs: Runs, methods: Sequence[Method], rng: np.random.Generator) -> list[Row]:
    """Return the comparisons of `QUESTIONS` for which there are methods and views; `rng` resamples objects.

    Each compares two methods on the same trials; the difference is the first hit rate minus the second. The interval
    comes from resampled objects; McNemar's exact test is for independent trials.
    """
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
            {
                "first": first,
                "first_views": a,
                "second": second,
                "second_views": b,
                "trials": hits_a.size,
                "first_rate": float(hits_a.mean()),
                "second_rate": float(hits_b.mean()),
                "difference": float(hits_a.mean() - hits_b.mean()),
                "difference_low": low,
                "difference_high": high,
                "only_first": only_a,
                "only_second": only_b,
                "p_value": mcnemar_exact(only_a, only_b),
            }
        )
    return answers


def step_median_ms(runs: Runs, method: int) -> list[float]:
    """Return the median time of a step after 1, 2, ... queries in the first trial of each object, in milliseconds."""
    return [float(np.median(runs.step_ns[method, :, 0, n])) * 1e-6 for n in _steps(runs, method)]


def _steps(runs: Runs, method: int) -> NDArray[np.intp]:
    """Return the indices of the queries that a method takes."""
    return np.flatnonzero((runs.rank[method] >= 0).all(axis=(0, 1)))


def _point(runs: Runs, method: int, n: int) -> Row:
    """Return the results of a method after query ``n``, counted from 0.

    Pose errors are those of the trials that found the object, None if there are none; the asymmetric ones are of
    objects without a symmetry. Intervals are Wilson's at 95 %, for independent trials.
    """
    rank = runs.rank[method, ..., n]
    found = rank == 1
    hits, best10, trials = int(found.sum()), int(((rank >= 1) & (rank <= _BEST)).sum()), rank.size
    errors = runs.pose_error_deg[method, ..., n][found]
    similar = runs.alike_error_deg[method, ..., n][found]
    return {
        "views": int(n) + 1,
        "trials": trials,
        "hits": hits,
        **_rate("hit", hits, trials),
        "best10_hits": best10,
        **_rate("best10", best10, trials, interval="best10"),
        "travelled_mean_deg": float(runs.travelled_deg[method, ..., n].mean()),
        "pose_error_median_deg": _median(errors),
        "pose_error_rmse_deg": _rms(errors),
        "alike_error_median_deg": _median(similar),
        "alike_error_rmse_deg": _rms(similar),
        "asymmetric_error_median_deg": _median(errors[runs.period_deg[method, ..., n][found] == 360]),
    }


def _rate(name: str, hits: int, trials: int, interval: str = "hit_rate") -> Row:
    """Return a share of trials with its interval."""
    low, high = wilson(hits, trials)
    return {f"{name}_rate": hits / trials, f"{interval}_low": low, f"{interval}_high": high}


def _stopping(runs: Runs, method: int, least_margin: float, min_views: int) -> Row:
    """Return the results of searches with an end: by a decision, or after all views.

    The paper's methods end when the margin per view reaches ``margin``; the dense filter ends by the stopping rule that
    was fitted to the enrolled views. A hit is a search that found the right object. ``unknown_rate``,
    ``ambiguous_rate`` and ``wrong_rate`` are the shares of searches with these outcomes, and ``ended_early`` is the
    share that ended before the last view. ``pose`` has the rates of `hbr.evaluation.poses.pose_rates` for the hits of
    the dense filter.
    """
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
    stated = runs.stated[method][..., seen, :].reshape(-1, len(seen), 4)[trial, end][right]
    return {
        "margin": least_margin,
        "views_mean": float(end.mean()) + 1,
        "views_p95": float(np.quantile(end + 1, 0.95, method="higher")),
        **_rate("hit", int(right.sum()), len(trial)),
        "unknown_rate": float(unknown.mean()),
        "ambiguous_rate": float(ambiguous.mean()),
        "wrong_rate": float((found & ~right).mean()),
        "travelled_mean_deg": float(travelled_deg[trial, end].mean()),
        "ended_early": float(ends[:, :-1].any(axis=1).mean()),
        "pose": pose_rates(stated[~np.isnan(stated[:, 0])]),
    }


def _rmse_by_object(errors_deg: FloatArray, runs: Runs, method: int) -> list[float | None]:
    """Return each object's RMS error after all views, from the trials that found it; None if there are none."""
    last = _steps(runs, method)[-1]
    hits = runs.rank[method, ..., last] == 1
    rms = (_rms(errors[own]) for errors, own in zip(errors_deg[method, ..., last], hits, strict=True))
    return [None if one is None else round(one, 3) for one in rms]


def _median(errors_deg: FloatArray) -> float | None:
    return float(np.median(errors_deg)) if errors_deg.size else None


def _rms(errors_deg: FloatArray) -> float | None:
    return float(np.sqrt(np.mean(errors_deg**2))) if errors_deg.size else None
