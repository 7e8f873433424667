"""`rig catalog verify`, `redescribe`, `gc`, `copy`, `merge` and `deliver`, and `rig log`."""

import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import typer

from rig.cli.catalog.catalog import app
from rig.cli.ui.command import command
from rig.cli.ui.complete import object_names
from rig.cli.ui.exit_codes import EXIT_CATALOG
from rig.cli.ui.jobs import run_job, size_words
from rig.cli.ui.options import ClusterOption, DryImportOption, JobsOption, YesOption, descriptor_name, jobs_of
from rig.cli.ui.prompts import confirm
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock
from rig.core.errors import UsageError
from rig.core.phrases import angle_words, counted


@app.command("verify")
@command
def verify(
    settings: Settings,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
) -> None:
    """Check whether everything is as it was stored. The exit code is 7 if it is not. Nothing is changed.

    Example: rig catalog verify --bench sim
    """
    from rig.catalog.verify import verify as job
    from rig.cli.catalog.findings import finding_text

    with settings.open_catalog(read_only=True) as catalog:
        found = run_job(
            "verifying",
            job(catalog, jobs=jobs_of(jobs, cluster)),
            interrupted="Interrupted; nothing was changed.",
        )
    if settings.json:
        settings.print_json(found)
    else:
        for finding in found.findings:
            print(finding_text(finding))
        problems = counted(len(found.findings), "problem")
        outcome = problems if found.findings else "everything is as it was stored"
        checked = ", ".join(
            counted(number, noun)
            for number, noun in ((found.objects, "object"), (found.views, "view"), (found.results, "result"))
        )
        print(f"{checked}, {size_words(found.image_bytes)} of images: {outcome}")
    if found.findings:
        raise typer.Exit(EXIT_CATALOG)


@app.command("redescribe")
@command
def redescribe(
    settings: Settings,
    descriptor: Annotated[str, typer.Option(help="Name of the descriptor.")] = "cedd",
    region: Annotated[
        str,
        typer.Option(
            help="Region of the images: stored (unchanged), config (view.roi), whole, or X,Y,WIDTH,HEIGHT in pixels."
        ),
    ] = "stored",
    again: Annotated[bool, typer.Option("--again", help="Also describe views that are described already.")] = False,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
) -> None:
    """Describe the enrolled views now: those that no search has described since the program or the region changed.

    A search does this, too. After an interruption, the command continues if it is given without --again.

    Example: rig catalog redescribe --region config --bench sim

    Example: rig catalog redescribe --descriptor edges+colours --bench sim
    """
    from rig.catalog.derived import choose_region
    from rig.catalog.derived import redescribe as job

    name = descriptor_name(descriptor)
    with settings.open_catalog() as catalog:
        if region != "stored":
            choose_region(catalog, _region(settings, region))
        done = run_job(
            "describing",
            job(catalog, name, again=again, jobs=jobs_of(jobs, cluster)),
            interrupted="Interrupted; the results so far are stored. "
            f"To continue: rig catalog redescribe --descriptor {name}",
        )
    if settings.json:
        settings.print_json(done)
    else:
        print(
            f"{done.descriptor} {done.version}: {counted(done.described, 'view')} described, "
            f"{done.unchanged} unchanged, {len(done.failed)} failed"
        )
        for path, reason in done.failed[:20]:
            print(f"  {path}: {reason}", file=sys.stderr)
    if done.failed:
        raise typer.Exit(EXIT_CATALOG)


