"""The files that an evaluation leaves."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from hbr.evaluation.protocol import Runs
from rig.charts.evaluation_figures import figures
from rig.charts.xy import Chart
from rig.core.errors import UsageError
from rig.core.files import write
from rig.evaluation.plan import Plan
from rig.evaluation.report import contest_sentences, csv_text, curve_rows, decision_rows, evaluate

_HEADINGS = {
    "hit-rate": (
        "Hit-rate",
        "Shaded: Wilson's 95 % intervals of HBR, AHBR and Best 10, which take trials for independent.",
    ),
    "travel": ("Hit-rate by degrees turned", "The same points over the way to them."),
    "pose": (
        "Pose",
        "Of the trials that found the object. Symmetry-aware: to the nearest orientation from which the object looks "
        "as much like the true view as the views beside it do.",
    ),
    "omega-sweep": ("Weight of the orientation", "Common trials."),
    "list-sweep": ("Length of the retrieval lists", "Common trials."),
}


def write_json(results: Mapping[str, Any], path: Path) -> None:
    """Write results as a JSON file, in a folder that is made where it is missing.

    Raises
    ------
    UsageError
        It cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(results, ensure_ascii=False, allow_nan=False, indent=1)
        write(path, f"{text}\n".encode())
    except OSError as error:
        raise UsageError(
            f"The results cannot be written to {path}.",
            next_step="Name another folder with --out.",
            evidence={"reason": error.strerror or str(error)},
        ) from error


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
        "results.json": json.dumps(results, ensure_ascii=False, allow_nan=False, indent=1).encode() + b"\n",
        "results.csv": csv_text(results).encode(),
        "report.html": _page(results, drawn).encode(),
    }
    for name, figure in drawn.items():
        files |= {f"{name}.svg": figure.svg().encode(), f"{name}.png": figure.png()}
    try:
        for name, data in files.items():
            write(folder / name, data)
    except OSError as error:
        raise UsageError(
            f"The results cannot be written to {folder}.",
            next_step="Free space there, then give the same command with --resume: the runs are kept.",
            evidence={"reason": error.strerror or str(error)},
        ) from error
    return results


def _page(results: dict[str, Any], drawn: Mapping[str, Chart]) -> str:
    loader = PackageLoader("rig.evaluation", ".")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    style = Environment(loader=PackageLoader("rig.report", "."), autoescape=False).get_template("page.css").render()
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
    return environment.get_template("page.html.j2").render(
        title=f"Retrieval on {dataset['name']}",
        summary=summary,
        style=Markup(style),
        contests=contest_sentences(results),
        figures=[(*_HEADINGS[name], Markup(figure.svg())) for name, figure in drawn.items()],
        tables=[
            ("Hit-rates", "Percent, with Wilson's 95 % interval; best 10 after all views.", *curves),
            (
                "Decisions and poses",
                f"A search of the paper ends when the best object leads by {stopping['margin']:g} per view, one of the "
                "dense filter by the stopping rule calibrated on the enrolled views, or after all views: views "
                "taken (mean, 95th percentile), hit-rate and share of unknown then, mean of the degrees rotated. Pose "
                "error after all views, of the trials that found the object: median and RMSE, plain, then "
                "symmetry-aware, and the median of objects without symmetry. Median time of the last step.",
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
