"""`rig results ...`: the recorded answers of identifications."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypedDict, Unpack

import typer

from rig.cli.catalog.upkeep import parse_time
from rig.cli.ui.command import command
from rig.cli.ui.complete import object_names
from rig.cli.ui.settings import Settings
from rig.core.errors import UsageError
from rig.core.phrases import counted

if TYPE_CHECKING:
    from rig.catalog.results import Answer, Result
    from rig.events.events import Identified

app = typer.Typer(help="Show, export and correct the recorded answers of identifications.", no_args_is_help=True)


class Filters(TypedDict):
    """The options that select results."""

    sample: Annotated[str | None, typer.Option(metavar="ID", help="Only this sample.")]
    name: Annotated[
        str | None, typer.Option("--object", metavar="NAME", help="Only this object.", autocompletion=object_names)
    ]
    outcome: Annotated[str | None, typer.Option(metavar="found|ambiguous|unknown", help="Only this outcome.")]
    taken_on: Annotated[str | None, typer.Option(metavar="BENCH", help="Only answers of this bench.")]
    since: Annotated[
        str | None,
        typer.Option(
            metavar="WHEN",
            help="Only answers since this time: 2026-01-31, 2026-01-31T14:00 (UTC), or a time ago: 30m, 12h, 7d, 4w.",
        ),
    ]
    before: Annotated[str | None, typer.Option(metavar="WHEN", help="Only answers before this time.")]
    corrected: Annotated[bool, typer.Option("--corrected", help="Only corrected results.")]


ResultArgument = Annotated[int, typer.Argument(metavar="RESULT", min=1, help="Number of the result.")]


@app.command("list")
@command
def list_(settings: Settings, **filters: Unpack[Filters]) -> None:
    """List results, oldest first. Filters use the corrected values.

    Columns: number of the result, time, operator, sample, answer (a star marks a corrected one), views, and bench.

    Example: rig results list --sample S-0042 --since 7d --bench sim
    """
    from rig.catalog.exchange.tables import plain_row
    from rig.cli.ui.present import print_table

    found = _find(settings, filters)
    if settings.json:
        for result in found:
            settings.print_json(plain_row(result))
        return
    if not found:
        print("No results match.")
        return
    rows = [
        (
            str(result.id),
            f"{result.time_utc:%Y-%m-%d %H:%M:%S}",
            result.operator,
            result.current.sample or "–",
            f"{_words(result.current)}{' *' if result.corrections else ''}",
            str(len(result.azimuths_deg)),
            result.provenance.bench,
        )
        for result in found
    ]
    print_table(("result", "time (UTC)", "operator", "sample", "answer", "views", "bench"), rows, right=("result",))


@app.command("show")
@command
def show(settings: Settings, result: ResultArgument) -> None:
    """Show a result: the answer, what it is based on, and its corrections.

    Example: rig results show 12 --bench sim
    """
    from rig.catalog.results import find_result
    from rig.core.json_form import plain
    from rig.events.wording import result_words

    with settings.open_catalog(read_only=True) as catalog:
        found = find_result(catalog, result)
        image = "–" if found.image is None else catalog.database.images.where(found.image)
    if settings.json:
        shown = plain(found) | {"answered": found.answered._asdict(), "current": found.current._asdict()}
        shown |= {"image": found.image_path, "image_sha256": found.image_sha256}
        shown["time_utc"] = found.time_utc.isoformat()
        for correction, one in zip(shown["corrections"], found.corrections, strict=True):
            correction |= {"time_utc": one.time_utc.isoformat(), "corrected": one.corrected._asdict()}
        settings.print_json(shown)
        return
    corrected = f"corrected to {_words(found.current)}; the answer was: " if found.corrections else ""
    answer = _event(found)
    print(f"Result {found.id}: {corrected}{_words(found.answered) if answer is None else result_words(answer)}")
    lines = {
        "sample": found.answered.sample or "–",
        "time": f"{found.time_utc:%Y-%m-%d %H:%M:%S} UTC",
        "operator": f"{found.operator} (account {found.user} on {found.host})",
        "candidates": ", ".join(f"{one.name} {one.score:.3f}" for one in answer.candidates) if answer else "–",
        "views": f"{len(found.azimuths_deg)}",
        "bench": f"{found.provenance.bench}, {found.provenance.software}",
        "catalog": f"version {found.catalog_version[:12]}",
        "image": image,
    }
    for name, text in lines.items():
        print(f"  {name:10} {text}")
    for one in found.corrections:
        sample = f", sample {one.corrected.sample}" if one.corrected.sample else ""
        print(f"Corrected {one.time_utc:%Y-%m-%d %H:%M:%S} UTC by {one.operator}: {_words(one.corrected)}{sample}")
        print(f"  reason     {one.reason}")


@app.command("export")
@command
def export(
    settings: Settings,
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="File to write: .csv, .json or .parquet.")],
    **filters: Unpack[Filters],
) -> None:
    """Export results as a table. The suffix of the file chooses the format.

    Example: rig results export june.csv --since 2026-06-01 --before 2026-07-01 --bench sim
    """
    from rig.catalog.exchange.tables import TableFormat, write_results

    try:
        form = TableFormat(target.suffix.lower().removeprefix("."))
    except ValueError as error:
        known = ", ".join(f".{one}" for one in TableFormat)
        raise UsageError(f"The format of {target} is unknown.", next_step=f"Give a file with {known}.") from error
    found = _find(settings, filters)
    write_results(target, found, form)
    settings.say(
        f"Exported {counted(len(found), 'result')} to {target}.",
        {"target": str(target), "format": form, "results": len(found)},
    )


@app.command("correct")
@command
def correct(
    settings: Settings,
    result: ResultArgument,
    reason: Annotated[str, typer.Option("--reason", metavar="TEXT", help="Why; it is stored with the correction.")],
    name: Annotated[
        str | None, typer.Option("--object", metavar="NAME", help="The right object.", autocompletion=object_names)
    ] = None,
    unknown: Annotated[bool, typer.Option("--unknown", help="The object is not in the catalog.")] = False,
    sample: Annotated[str | None, typer.Option("--sample", metavar="ID", help="The right sample.")] = None,
    operator: Annotated[
        str | None, typer.Option(metavar="NAME", help="Who corrects it (default: the user's account).")
    ] = None,
) -> None:
    """Correct the object or the sample of a result. The recorded answer stays, and the log contains the correction.

    Example: rig results correct 12 --object mug-star --reason "read the label" --bench sim
    """
    from rig.catalog.results import correct as correct_result

    with settings.open_catalog() as catalog:
        now = correct_result(
            *(catalog, result), reason=reason, object_name=name, unknown=unknown, sample=sample, operator=operator
        )
    text = f"Result {result} is now {_words(now)}{f', sample {now.sample}' if now.sample else ''}."
    settings.say(text, {"result": result, **now._asdict()})


def _find(settings: Settings, filters: Filters) -> "list[Result]":
    from rig.catalog.records import Outcome
    from rig.catalog.results import ResultFilter, find_results

    given = filters["outcome"]
    try:
        outcome = None if given is None else Outcome(given)
    except ValueError as error:
        raise UsageError(f"--outcome {given!r} is unknown.", next_step=f"Give {', '.join(Outcome)}.") from error
    wanted = ResultFilter(
        filters["sample"],
        filters["name"],
        outcome,
        filters["taken_on"],
        parse_time(filters["since"], "--since"),
        parse_time(filters["before"], "--before"),
        filters["corrected"],
    )
    with settings.open_catalog(read_only=True) as catalog:
        return find_results(catalog, wanted)


def _words(answer: "Answer") -> str:
    """Return an answer for a table: "mug-white", "mug-white? (ambiguous)", "unknown"."""
    from rig.catalog.records import Outcome

    match answer.outcome:
        case Outcome.FOUND:
            return answer.object_name or "–"
        case Outcome.AMBIGUOUS:
            return f"ambiguous ({answer.object_name}?)"
        case Outcome.UNKNOWN:
            return "unknown"


def _event(result: "Result") -> "Identified | None":
    """Return the recorded event; None if another version of the program recorded it."""
    from rig.events.events import Identified, event_of

    try:
        answer = event_of(result.details)
    except ValueError:
        return None
    return answer if isinstance(answer, Identified) else None
