"""Searches after a change of the bench, in several processes; results as JSON and as a table."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import LevelArray
from hbr.dense.calibration import calibrate_stopping_rule
from hbr.dense.index import DenseIndex
from hbr.dense.stopping import StoppingRule
from hbr.evaluation.changes import (
    DESCRIPTOR,
    Changes,
    SearchResult,
    enroll_changed,
    enrolled_names,
    search_changed,
    summary,
)
from hbr.evaluation.datasets import Dataset
from hbr.model.views import Views
from rig.core.processes import Jobs, map_in_processes
from rig.evaluation.report import Rows


def run_changes(dataset: Dataset, changes: Changes, jobs: Jobs, advance: Callable[[str], None]) -> dict[str, Any]:
    """Enroll objects on one bench, search for all on changed ones, and return the shares as JSON values.

    Equal settings give equal values. `advance` is called with each object's name after its enrollment, and again after
    its searches.

    Raises
    ------
    DatasetError, ValueError
        A photograph cannot be used, or fewer than two objects are enrolled.
    """
    names = enrolled_names(dataset, changes)
    if len(names) < 2:
        raise ValueError(f"{len(names)} object is enrolled; at least two are needed")
    items = [item for item in dataset.objects if item.name in names]
    enrolled: dict[int, tuple[LevelArray, NDArray[np.float64]]] = {}
    for j, found in map_in_processes(partial(_enroll, dataset, changes, names), range(len(names)), jobs):
        enrolled[j] = found
        advance(names[j])
    parts = [Views.of_object(item.name, *enrolled[j], DESCRIPTOR) for j, item in enumerate(items)]
    index = DenseIndex(Views.concatenate(parts))
    rule = calibrate_stopping_rule(index).rule
    searched: dict[str, list[SearchResult]] = {}
    work = partial(_search, dataset, changes, index.views, rule)
    for j, results in map_in_processes(work, range(len(dataset.objects)), jobs):
        searched[dataset.objects[j].name] = results
        advance(dataset.objects[j].name)
    return {
        "settings": {"version": version("hbr-rig"), "dataset": dataset.name, "objects": len(names), **asdict(changes)},
        "changed_bench": summary(
            {name: results for name, results in searched.items() if name in names},
            {name: results for name, results in searched.items() if name not in names},
        ),
        "calibrated": [asdict(one) for one in rule.rates],
    }


def change_rows(results: dict[str, Any]) -> Rows:
    """Return a table of the shares, in percent."""
    found, settings = results["changed_bench"], results["settings"]
    ranking = " / ".join(f"{100 * found[f'hit_rate_{n}']:.1f}" for n in (1, 2, 4))
    row = [
        f"{settings['kind']}, {'picture of the empty table' if settings['picture'] else 'no picture'}",
        ranking,
        f"{100 * found['decided_right']:.1f} in {found['mean_views']:.2f} views",
        f"{100 * found['decided_wrong']:.1f}",
        f"{100 * found['called_unknown']:.1f}",
        f"{100 * found['unknown_accepted']:.1f} of {found['unknown_searches']}",
    ]
    return Rows(
        ["change, %", "ranking, N = 1 / 2 / 4", "decided right", "wrong", "called unknown", "unknown accepted"], [row]
    )


def _enroll(dataset: Dataset, changes: Changes, names: list[str], j: int) -> tuple[LevelArray, NDArray[np.float64]]:
    item = next(item for item in dataset.objects if item.name == names[j])
    return enroll_changed(item, changes)


def _search(dataset: Dataset, changes: Changes, views: Views, rule: StoppingRule, j: int) -> list[SearchResult]:
    example = next(item for item in dataset.objects if item.name == views.object_names[0])
    return search_changed(dataset.objects[j], changes, DenseIndex(views), rule, example)
