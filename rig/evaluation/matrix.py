"""The matrix of perturbations: run in several processes; results as JSON and as a table."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hbr.dense.index import DenseIndex
from hbr.evaluation.matrix import Cell, cells, enrolled_few, hits
from hbr.evaluation.statistics import wilson
from hbr.model.views import Views
from rig.core.processes import Jobs, map_in_processes
from rig.evaluation.plan import Plan
from rig.evaluation.report import Rows

_Enrolled = dict[bool, Views]


def run_matrix(plan: Plan, jobs: Jobs, advance: Callable[[str], None]) -> dict[str, Any]:
    """Return the hit rate of every cell after each number of views, as JSON values; equal plans give equal values.

    `advance` is called with the name of each object after its enrollment and after its searches.

    Raises
    ------
    DatasetError, ValueError
        A photograph cannot be used, or there are too few photographs.
    """
    matrix = cells(plan.condition)
    names = [item.name for item in plan.dataset.objects]
    enrolled: dict[int, _Enrolled] = {}
    for j, own in map_in_processes(partial(_enroll, plan, matrix), range(len(names)), jobs):
        enrolled[j] = own
        advance(names[j])
    models = {
        on_bench: Views.concatenate([enrolled[j][on_bench] for j in range(len(names))]) for on_bench in enrolled[0]
    }
    found: dict[int, NDArray[np.bool_]] = {}
    for j, own_hits in map_in_processes(partial(_search, plan, matrix, models), range(len(names)), jobs):
        found[j] = own_hits
        advance(names[j])
    together = np.stack([found[j] for j in range(len(names))])  # objects, cells, trials, views
    rows = []
    for c, cell in enumerate(matrix):
        trials = together[:, c].reshape(-1, together.shape[-1])
        counts = trials.sum(axis=0).tolist()
        low, high = zip(*(wilson(count, len(trials)) for count in counts), strict=True)
        rows.append(
            {
                "kind": cell.kind,
                "strength": cell.strength,
                "trials": len(trials),
                "hit_rate": [count / len(trials) for count in counts],
                "hit_rate_low": list(low),
                "hit_rate_high": list(high),
            }
        )
    return {"settings": plan.settings(), "matrix": rows}


def matrix_rows(results: dict[str, Any]) -> Rows:
    """Return a table: perturbations by strengths, with the hit rates in percent after one view and after all."""
    by_kind: dict[str, dict[int, str]] = {}
    for row in results["matrix"]:
        one, last = (f"{100 * row['hit_rate'][n]:.1f}" for n in (0, -1))
        by_kind.setdefault(row["kind"], {})[row["strength"]] = f"{one} / {last}"
    views = len(results["matrix"][0]["hit_rate"])
    heads = [f"hit rate, %, N = 1 / {views}", "strength 1", "2", "3"]
    return Rows(heads, [[kind, *(own.get(s, own.get(0, "")) for s in (1, 2, 3))] for kind, own in by_kind.items()])


def _enroll(plan: Plan, matrix: Sequence[Cell], j: int) -> _Enrolled:
    count = plan.protocol.enrolled or len(plan.dataset.objects[j].photographs)
    kinds = {cell.condition.on_bench for cell in matrix}
    conditions = {on: replace(plan.condition, background="bench" if on else "same") for on in kinds}
    return {on: enrolled_few(plan.dataset, j, conditions[on], plan.size, count) for on in sorted(kinds)}


def _search(plan: Plan, matrix: Sequence[Cell], models: _Enrolled, j: int) -> NDArray[np.bool_]:
    indices = {on_bench: DenseIndex(views) for on_bench, views in models.items()}
    return np.stack(
        [
            hits(plan.dataset, j, indices[cell.condition.on_bench], cell.condition, plan.size, plan.protocol)
            for cell in matrix
        ]
    )
