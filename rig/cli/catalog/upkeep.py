"""`rig catalog verify`, `redescribe`, `gc`, `merge` and `migrate`, and `rig log`."""

import sys
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import typer

from rig.cli.catalog.catalog import YesOption, app
from rig.cli.ui.command import command
from rig.cli.ui.complete import object_names
from rig.cli.ui.jobs import confirm, print_table, run_job, size_words
from rig.cli.ui.settings import Settings

JobsOption = Annotated[int | None, typer.Option(min=1, help="Processes; one for each core otherwise.")]
EXIT_CATALOG = 7


@app.command("verify")
@command
def verify(
    settings: Settings,
    repair: Annotated[bool, typer.Option("--repair", help="Mend what can be mended; nothing is thrown away.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Compare hashes; do not describe the images again.")] = False,
    jobs: JobsOption = None,
) -> None:
    """Look whether everything is as it was stored; exit code 7 if something is not and was not mended.

    Example: rig catalog verify --repair --bench sim
    """
    from rig.catalog.verify import verify as job
    from rig.events.events import plain
    from rig.events.wording import counted

    with settings.open_catalog(read_only=not repair) as catalog:
        found = run_job(
            "verifying",
            job(catalog, repair=repair, quick=quick, jobs=jobs),
            interrupted="Interrupted; what was looked at was not changed.",
        )
    if settings.json:
        settings.print_json(plain(found))
    else:
        for finding in found.findings:
            mended = "" if finding.mended is None else f"; {finding.mended}"
            print(f"{finding.problem}: {finding.what}{mended}")
        mended_count = len(found.findings) - len(found.unmended)
        outcome = "everything is as it was stored"
        if found.findings:
            outcome = f"{counted(len(found.findings), 'problem')}, {mended_count} mended"
            if not repair:
                outcome += "; rig catalog verify --repair mends what can be mended"
        looked = f"{counted(found.objects, 'object')}, {counted(found.views, 'view')}"
        print(f"{looked}, {size_words(found.image_bytes)} of images: {outcome}")
    if found.unmended:
        raise typer.Exit(EXIT_CATALOG)


@app.command("redescribe")
@command
def redescribe(
    settings: Settings,
    descriptor: Annotated[str, typer.Option(help="Name of the descriptor.")] = "cedd",
    region: Annotated[
        str,
        typer.Option(
            help="Part of a bench's images: stored (as they are), config (view.roi), whole, or X,Y,WIDTH,HEIGHT."
        ),
    ] = "stored",
    again: Annotated[bool, typer.Option("--again", help="Also what is described already.")] = False,
    jobs: JobsOption = None,
) -> None:
    """Describe the stored images anew, after the descriptor or its settings have changed; goes on where it was stopped.

    Example: rig catalog redescribe --region config --bench sim

    Example: rig catalog redescribe --descriptor edges+colours --bench sim
    """
    from rig.catalog.redescribe import redescribe as job
    from rig.events.events import plain

    part = _region(settings, region)
    with settings.open_catalog() as catalog:
        done = run_job(
            "describing",
            job(catalog, descriptor, region=part, again=again, jobs=jobs),
            interrupted="Interrupted; what is described is kept, the same command goes on.",
        )
    if settings.json:
        settings.print_json(plain(done))
    else:
        print(
            f"{done.descriptor} {done.version}: {done.described} views described, {done.unchanged} were already, "
            f"{len(done.failed)} could not be"
        )
        for path, reason in done.failed[:20]:
            print(f"  {path}: {reason}", file=sys.stderr)
    if done.failed:
        raise typer.Exit(EXIT_CATALOG)


@app.command("gc")
@command
def gc(
    settings: Settings,
    old: Annotated[
        bool, typer.Option("--old", help="Also enrollments that were replaced or abandoned, of objects in use.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would go.")] = False,
    yes: YesOption = False,
) -> None:
    """Remove for good what was deleted, what verify set aside, and what is left of imports that were cut off.

    Example: rig catalog gc --dry-run --bench sim
    """
    from rig.catalog.upkeep import Collected, collect_garbage
    from rig.events.events import plain
    from rig.events.wording import counted

    def words(found: Collected) -> str:
        names = ", ".join(found.objects[:10]) + (" and others" if len(found.objects) > 10 else "")
        return (
            f"{counted(len(found.objects), 'deleted object')}{f' ({names})' if names else ''}, "
            f"{counted(found.enrollments, 'enrollment')}, {counted(found.views, 'view')} and "
            f"{counted(found.files, 'file')}, {size_words(found.bytes)}"
        )

    with settings.open_catalog() as catalog:
        found = collect_garbage(catalog, old=old, dry_run=True)
        nothing = found == Collected((), 0, 0, 0, 0)
        if not dry_run:
            if not nothing:
                confirm(f"Remove {words(found)}, for good?", yes=yes, settings=settings)
            found = collect_garbage(catalog, old=old)  # levels of earlier versions go unasked: they can be computed
    text = f"{'Would remove' if dry_run else 'Removed'} {words(found)}."
    settings.say("There is nothing to remove." if nothing else text, {"dry_run": dry_run, **plain(found)})


