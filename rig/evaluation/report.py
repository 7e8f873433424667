"""Results of an evaluation as JSON values, CSV and tables."""

import csv
import io
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from hbr.descriptors import descriptor
from hbr.evaluation.draws import generator
from hbr.evaluation.protocol import Runs
from hbr.evaluation.results import Contest, contests, method_results, pose_rmse_by_object, step_median_ms
from rig.core.phrases import percent, signed
from rig.evaluation.plan import Plan


def evaluate(
    plan: Plan, runs: Runs, margin: float, min_views: int, reported: tuple[int, int] | None = None
) -> dict[str, Any]:
    """Return all results as JSON values, units in the keys; equal runs give equal values except ``wall_clock``.

    Parameters
    ----------
    margin, min_views
        As for `hbr.evaluation.results.method_results`.
    reported
        The first and the last reported object, counted from 1; None: all.
    """
    if reported is not None:
        runs = runs.of(slice(reported[0] - 1, reported[1]))
    methods = method_results(runs, plan.methods, margin, min_views)
    rng = generator(plan.protocol.seed, plan.dataset.name, "bootstrap", 0)
    return {
        "settings": plan.settings(),
        "reported": None if reported is None else list(reported),
        "bytes_per_view": descriptor(plan.condition.descriptor).size_bytes,
        "methods": [
            {
                "name": result.method.name,
                "label": result.method.label,
                "curve": [asdict(point) for point in result.curve],
                "stopping": asdict(result.stopping),
                "pose_rmse_deg_by_object": _plain(pose_rmse_by_object(runs, m, similar=False)),
                "alike_rmse_deg_by_object": _plain(pose_rmse_by_object(runs, m, similar=True)),
            }
            for m, result in enumerate(methods)
        ],
        "contests": [asdict(contest) for contest in contests(runs, plan.methods, rng)],
        "wall_clock": {
            "step_median_ms": {method.name: step_median_ms(runs, m) for m, method in enumerate(plan.methods)}
        },
    }


def csv_text(results: dict[str, Any]) -> str:
    """Return one row for each method and number of views."""
    rows = [
        {"method": method["name"], **point, "step_median_ms": step_ms}
        for method in results["methods"]
        for point, step_ms in zip(method["curve"], results["wall_clock"]["step_median_ms"][method["name"]], strict=True)
    ]
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


class Rows(NamedTuple):
    """A table of texts: headings and rows; the first column contains names."""

    columns: list[str]
    rows: list[list[str]]

    def terminal(self) -> Table:
        table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
        for i, heading in enumerate(self.columns):
            table.add_column(heading, justify="right" if i else "left", no_wrap=True)
        for row in self.rows:
            table.add_row(*row)
        return table


def curve_rows(results: dict[str, Any], *, interval: bool = False) -> Rows:
    """Return hit rates in percent by method and number of views, optionally with intervals, and Best 10."""
    count = max(len(method["curve"]) for method in results["methods"])
    rows = []
    for method in results["methods"]:
        cells = [f"{100 * point['hit_rate']:.1f}" for point in method["curve"]]
        if interval:
            cells = [
                f"{cell} [{100 * point['hit_rate_low']:.1f}, {100 * point['hit_rate_high']:.1f}]"
                for cell, point in zip(cells, method["curve"], strict=True)
            ]
        best10 = f"{100 * method['curve'][-1]['best10_rate']:.1f}"
        rows.append([method["label"], *cells, *[""] * (count - len(cells)), best10])
    return Rows(["hit rate, %, at N =", *(str(n) for n in range(1, count + 1)), "best 10"], rows)


def decision_rows(results: dict[str, Any]) -> Rows:
    """Return the cost of a decision, and the error of the pose after all views, by method."""
    rows = []
    for method in results["methods"]:
        last, stopping = method["curve"][-1], method["stopping"]
        poses = [last[f"{kind}_error_{measure}_deg"] for kind in ("pose", "alike") for measure in ("median", "rmse")]
        poses.append(last["asymmetric_error_median_deg"])
        rows.append(
            [
                method["label"],
                f"{stopping['views_mean']:.2f}",
                f"{stopping['views_p95']:.0f}",
                f"{100 * stopping['hit_rate']:.2f}",
                f"{100 * stopping['ambiguous_rate']:.2f}",
                f"{100 * stopping['unknown_rate']:.2f}",
                f"{100 * stopping['wrong_rate']:.2f}",
                f"{100 * stopping['compared_rate']:.2f}",
                f"{100 * stopping['compared_right_rate']:.2f}",
                f"{stopping['travelled_mean_deg']:.0f}",
                *("–" if error is None else f"{error:.1f}" for error in poses),
                f"{results['wall_clock']['step_median_ms'][method['name']][-1]:.1f}",
            ]
        )
    heads = [
        "decision",
        "views",
        "p95",
        "hits %",
        "ambiguous %",
        "unknown %",
        "wrong %",
        "compared %",
        "right by it %",
        "rotated°",
        "pose°",
        "RMSE°",
        "similar°",
        "RMSE°",
        "asym.°",
        "ms",
    ]
    return Rows(heads, rows)


def contest_sentences(results: dict[str, Any]) -> list[str]:
    """Return each comparison in words, with its interval and p-value."""
    labels = {method["name"]: method["label"] for method in results["methods"]}
    return [_sentence(Contest(**contest), labels) for contest in results["contests"]]


def _sentence(contest: Contest, labels: dict[str, str]) -> str:
    first = f"{labels[contest.first]} at N = {contest.first_views}"
    second = f"{labels[contest.second]} at N = {contest.second_views}"
    if contest.difference_low > 0 and contest.p_value < 0.05:
        result = "better"
    elif contest.difference_high < 0 and contest.p_value < 0.05:
        result = "worse"
    else:
        result = "no difference shown"
    return (
        f"{first} ({percent(contest.first_rate)}) against {second} ({percent(contest.second_rate)}): "
        f"{signed(100 * contest.difference, 1)} points "
        f"[{signed(100 * contest.difference_low, 1)}, {signed(100 * contest.difference_high, 1)}], "
        f"McNemar p = {contest.p_value:.2g} ({contest.only_first} trials to {contest.only_second}); {result}"
    )


def _plain(values: Any) -> list[float | None]:
    return [None if np.isnan(value) else round(float(value), 3) for value in values]