@app.command("gc")
@command
def gc(
    settings: Settings,
    old: Annotated[bool, typer.Option("--old", help="Also remove replaced and abandoned enrollments.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only report what would be removed.")] = False,
    yes: YesOption = False,
) -> None:
    """Remove deleted objects permanently, and images of interrupted work that are older than a day.

    Example: rig catalog gc --dry-run --bench sim
    """
    from rig.catalog.upkeep import GarbageReport, collect_garbage
    from rig.core.json_form import plain

    def words(found: GarbageReport) -> str:
        names = ", ".join(found.objects[:10]) + (" and others" if len(found.objects) > 10 else "")
        return (
            f"{counted(len(found.objects), 'deleted object')}{f' ({names})' if names else ''}, "
            f"{counted(found.enrollments, 'enrollment')}, {counted(found.views, 'view')} and "
            f"{counted(found.files, 'file')}, {size_words(found.bytes)}"
        )

    with settings.open_catalog() as catalog:
        found = collect_garbage(catalog, old=old, dry_run=True)
        nothing = found == GarbageReport((), 0, 0, 0, 0)
        if not dry_run and not nothing:
            confirm(f"Remove {words(found)} permanently?", yes=yes, settings=settings)
            found = collect_garbage(catalog, old=old)
    text = f"{'Would remove' if dry_run else 'Removed'} {words(found)}."
    settings.say("There is nothing to remove." if nothing else text, {"dry_run": dry_run, **plain(found)})


@app.command("copy")
@command
def copy(
    settings: Settings,
    source: Annotated[str, typer.Argument(metavar="FROM", help="Folder or database URL of the catalog.")],
    target: Annotated[str, typer.Argument(metavar="TO", help="Folder or database URL of a new or empty catalog.")],
    images: Annotated[
        str | None,
        typer.Option(metavar="PLACE", help="Folder or store of the images of a database (default: catalog.images)."),
    ] = None,
) -> None:
    """Copy a whole catalog, for example from this computer to a server, and compare all digests.

    Example: rig catalog copy ~/catalog postgresql+psycopg://rig@server/rig --images s3://rig/catalog
    """
    from rig.catalog import Catalog
    from rig.catalog.copying import copy_catalog
    from rig.config.catalog_place import CatalogPlace

    def place(text: str) -> CatalogPlace:
        if "://" not in text:
            return CatalogPlace(Path(text))
        config = settings.load()
        return CatalogPlace(config.catalog_path(settings.bench_name), text, images or config.catalog.images)

    clock = SystemClock()
    with (
        Catalog.open(place(source), clock=clock, create=False, read_only=True) as before,
        Catalog.open(place(target), clock=clock, create=True) as after,
    ):
        interrupted = "Interrupted; the copy is empty. The same command continues with the images."
        done = run_job("copying", copy_catalog(before, after), interrupted=interrupted)
        words = (
            f"Copied {counted(done.objects, 'object')} with {counted(done.views, 'view')}, "
            f"{counted(done.results, 'result')} and {size_words(done.image_bytes)} of images from {before.place} to "
            f"{after.place}. All digests are equal."
        )
    settings.say(words, done._asdict())


