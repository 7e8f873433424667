"""`rig import` and `rig export`."""

import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.ui.command import command
from rig.cli.ui.complete import object_names
from rig.cli.ui.jobs import run_job, size_words
from rig.cli.ui.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rig.catalog.exchange import Imported, Package

SHOWN = 20
"""Refused files and gaps that are listed; with --json all of them are."""


class Format(StrEnum):
    """How a catalog is exported."""

    BUNDLE = "bundle"
    COIL = "coil"
    CSV = "csv"
    PARQUET = "parquet"
    SHEETS = "sheets"
    HTML = "html"


@command
def import_(
    settings: Settings,
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="A folder of photographs, a .rigcat.zip, or a .csv with images.")
    ],
    pattern: Annotated[
        str | None,
        typer.Option(help="How a folder's photographs are named, e.g. '{object}/view-{angle}'; '{object}__{angle}'."),
    ] = None,
    table_angles: Annotated[
        bool, typer.Option("--table-angles", help="Angles in names are the turning table's: azimuths run against them.")
    ] = False,
    label: Annotated[str | None, typer.Option(help="Label of the objects that have none.")] = None,
    on_conflict: Annotated[
        str, typer.Option(metavar="refuse|skip|replace", help="What to do about objects that are enrolled already.")
    ] = "refuse",
    strict: Annotated[bool, typer.Option("--strict", help="Take nothing if one file is refused.")] = False,
    descriptor: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Describe the images by this, too, such as edges+colours; rig catalog redescribe does so later. "
            "Repeatable.",
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would come in.")] = False,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes; one for each core otherwise.")] = None,
) -> None:
    """Bring photographs of known angles, or another bench's objects, into the catalog; all of it or nothing.

    Example: rig import coil-100 --label coil --bench sim
    """
    package = _package(source, pattern, table_angles)
    take_in(
        settings,
        package,
        on_conflict=on_conflict,
        label=label,
        further=descriptor or (),
        strict=strict,
        dry_run=dry_run,
        jobs=jobs,
    )


def take_in(
    settings: Settings,
    package: "Package",
    *,
    on_conflict: str,
    label: str | None,
    further: "Sequence[str]" = (),
    strict: bool,
    dry_run: bool,
    jobs: int | None,
) -> None:
    """Import a package, or preview it, and report."""
    from contextlib import nullcontext

    from rig.catalog.exchange import Conflict, bring_in, plan_import, preview_import
    from rig.core.clock import SystemClock, seconds_between
    from rig.core.errors import UsageError

    try:
        conflict = Conflict(on_conflict)
    except ValueError as error:
        raise UsageError(
            f"--on-conflict {on_conflict!r} is unknown", next_step="give refuse, skip or replace"
        ) from error
    clock = SystemClock()
    begin_ns = clock.now_ns()
    nothing = "Interrupted; nothing was imported."
    if dry_run:
        with settings.catalog_there() or nullcontext() as there:
            plan = plan_import(there, package, conflict)
        done = run_job("looking", preview_import(plan, strict=strict, jobs=jobs), interrupted=nothing)
    else:
        with settings.open_catalog(create=True) as catalog:
            plan = plan_import(catalog, package, conflict)
            job = bring_in(catalog, plan, label=label, further=further, strict=strict, jobs=jobs)
            done = run_job("importing", job, interrupted=nothing)
    _report(settings, done, seconds_between(begin_ns, clock.now_ns()), dry_run=dry_run)


def _package(source: Path, pattern: str | None, table_angles: bool) -> "Package":
    from rig.catalog.exchange import DEFAULT_PATTERN, open_bundle, read_folder, read_table
    from rig.core.clock import SystemClock
    from rig.core.errors import ImportRejected, UsageError

    now = SystemClock().utc()
    if source.is_dir():
        if (source / "catalog.sqlite").exists():
            raise UsageError(f"{source} is a catalog", next_step=f"bring it in by rig catalog merge {source}")
        return read_folder(source, pattern=pattern or DEFAULT_PATTERN, table_angles=table_angles, now=now)
    if pattern is not None or table_angles:
        raise UsageError(f"{source} is no folder", next_step="--pattern and --table-angles are for folders")
    if not source.exists():
        raise ImportRejected(f"there is no {source}", next_step="check the path")
    if source.suffix.lower() == ".zip":
        return open_bundle(source)
    if source.suffix.lower() == ".csv":
        return read_table(source, now=now)
    raise ImportRejected(
        f"{source} is neither a folder, a .zip nor a .csv", next_step="give one of those: rig import --help"
    )


