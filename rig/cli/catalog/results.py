"""Show, export and correct the recorded answers of identifications."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypedDict, Unpack

import typer

from rig.catalog.exchange.tables import RESULTS, TableFormat, plain_row, write_rows
from rig.catalog.log import shown
from rig.catalog.records import RecordedOutcome
from rig.catalog.results import Answer, Result, ResultFilter, find_result, find_results
from rig.catalog.results import correct as correct_result
from rig.cli.ui.command import Group, command
from rig.cli.ui.present import print_table
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock
from rig.core.errors import UsageError
from rig.core.json_form import plain
from rig.core.phrases import counted

app = Group(__doc__)

_WHEN: Final = "2026-01-31, 2026-01-31T14:00 (UTC), or a time ago: 30m, 12h, 7d, 4w."
SinceOption = Annotated[str | None, typer.Option(metavar="WHEN", help=f"Only those since this time: {_WHEN}")]
ResultArgument = Annotated[int, typer.Argument(metavar="RESULT", min=1, help="Number of the result.")]


class Filters(TypedDict):
    """The options that select results."""

    sample: Annotated[str | None, typer.Option(metavar="ID", help="Only this sample.")]
    name: Annotated[str | None, typer.Option("--object", metavar="NAME", help="Only this object.")]
    outcome: Annotated[Literal["found", "ambiguous", "unknown"] | None, typer.Option(help="Only this outcome.")]
    since: SinceOption
    before: Annotated[str | None, typer.Option(metavar="WHEN", help="Only those before this time.")]


@app.command("list")
def list_(settings: Settings, **filters: Unpack[Filters]) -> None:
    """List results, oldest first. Filters use the corrected values, and so do the columns; the last one counts them.

    Example: rig results list --sample S-0042 --since 7d --bench sim
    """
    rows = [result.as_row().model_dump() for result in _find(settings, filters)]
    columns = ("result", "time_utc", "operator", "sample", "outcome", "object", "views", "bench", "corrections")
    _show_rows(settings, rows, columns)


@app.command("show")
def show(settings: Settings, result: ResultArgument) -> None:
    """Show a result: the answer, what it is based on, and its corrections.

    Example: rig results show 12 --bench sim
    """
    with settings.open_catalog(read_only=True) as catalog:
        found = find_result(catalog, result)
    shown = plain(found) | {"answered": found.answered._asdict(), "current": found.current._asdict()}
    shown |= {"image": found.image_path, "image_sha256": found.image_sha256}
    shown["time_utc"] = found.time_utc.isoformat()
    for correction, one in zip(shown["corrections"], found.corrections, strict=True):
        correction |= {"time_utc": one.time_utc.isoformat(), "corrected": one.corrected._asdict()}
    lines = {name: value for name, value in plain_row(found.as_row().model_dump()).items() if value is not None}
    lines["candidates"] = ", ".join(f"{one['name']} {one['score']:.3f}" for one in found.details.get("candidates", ()))
    for number, one in enumerate(found.corrections, 1):
        sample = f", sample {one.corrected.sample}" if one.corrected.sample else ""
        lines[f"correction {number}"] = f"{_words(one.corrected)}{sample}, by {one.operator}: {one.reason}"
    settings.say("\n".join(f"{name:18} {value}" for name, value in lines.items()), shown)


@app.command("export")
def export(
    settings: Settings,
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="File to write: .csv, .json or .parquet.")],
    **filters: Unpack[Filters],
) -> None:
    """Export results as a table. The suffix of the file chooses the format.

    Example: rig results export june.csv --since 2026-06-01 --before 2026-07-01 --bench sim
    """
    form, found = TableFormat.of(target), _find(settings, filters)
    write_rows(target, form, RESULTS, (result.as_row().model_dump() for result in found))
    settings.say(
        f"Exported {counted(len(found), 'result')} to {target}.",
        {"target": str(target), "format": form, "results": len(found)},
    )


@app.command("correct")
def correct(
    settings: Settings,
    result: ResultArgument,
    reason: Annotated[str, typer.Option("--reason", metavar="TEXT", help="Why; it is stored with the correction.")],
    name: Annotated[str | None, typer.Option("--object", metavar="NAME", help="The right object.")] = None,
    unknown: Annotated[bool, typer.Option("--unknown", help="The object is not in the catalog.")] = False,
    sample: Annotated[str | None, typer.Option("--sample", metavar="ID", help="The right sample.")] = None,
    operator: Annotated[
        str | None, typer.Option(metavar="NAME", help="Who corrects it (default: the user's account).")
    ] = None,
) -> None:
    """Correct the object or the sample of a result. The recorded answer stays, and the log contains the correction.

    Example: rig results correct 12 --object mug-star --reason "read the label" --bench sim
    """
    with settings.open_catalog() as catalog:
        now = correct_result(
            *(catalog, result), reason=reason, object_name=name, unknown=unknown, sample=sample, operator=operator
        )
    text = f"Result {result} is now {_words(now)}{f', sample {now.sample}' if now.sample else ''}."
    settings.say(text, {"result": result, **now._asdict()})


@command
def log(settings: Settings, since: SinceOption = None) -> None:
    """Show who did what with the catalog and the table, oldest first.

    Example: rig log --since 7d --bench sim
    """
    begin = _time(since, "--since")
    with settings.open_catalog(read_only=True) as catalog:
        rows = [shown(entry) for entry in catalog.log(since=begin)]
    _show_rows(settings, rows, ("time_utc", "user", "action", "object_name", "details"))


def _show_rows(settings: Settings, rows: list[dict[str, Any]], columns: tuple[str, ...]) -> None:
    """Print some columns of the rows, or with ``--json`` each row on a line."""
    if settings.json:
        for row in rows:
            settings.print_json(plain_row(row))
    else:
        print_table(columns, rows)


def _find(settings: Settings, filters: Filters) -> list[Result]:
    wanted = ResultFilter(
        sample=filters["sample"],
        object_name=filters["name"],
        outcome=RecordedOutcome(filters["outcome"]) if filters["outcome"] else None,
        since=_time(filters["since"], "--since"),
        before=_time(filters["before"], "--before"),
    )
    with settings.open_catalog(read_only=True) as catalog:
        return find_results(catalog, wanted)


def _time(text: str | None, option: str) -> datetime | None:
    """Return the time that an option gives: a date, a time in UTC, or how long ago."""
    if text is None:
        return None
    units = {"m": "minutes", "h": "hours", "d": "days", "w": "weeks"}
    try:
        if text[-1:] in units and text[:-1].isdecimal():
            return SystemClock().utc() - timedelta(**{units[text[-1]]: int(text[:-1])})
        when = datetime.fromisoformat(text)
    except (ValueError, OverflowError) as error:
        raise UsageError(
            f"{option} {text!r} is not a time.", next_step="Give a date such as 2026-01-31, or 12h for 12 hours ago."
        ) from error
    return when.replace(tzinfo=UTC) if when.tzinfo is None else when


def _words(answer: Answer) -> str:
    """Return an answer for a table: "mug-white", "ambiguous (mug-white?)", "unknown"."""
    if answer.outcome == "ambiguous":
        return f"ambiguous ({answer.object_name}?)"
    return answer.object_name or ("–" if answer.outcome == "found" else "unknown")