@command
def log(
    settings: Settings,
    since: Annotated[
        str | None,
        typer.Option(
            metavar="WHEN",
            help="Only entries since this time: 2026-01-31, 2026-01-31T14:00 (UTC), or a time ago: 30m, 12h, 7d, 4w.",
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option("--object", metavar="NAME", help="Only this object.", autocompletion=object_names)
    ] = None,
) -> None:
    """Show who did what with the catalog and the table, oldest first.

    Columns: time, user, action, object, details.

    Example: rig log --since 7d --bench sim
    """
    from rig.catalog.log import shown
    from rig.cli.ui.present import print_table

    begin = parse_time(since, "--since")
    with settings.open_catalog(read_only=True) as catalog:
        entries = catalog.log(since=begin, object_name=name)
    if settings.json:
        for entry in entries:
            settings.print_json(shown(entry) | {"time_utc": entry.time_utc.isoformat()})
        return
    if not entries:
        print("No entries since then." if since else "No entries yet.")
        return
    rows = [
        (
            f"{entry.time_utc:%Y-%m-%d %H:%M:%S}",
            entry.user,
            entry.action,
            entry.object_name or "",
            ", ".join(filter(None, (_detail(key, value) for key, value in entry.details.items()))),
        )
        for entry in entries
    ]
    print_table(("time (UTC)", "user", "action", "object", "details"), rows)


def _detail(key: str, value: Any) -> str:
    """Return a detail of the log in words: "enrollment 3", "to 90.0°", "replace"; empty if there is nothing to say."""
    name = key.removesuffix("_deg").removesuffix("_id").replace("_", " ")
    if value is None or isinstance(value, bool):
        return name if value else ""
    if key.endswith("_deg") and isinstance(value, int | float):
        return f"{name} {angle_words(value)}"
    text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return f"{name} {text if len(text) <= 60 else f'{text[:59]}…'}"


def _region(settings: Settings, text: str) -> Any:
    from rig.catalog.exchange.tables import parse_region

    match text:
        case "config":
            return settings.load().view.roi
        case "whole":
            return None
    try:
        return parse_region(text)
    except ValueError as error:
        raise UsageError(str(error), next_step="Give stored, config, whole, or X,Y,WIDTH,HEIGHT.") from error


def parse_time(text: str | None, option: str) -> datetime | None:
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


@app.command("merge")
@command
def merge(
    settings: Settings,
    other: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the other catalog. It is not changed.")],
    on_conflict: Annotated[
        str, typer.Option(metavar="reject|skip|replace", help="What to do with objects that are in both.")
    ] = "reject",
    dry_run: DryImportOption = False,
    jobs: JobsOption = None,
) -> None:
    """Import the objects of another catalog with all their enrollments; all or nothing.

    Example: rig catalog merge /media/stick/catalog --on-conflict skip --bench sim
    """
    from rig.catalog import Catalog
    from rig.catalog.transfer import CatalogSource
    from rig.cli.catalog.exchange import run_import

    with Catalog.open(other, clock=SystemClock(), create=False, read_only=True) as source:
        run_import(
            settings,
            CatalogSource(source, own=False),
            on_conflict=on_conflict,
            label=None,
            strict=True,
            dry_run=dry_run,
            jobs=jobs,
        )


@app.command("deliver")
@command
def deliver(
    settings: Settings,
    rename: Annotated[
        tuple[str, str] | None,
        typer.Option("--rename", metavar="NAME NEW", help="Deliver an object of the journal under another name."),
    ] = None,
    replace: Annotated[
        list[str] | None,
        typer.Option("--replace", metavar="NAME", help="Replace the object of the server by that of the journal."),
    ] = None,
    discard: Annotated[
        str | None, typer.Option("--discard", metavar="NAME", help="Remove an object from the journal.")
    ] = None,
) -> None:
    """Deliver what this computer enrolled and answered while the server of the catalog did not answer.

    rig enroll and rig identify do this, too. The options resolve a name that both the journal and the server have.

    Example: rig catalog deliver --rename mug-white mug-white-2
    """
    from rig.catalog.shared import Journal, deliver_journal, delivery_words
    from rig.catalog.shared import discard as remove

    place = settings.place
    if place.url is None:
        raise UsageError(
            "The catalog is in a folder of this computer.",
            next_step="Enroll and identify as usual: there is nothing to deliver.",
        )
    if rename is not None or discard is not None or replace:
        with Journal.of(place, SystemClock()) as journal:
            for name in replace or ():
                journal.summary(name)  # there must be one
            if rename is not None:
                journal.rename(*rename)
            if discard is not None:
                remove(journal, discard)
    done = deliver_journal(place, SystemClock(), replacing=replace or ())
    for one in done:
        print(f"{'' if one.conflict is None else 'Note: '}{delivery_words(one, place)}", file=sys.stderr)
    conflicts = [one for one in done if one.conflict is not None]
    if settings.json:
        rows = [{"name": one.name, "views": one.views, "conflict": one.conflict and one.conflict.what} for one in done]
        settings.print_json({"delivered": len(done) - len(conflicts), "objects": rows})
    elif not done:
        print("No object was delivered.")
    if conflicts:
        raise typer.Exit(EXIT_CATALOG)
