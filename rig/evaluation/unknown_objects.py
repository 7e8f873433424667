"""Searches for objects that are not enrolled, in several processes."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any, Final

import numpy as np

from hbr.dense.fitting import LeaveOneOut, fitting_searches, rule_from_searches
from hbr.dense.index import DenseIndex
from hbr.dense.stopping import StoppingRule
from hbr.evaluation.descriptors import query_levels
from hbr.evaluation.methods import METHODS
from hbr.evaluation.protocol import Protocol, Runs, views_of_trial
from hbr.evaluation.statistics import wilson
from hbr.evaluation.trials import run_object
from hbr.evaluation.unknown_objects import left_out, unknown_objects
from hbr.model.views import Views
from rig.core.processes import Jobs, map_in_processes
from rig.evaluation.plan import Plan
from rig.evaluation.report import Rows

#: Nominal shares of enrolled objects that may be called unknown.
NOMINAL: Final = (0.005, 0.01, 0.02, 0.05)


def run_unknown_objects(
    plan: Plan, views: Views, count: int, draws: int, jobs: Jobs, advance: Callable[[str], None]
) -> dict[str, Any]:
    """Return false accepts and rejects after each number of views, as JSON values; equal plans give equal values.

    Raises
    ------
    DatasetError, ValueError
        A photograph cannot be used, or too many objects would be left out.
    """
    names = tuple(item.name for item in plan.dataset.objects)
    protocols = left_out(plan.protocol, names, count, draws)
    searches = [_searches(views, protocol) for protocol in protocols]
    rules = {rate: _rules(searches, rate) for rate in NOMINAL}
    found: dict[int, list[Runs]] = {}
    search = partial(_search, plan, views, tuple(zip(protocols, rules[NOMINAL[0]], strict=True)))
    for j, runs in map_in_processes(search, range(len(names)), jobs):
        found[j] = runs
        advance(names[j])
    parts = [
        (
            Runs.concatenate([found[j][draw] for j in range(len(names))]),
            np.array([name in protocol.absent for name in names]),
        )
        for draw, protocol in enumerate(protocols)
    ]
    rows = []
    for rate in NOMINAL:
        for row in (*unknown_objects(parts, rate), *unknown_objects(parts, rate, rules[rate])):
            low, high = wilson(row.false_accepts, row.unknown_trials)
            rows.append({**asdict(row), "false_accepts_low": low, "false_accepts_high": high})
    settings = {**plan.settings(), "left_out": count, "draws": draws}
    return {"settings": settings, "unknown_objects": rows}


def unknown_object_rows(results: dict[str, Any]) -> Rows:
    """Return a table: nominal rates by views, with the measured false rejects and false accepts in percent."""
    by_nominal: dict[tuple[bool, float], list[str]] = {}
    for row in results["unknown_objects"]:
        rejected = 100 * row["false_rejects"] / row["known_trials"]
        accepted = 100 * row["false_accepts"] / row["unknown_trials"]
        by_nominal.setdefault((row["fitted"], row["nominal"]), []).append(f"{rejected:.2f} / {accepted:.2f}")
    views = max(row["views"] for row in results["unknown_objects"])
    heads = ["false rejects / accepts, %, at N =", *(str(n) for n in range(1, views + 1))]
    names = {key: f"nominal {100 * key[1]:g}{', fitted' if key[0] else ''}" for key in sorted(by_nominal)}
    return Rows(heads, [[name, *by_nominal[key]] for key, name in names.items()])


def _searches(views: Views, protocol: Protocol) -> LeaveOneOut:
    searches = fitting_searches(DenseIndex(views.select(views_of_trial(views, protocol))))
    if searches is None:
        raise ValueError(
            "objects with a single enrolled view are too few for a stopping rule; enroll more views of each"
        )
    return searches


def _rules(searches: list[LeaveOneOut], false_reject: float) -> list[StoppingRule]:
    return [rule_from_searches(one, false_reject=false_reject) for one in searches]


def _search(plan: Plan, views: Views, draws: tuple[tuple[Protocol, StoppingRule], ...], j: int) -> list[Runs]:
    queries = query_levels(plan.dataset, j, plan.condition, plan.size, plan.protocol.seed)
    return [run_object(j, queries, views, (METHODS["dense"],), protocol, rule=rule) for protocol, rule in draws]
