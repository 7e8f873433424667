"""The files that an evaluation writes."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from markupsafe import Markup

from hbr.evaluation.protocol import Runs
from rig.charts.evaluation_figures import figures
from rig.charts.xy import Chart
from rig.core.errors import UsageError, os_errors_as
from rig.core.files import write
from rig.core.next_steps import Do
from rig.core.templates import environment
from rig.evaluation.plan import Plan
from rig.evaluation.report import contest_sentences, csv_text, curve_rows, decision_rows, evaluate

_HEADINGS = {
    "hit-rate": ("Hit rate", "Shaded: Wilson's 95 % intervals of HBR, AHBR and Best 10, for independent trials."),
    "travel": ("Hit rate by degrees of rotation", "The same points by the sum of the rotations before them."),
    "pose": (
        "Pose",
        "Trials that found the object. Symmetry-aware: error to the nearest orientation in which the object is as "
        "similar to the true view as its neighbouring views are.",
    ),
    "omega-sweep": ("Weight of the orientation", "The same trials for all weights."),
    "list-sweep": ("Length of the retrieval lists", "The same trials for all lengths."),
}


def write_json(results: Mapping[str, Any], path: Path) -> None:
    """Write results as a JSON file; a missing folder is created.

    Raises
    ------
    UsageError
        The file cannot be written.
    """
    step = Do.RUN_AGAIN(out="FOLDER")
    with os_errors_as(UsageError, f"The results cannot be written to {path}.", next_step=step):
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path, _json(results))


def write_results(
    plan: Plan, runs: Runs, margin: float, min_views: int, folder: Path, reported: tuple[int, int] | None = None
) -> dict[str, Any]:
    """Write results.json, results.csv, the figures as SVG and PNG, and report.html, and return the results.

    Raises
    ------
    UsageError
        The folder cannot be written.
    """
    results = evaluate(plan, runs, margin, min_views, reported)
    drawn = figures(results)
    files: dict[str, bytes] = {
        "results.json": _json(results),
        "results.csv": csv_text(results).encode(),
        "report.html": _page(results, drawn).encode(),
    }
    for name, figure in drawn.items():
        files |= {f"{name}.svg": figure.svg().encode(), f"{name}.png": figure.png()}
    step = (Do.FREE_DISK(), Do.RUN_AGAIN(resume=True), "The runs are stored.")
    with os_errors_as(UsageError, f"The results cannot be written to {folder}.", next_step=step):
        for name, data in files.items():
            write(folder / name, data)
    return results


def _json(results: Mapping[str, Any]) -> bytes:
    return json.dumps(results, ensure_ascii=False, allow_nan=False, indent=1).encode() + b"\n"


def _page(results: dict[str, Any], drawn: Mapping[str, Chart]) -> str:
    settings = results["settings"]
    dataset, protocol = settings["dataset"], settings["protocol"]
    stopping = results["methods"][0]["stopping"]
    summary = (
        f"{len(dataset['objects'])} objects, {dataset['views']} views ({dataset['missing_views']} missing), "
        f"{protocol['trials']} trials of {protocol['max_views']} views an object; "
        f"{results['bytes_per_view']} bytes a view."
    )
    if results["reported"]:
        summary += " Reported: objects {} to {}.".format(*results["reported"])
    curves, decisions = curve_rows(results, interval=True), decision_rows(results)
    page = environment("rig.evaluation", "rig.report").get_template("page.html.j2")
    return page.render(
        title=f"Retrieval on {dataset['name']}",
        summary=summary,
        contests=contest_sentences(results),
        figures=[(*_HEADINGS[name], Markup(figure.svg())) for name, figure in drawn.items()],
        tables=[
            ("Hit rates", "Percent, with Wilson's 95 % interval; best 10 after all views.", *curves),
            (
                "Decisions and poses",
                f"A search of the paper ends when the best object leads by {stopping['margin']:g} per view, one "
                "with the dense filter by the stopping rule fitted to enrolled views; both end after all views. "
                "Columns: number of views (mean, 95th percentile), hit rate, share of unknown, mean sum of rotations; "
                "pose error after all views in the trials that found the object (median and RMSE, then symmetry-aware, "
                "then the median of objects without symmetry); median time of the last step.",
                *decisions,
            ),
        ],
        conditions=[
            (name, [(key, _words(value)) for key, value in settings[name].items()])
            for name in ("dataset", "condition", "protocol")
        ],
    )


def _words(value: object) -> str:
    if isinstance(value, list):
        return f"{value[0]} … {value[-1]} ({len(value)})"
    return "–" if value is None else str(value)
