"""Results of an experiment as tables of texts: each is made of the rows that ``results.csv`` has."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.table import Table

from hbr.evaluation.results import Row
from rig.core.phrases import percent, signed


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Return a table for a terminal; its first column contains names."""
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for i, heading in enumerate(columns):
        table.add_column(heading, justify="right" if i else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def rows_of(results: Mapping[str, Any]) -> list[Row]:
    """Return the results in long form; of trials, one row for each method and number of views."""
    if "methods" not in results:
        rows: list[Row] = results["rows"]
        return rows
    took = results["wall_clock"]["step_median_ms"]
    return [
        {"method": method["name"], **point, "step_median_ms": step_ms}
        for method in results["methods"]
        for point, step_ms in zip(method["curve"], took[method["name"]], strict=True)
    ]


def tables(results: Mapping[str, Any]) -> list[Table]:
    """Return the tables that the terminal shows."""
    rows = rows_of(results)
    if "methods" in results:
        stated = {method["label"]: method["stopping"]["pose"] for method in results["methods"]}
        return [_curves(results, rows), _decisions(results), _stated(stated), _poses(results)]
    by_change = {f"{row['change']}, {row['objects']}": row for row in rows}
    return [_changes(rows), _intervals(rows), _probabilities(by_change), _stated(by_change)]


def _curves(results: Mapping[str, Any], rows: Sequence[Row]) -> Table:
    """Return a line for each method, and a column for each number of views."""
    views = sorted({row["views"] for row in rows})
    lines = []
    for method in results["methods"]:
        own = {row["views"]: row for row in rows if row["method"] == method["name"]}
        rates = [_percent(own[n]["hit_rate"]) if n in own else "" for n in views]
        lines.append([method["label"], *rates, _percent(own[max(own)]["best10_rate"])])
    return _table(["hit rate, %, at N =", *map(str, views), "best 10"], lines)


def _decisions(results: Mapping[str, Any]) -> Table:
    """Return the cost of a decision, and the error of the pose after all views, by method."""
    rows = []
    for method in results["methods"]:
        last, stopping = method["curve"][-1], method["stopping"]
        poses = [last[f"{kind}_error_{measure}_deg"] for kind in ("pose", "alike") for measure in ("median", "rmse")]
        poses.append(last["asymmetric_error_median_deg"])
        rates = ("hit", "ambiguous", "unknown", "wrong")
        rows.append(
            [
                method["label"],
                f"{stopping['views_mean']:.2f}",
                f"{stopping['views_p95']:.0f}",
                *(f"{100 * stopping[f'{rate}_rate']:.2f}" for rate in rates),
                f"{stopping['travelled_mean_deg']:.0f}",
                *("–" if error is None else f"{error:.1f}" for error in poses),
                f"{results['wall_clock']['step_median_ms'][method['name']][-1]:.1f}",
            ]
        )
    heads = "decision|views|p95|hits %|ambiguous %|unknown %|wrong %|rotated°|pose°|RMSE°"
    return _table([*heads.split("|"), "similar°", "RMSE°", "asym.°", "ms"], rows)


def _poses(results: Mapping[str, Any]) -> Table:
    """Return how the RMS error of the orientation after all views is distributed over the objects (Fig. 5)."""
    rows = []
    for method in results["methods"]:
        found = [error for error in method["pose_rmse_deg_by_object"] if error is not None]
        cells = [f"{value:.1f}" for value in np.quantile(found, [0, 0.25, 0.5, 0.75, 1])] if found else ["–"] * 5
        rows.append([method["label"], str(len(found)), *cells])
    heads = "RMSE of the pose by object, °|objects|least|25 %|median|75 %|largest"
    return _table(heads.split("|"), rows)


def _stated(rates: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return what right answers state about the pose, by the name of the row (`hbr.evaluation.poses.pose_rates`)."""
    heads = "pose of right answers|one, %|several, %|error°|towards a view°|within σ, %|within 2 σ, %|one, 30° off, %"
    scales = {"pose_one": 100, "pose_several": 100, "pose_error_median_deg": 1, "pose_toward_view_median_deg": 1}
    scales |= {"pose_within_1_sigma": 100, "pose_within_2_sigma": 100, "pose_far": 100}
    return _table(heads.split("|"), [[name, *_cells(own, scales)] for name, own in rates.items()])


def _cells(own: Mapping[str, Any], scales: Mapping[str, int]) -> list[str]:
    return ["–" if own[key] is None else f"{scale * own[key]:.1f}" for key, scale in scales.items()]


def _changes(rows: Sequence[Row]) -> Table:
    """Return the shares in percent: of all objects, and of those that are reported alone."""
    heads = "change, %|objects|ranking, N = 1 / 2 / 4|decided right|wrong|ambiguous|called unknown|leader verified"
    heads += "|unknown accepted|left out in turn: accepted"
    shares = ("decided_wrong", "ambiguous", "called_unknown", "verified")
    return _table(
        heads.split("|"),
        [
            [
                row["change"],
                row["objects"],
                f"{' / '.join(_percent(row[f'hit_rate_{n}']) for n in (1, 2, 4))} of {row['searches']}",
                f"{_percent(row['decided_right'])} in {row['mean_views']:.2f} views",
                *(_percent(row[share]) for share in shares),
                f"{_percent(row['unknown_accepted'])} of {row['unknown_searches']}",
                f"{_percent(row['left_out_accepted'])} of {row['left_out_searches']}",
            ]
            for row in rows
        ],
    )


def _intervals(rows: Sequence[Row]) -> Table:
    """Return the shares of enrolled objects in percent, with their intervals."""
    names = {
        **{f"hit_rate_{n}": f"ranked first, N = {n}" for n in (1, 2, 4)},
        "decided_right": "decided right",
        "ambiguous": "ambiguous",
        "called_unknown": "unknown, though enrolled",
        "decided_wrong": "wrong name",
        "left_out_accepted": "left out in turn: accepted",
    }

    def cell(row: Row, share: str) -> str:
        low, high = (_percent(row[f"{share}_{end}"]) for end in ("low", "high"))
        return f"{_percent(row[share])} [{low}, {high}]"

    return _table(
        ["% [95 % interval by objects]", *(f"{row['change']}: {row['objects']}" for row in rows)],
        [[name, *(cell(row, share) for row in rows)] for share, name in names.items()],
    )


def _probabilities(rates: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return the stated probabilities beside the shares that they promise, in percent, by the name of the row."""
    heads = "stated probability, mean %|named objects|stated|right|not enrolled: enrolled|left out"
    keys = ("accepted_stated", "accepted_right", "enrolled_not_enrolled", "left_out_not_enrolled")
    rows = [
        [name, f"{own['accepted_searches']}", *_cells(own, dict.fromkeys(keys, 100))] for name, own in rates.items()
    ]
    return _table(heads.split("|"), rows)


def contest_sentences(results: Mapping[str, Any]) -> list[str]:
    """Return each comparison of two methods in words, with its interval and p-value."""
    labels = {method["name"]: method["label"] for method in results.get("methods", ())}
    return [_sentence(contest, labels) for contest in results.get("contests", ())]


def _sentence(contest: Row, labels: dict[str, str]) -> str:
    first, second = (f"{labels[contest[one]]} at N = {contest[f'{one}_views']}" for one in ("first", "second"))
    if contest["difference_low"] > 0 and contest["p_value"] < 0.05:
        result = "better"
    elif contest["difference_high"] < 0 and contest["p_value"] < 0.05:
        result = "worse"
    else:
        result = "no difference shown"
    points, low, high = (signed(100 * contest[f"difference{end}"], 1) for end in ("", "_low", "_high"))
    return (
        f"{first} ({percent(contest['first_rate'])}) against {second} ({percent(contest['second_rate'])}): "
        f"{points} points [{low}, {high}], "
        f"McNemar p = {contest['p_value']:.2g} ({contest['only_first']} trials to {contest['only_second']}); {result}"
    )


def _percent(rate: float) -> str:
    return f"{100 * rate:.1f}"
