"""Objects left out of the catalog and looked for all the same, over processes."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any, Final

import numpy as np

from hbr.dense.filter import DenseIndex
from hbr.dense.stopping import Rehearsal, rehearse
from hbr.evaluation.descriptors import query_levels
from hbr.evaluation.methods import METHODS
from hbr.evaluation.protocol import Protocol, Runs, run_object, views_of_trial
from hbr.evaluation.statistics import wilson
from hbr.evaluation.unknown_objects import left_out, strangers
from hbr.model.views import Views
from rig.core.processes import map_in_processes
from rig.evaluation.plan import Plan
from rig.evaluation.report import Rows

#: Nominal shares of known objects that may be called unknown.
NOMINAL: Final = (0.005, 0.01, 0.02, 0.05)


def run_strangers(
    plan: Plan, views: Views, count: int, draws: int, jobs: int, advance: Callable[[str], None]
) -> dict[str, Any]:
    """Return false accepts and rejects after each number of views, as JSON values; equal plans give equal values.

    Raises
    ------
    DatasetError, ValueError
        A photograph cannot be used, or too many objects would be left out.
    """
    names = tuple(item.name for item in plan.dataset.objects)
    protocols = left_out(plan.protocol, names, count, draws)
    found: dict[int, list[Runs]] = {}
    for j, runs in map_in_processes(partial(_search, plan, views, protocols), range(len(names)), jobs):
        found[j] = runs
        advance(names[j])
    parts = [
        (
            Runs.concatenate([found[j][draw] for j in range(len(names))]),
            np.array([name in protocol.absent for name in names]),
        )
        for draw, protocol in enumerate(protocols)
    ]
    # too few views of each object to leave out those of a search: the catalog says nothing of itself
    enough = (plan.protocol.enrolled or plan.dataset.views) > plan.protocol.max_views
    rehearsals = [_rehearsed(views, protocol) for protocol in protocols] if enough else []
    rows = []
    for nominal in NOMINAL:
        for row in (*strangers(parts, nominal), *(strangers(parts, nominal, rehearsals) if enough else ())):
            low, high = wilson(row.false_accepts, row.stranger_trials)
            rows.append({**asdict(row), "false_accepts_low": low, "false_accepts_high": high})
    settings = {**plan.settings(), "left_out": count, "draws": draws}
    return {"settings": settings, "strangers": rows}


def stranger_rows(results: dict[str, Any]) -> Rows:
    """Return the table: a row a nominal rate, realised false rejects and false accepts in percent by views."""
    by_nominal: dict[tuple[bool, float], list[str]] = {}
    for row in results["strangers"]:
        rejected = 100 * row["false_rejects"] / row["known_trials"]
        accepted = 100 * row["false_accepts"] / row["stranger_trials"]
        by_nominal.setdefault((row["rehearsed"], row["nominal"]), []).append(f"{rejected:.2f} / {accepted:.2f}")
    views = max(row["views"] for row in results["strangers"])
    heads = ["false rejects / accepts, %, at N =", *(str(n) for n in range(1, views + 1))]
    names = {key: f"nominal {100 * key[1]:g}{', rehearsed' if key[0] else ''}" for key in sorted(by_nominal)}
    return Rows(heads, [[name, *by_nominal[key]] for key, name in names.items()])


def _rehearsed(views: Views, protocol: Protocol) -> Rehearsal:
    """What the catalog says of itself, as on a bench."""
    there = views_of_trial(views, protocol)
    return rehearse(DenseIndex(views.select(there)), views=protocol.max_views)


def _search(plan: Plan, views: Views, protocols: tuple[Protocol, ...], j: int) -> list[Runs]:
    queries = query_levels(plan.dataset, j, plan.condition, plan.size, plan.protocol.seed)
    return [run_object(j, queries, views, (METHODS["dense"],), protocol) for protocol in protocols]