def _report(settings: Settings, done: "Imported", seconds: float, *, dry_run: bool) -> None:
    from rig.events.wording import counted

    if settings.json:
        from rig.events.events import plain

        settings.print_json({"dry_run": dry_run, "seconds": round(seconds, 3), **plain(done)})
        return
    per_second = f", {done.views / seconds:.0f} images a second" if seconds > 0 and not dry_run else ""
    print(
        f"{'Would import' if dry_run else 'Imported'} {counted(done.objects, 'object')} with "
        f"{counted(done.views, 'view')}, {size_words(done.bytes)}, in {seconds:.1f} s{per_second}."
    )
    if done.replaced:
        print(f"Enrolled anew: {', '.join(done.replaced[:SHOWN])}")
    if done.skipped:
        print(f"Left out, in the catalog already: {', '.join(done.skipped[:SHOWN])}")
    if done.gaps:
        print(f"{counted(len(done.gaps), 'gap')}, views that lack in the even spacing of the others:")
        by_object: dict[str, list[str]] = {}
        for gap in done.gaps:
            by_object.setdefault(gap.object_name, []).append(f"{gap.azimuth_deg:g}°")
        for name, angles in list(by_object.items())[:SHOWN]:
            print(f"  {name}: {', '.join(angles)}")
        if len(by_object) > SHOWN:
            print(f"  and {len(by_object) - SHOWN} other objects (--json lists all)")
    if done.refused:
        print(f"{counted(len(done.refused), 'file')} refused:", file=sys.stderr)
        for file in done.refused[:SHOWN]:
            print(f"  {file.path}: {file.reason}", file=sys.stderr)
        if len(done.refused) > SHOWN:
            print(f"  and {len(done.refused) - SHOWN} others (--json lists all)", file=sys.stderr)


@command
def export(
    settings: Settings,
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="File or folder to write; it must not be there.")],
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="Objects; all otherwise.", autocompletion=object_names),
    ] = None,
    format_: Annotated[
        Format | None, typer.Option("--format", help="As the target's suffix says otherwise; coil for a folder.")
    ] = None,
    label: Annotated[str | None, typer.Option(help="Objects of this label alone.")] = None,
) -> None:
    """Write objects in an open format: a bundle that holds everything, or images, tables and pages to look at.

    Example: rig export tray.rigcat.zip --label kitchen --bench sim
    """
    from rig.catalog.exchange import collect, write_bundle, write_folder, write_parquet, write_table
    from rig.core.errors import ExportFailed
    from rig.events.wording import counted
    from rig.report.catalog_page import write_catalog_page, write_sheets

    form = format_ or _format(target)
    with settings.open_catalog(read_only=True) as catalog:
        wanted = list(names or [])
        if label is not None:
            labelled = [item.name for item in catalog.objects() if item.label == label]
            wanted = [name for name in labelled if not wanted or name in wanted]
        if label is not None and not wanted:
            raise ExportFailed(f"no object has the label {label!r}", next_step="list the objects: rig catalog list")
        objects = collect(catalog, wanted)
        match form:
            case Format.BUNDLE:
                count = write_bundle(target, objects)
            case Format.COIL:
                count = write_folder(target, objects)
            case Format.CSV:
                count = write_table(target, objects)
            case Format.PARQUET:
                count = write_parquet(target, objects)
            case Format.SHEETS:
                count = write_sheets(target, objects)
            case Format.HTML:
                count = write_catalog_page(target, objects)
    settings.say(
        f"Exported {counted(count, 'object')} to {target} ({form}).",
        {"target": str(target), "format": form, "objects": count},
    )


def _format(target: Path) -> Format:
    from rig.core.errors import UsageError

    suffix = target.suffix.lower()
    known = {".zip": Format.BUNDLE, ".parquet": Format.PARQUET, "": Format.COIL}
    if suffix not in known:
        raise UsageError(
            f"what to write into {target} is not clear", next_step=f"give --format, one of {', '.join(Format)}"
        )
    return known[suffix]