@app.command("migrate")
@command
def migrate(settings: Settings) -> None:
    """Bring the catalog of an earlier program up to date; the database as it was is kept beside it.

    Example: rig catalog migrate --bench sim
    """
    from rig.catalog import migrate as bring_up_to_date
    from rig.core.clock import SystemClock

    path = settings.load().catalog_path(settings.bench_name)
    done = bring_up_to_date(path, clock=SystemClock())
    text = f"{path} is up to date, version {done.after}."
    if done.backup is not None:
        text = f"{path}: version {done.before} became {done.after}. As it was: {done.backup}"
    backup = None if done.backup is None else str(done.backup)
    settings.say(text, {"catalog": str(path), "before": done.before, "after": done.after, "backup": backup})


@command
def log(
    settings: Settings,
    since: Annotated[
        str | None,
        typer.Option(metavar="WHEN", help="2026-01-31, 2026-01-31T14:00 (UTC), or 30m, 12h, 7d, 4w ago."),
    ] = None,
    name: Annotated[
        str | None, typer.Option("--object", metavar="NAME", help="Of this object alone.", autocompletion=object_names)
    ] = None,
) -> None:
    """Say who did what with the catalog and the table, and when, oldest first.

    Example: rig log --since 7d --bench sim
    """
    from rig.events.events import plain

    begin = _since(since)
    with settings.open_catalog(read_only=True) as catalog:
        entries = catalog.log(since=begin, object_name=name)
    if settings.json:
        for entry in entries:
            settings.print_json(plain(entry) | {"time_utc": entry.time_utc.isoformat()})
        return
    if not entries:
        print("Nothing since then." if since else "Nothing yet.")
        return
    rows = [
        (
            f"{entry.time_utc:%Y-%m-%d %H:%M:%S}",
            entry.user,
            entry.action,
            entry.object_name or "",
            ", ".join(f"{key} {_short(value)}" for key, value in entry.details.items()),
        )
        for entry in entries
    ]
    print_table(("time (UTC)", "who", "what", "object", ""), rows)


def _short(value: Any) -> str:
    text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return text if len(text) <= 60 else f"{text[:59]}…"


def _region(settings: Settings, text: str) -> Any:
    from rig.catalog.exchange.package import parse_region
    from rig.catalog.redescribe import Stored
    from rig.core.errors import UsageError

    match text:
        case "stored":
            return Stored.REGION
        case "config":
            return settings.load().view.roi
        case "whole":
            return None
    try:
        return parse_region(text)
    except ValueError as error:
        raise UsageError(str(error), next_step="give stored, config, whole, or X,Y,WIDTH,HEIGHT") from error


def _since(text: str | None) -> datetime | None:
    from datetime import UTC

    from rig.core.clock import SystemClock
    from rig.core.errors import UsageError

    if text is None:
        return None
    units = {"m": "minutes", "h": "hours", "d": "days", "w": "weeks"}
    try:
        if text[-1:] in units and text[:-1].isdecimal():
            return SystemClock().utc() - timedelta(**{units[text[-1]]: int(text[:-1])})
        when = datetime.fromisoformat(text)
    except (ValueError, OverflowError) as error:
        raise UsageError(
            f"--since {text!r} is no time", next_step="give a date such as 2026-01-31, or 12h for twelve hours ago"
        ) from error
    return when.replace(tzinfo=UTC) if when.tzinfo is None else when


@app.command("merge")
@command
def merge(
    settings: Settings,
    other: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the other catalog, which is only read.")],
    on_conflict: Annotated[
        str, typer.Option(metavar="refuse|skip|replace", help="What to do about objects that both have.")
    ] = "refuse",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would come in.")] = False,
    jobs: JobsOption = None,
) -> None:
    """Bring the objects of another catalog into this one, with all their enrollments; all of it or nothing.

    Example: rig catalog merge /media/stick/catalog --on-conflict skip --bench sim
    """
    from rig.catalog import Catalog
    from rig.catalog.exchange import package_of
    from rig.cli.catalog.exchange import take_in
    from rig.core.clock import SystemClock

    with Catalog.open(other, clock=SystemClock(), create=False, read_only=True) as source:
        package = package_of(source)
    take_in(settings, package, on_conflict=on_conflict, label=None, strict=True, dry_run=dry_run, jobs=jobs)
