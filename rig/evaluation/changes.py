"""Searches after a change of the bench, in several processes; results as JSON and as a table."""

from collections.abc import Callable, Collection
from dataclasses import asdict
from functools import lru_cache, partial
from importlib.metadata import version
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import LevelArray
from hbr.dense.fitting import fit_stopping_rule
from hbr.dense.index import DenseIndex
from hbr.dense.stopping import StoppingRule
from hbr.evaluation.changes import (
    DESCRIPTOR,
    Changes,
    EnrolledViews,
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

#: Objects whose enrolled views each process remembers for the last steps of searches, 4 MB each with 36 views.
_REMEMBERED: Final = 128


def run_changes(
    dataset: Dataset,
    changes: Changes,
    jobs: Jobs,
    advance: Callable[[str], None],
    reported: Collection[str] | None = None,
) -> dict[str, Any]:
    """Enroll objects on one bench, search for all on changed ones, and return the shares as JSON values.

    The shares of the objects ``reported``, searched for among all, are given once more. Equal settings give equal
    values. `advance` is called with each object's name after its enrollment, and again after its searches.

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
    rule = fit_stopping_rule(index).rule
    searched: dict[str, list[SearchResult]] = {}
    work = partial(_search, dataset, changes, index.views, rule)
    for j, results in map_in_processes(work, range(len(dataset.objects)), jobs):
        searched[dataset.objects[j].name] = results
        advance(dataset.objects[j].name)

    def shares(of: Collection[str]) -> dict[str, float | int]:
        some = {name: results for name, results in searched.items() if name in of}
        known = {name: results for name, results in some.items() if name in names}
        return summary(known, {name: results for name, results in some.items() if name not in known})

    return {
        "settings": {"version": version("hbr-rig"), "dataset": dataset.name, "objects": len(names), **asdict(changes)},
        "changed_bench": shares(searched),
        **({} if reported is None else {"reported": shares(reported)}),
        "fitted": [asdict(one) for one in rule.rates],
        "searches": {item.name: [asdict(one) for one in searched[item.name]] for item in dataset.objects},
    }


def change_rows(results: dict[str, Any]) -> Rows:
    """Return a table of the shares, in percent: of all objects, and of those that are reported alone."""
    heads = ["change, %", "ranking, N = 1 / 2 / 4", "decided right", "wrong", "ambiguous", "called unknown"]
    heads += ["leader verified", "leaders compared", "right / wrong by it", "unknown accepted"]
    rows = [_row(results["settings"], results["changed_bench"])]
    if "reported" in results:
        rows.append(_row(results["settings"], results["reported"]))
    return Rows([*heads, "left out in turn: accepted"], rows)


def _row(settings: dict[str, Any], found: dict[str, Any]) -> list[str]:
    ranking = " / ".join(f"{100 * found[f'hit_rate_{n}']:.1f}" for n in (1, 2, 4))
    return [
        f"{settings['kind']}, {'picture' if settings['picture'] else 'no picture'}",
        f"{ranking} of {found['searches']}",
        f"{100 * found['decided_right']:.1f} in {found['mean_views']:.2f} views",
        f"{100 * found['decided_wrong']:.1f}",
        f"{100 * found['ambiguous']:.1f}",
        f"{100 * found['called_unknown']:.1f}",
        f"{100 * found['verified']:.1f}",
        f"{100 * found['compared']:.1f}",
        f"{100 * found['right_by_comparison']:.1f} / {100 * found['wrong_by_comparison']:.1f}",
        f"{100 * found['unknown_accepted']:.1f} of {found['unknown_searches']}",
        f"{100 * found['left_out_accepted']:.1f} of {found['left_out_searches']}",
    ]


def _enroll(dataset: Dataset, changes: Changes, names: list[str], j: int) -> tuple[LevelArray, NDArray[np.float64]]:
    found = _enrolled(dataset, changes, names[j])
    return found.levels, found.azimuth_deg


@lru_cache(maxsize=_REMEMBERED)
def _enrolled(dataset: Dataset, changes: Changes, name: str) -> EnrolledViews:
    return enroll_changed(next(item for item in dataset.objects if item.name == name), changes)


def _search(dataset: Dataset, changes: Changes, views: Views, rule: StoppingRule, j: int) -> list[SearchResult]:
    example = next(item for item in dataset.objects if item.name == views.object_names[0])
    enrolled = partial(_enrolled, dataset, changes)
    return search_changed(dataset.objects[j], changes, DenseIndex(views), rule, example, enrolled)
