"""`rig import` and `rig export`."""

import sys
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rig.cli.ui.command import command
from rig.cli.ui.complete import object_names
from rig.cli.ui.jobs import run_job, size_words
from rig.cli.ui.options import ClusterOption, DryImportOption, JobsOption, descriptor_name, jobs_of
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock, seconds_between
from rig.core.errors import ExportFailed, ImportRejected, UsageError
from rig.core.next_steps import Do
from rig.core.phrases import counted

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rig.catalog import Session
    from rig.catalog.exchange.training import Intrinsics
    from rig.catalog.transfer import CatalogSource, Source, Transferred
    from rig.core.processes import Jobs

SHOWN = 20
"""Number of rejected files and of gaps that are listed. With --json all of them are."""


class Format(StrEnum):
    """Format of an export."""

    BUNDLE = "bundle"
    COIL = "coil"
    CSV = "csv"
    PARQUET = "parquet"
    SHEETS = "sheets"
    HTML = "html"
    COCO = "coco"
    YOLO = "yolo"


_FORMAT_OF: Final = {
    "": Format.COIL,
    ".zip": Format.BUNDLE,
    ".csv": Format.CSV,
    ".parquet": Format.PARQUET,
    ".html": Format.HTML,
}
"""The format that the suffix of a target names."""


@command
def import_(
    settings: Settings,
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE", help="Folder of photographs or of a training set, bundle (.rigcat.zip), or table (.csv)."
        ),
    ],
    pattern: Annotated[
        str | None,
        typer.Option(help="Names of the files in a folder, e.g. '{object}/view-{angle}' (default: {object}__{angle})."),
    ] = None,
    table_angles: Annotated[
        bool,
        typer.Option(
            "--table-angles", help="The angles in the names are table angles. Azimuths run in the opposite direction."
        ),
    ] = False,
    label: Annotated[str | None, typer.Option(help="Label for objects without a label.")] = None,
    on_conflict: Annotated[
        str, typer.Option(metavar="reject|skip|replace", help="What to do with objects that are enrolled already.")
    ] = "reject",
    strict: Annotated[bool, typer.Option("--strict", help="Import nothing if one file is rejected.")] = False,
    descriptor: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Also compute this descriptor, such as edges+colours. Repeatable. "
            "rig catalog redescribe can do it later.",
        ),
    ] = None,
    dry_run: DryImportOption = False,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
) -> None:
    """Import photographs with known angles, or objects of another bench; all or nothing.

    Example: rig import coil-100 --label coil --bench sim
    """
    with _source(source, pattern, table_angles) as objects:
        run_import(
            settings,
            objects,
            on_conflict=on_conflict,
            label=label,
            descriptors=[descriptor_name(one) for one in descriptor or ()],
            strict=strict,
            dry_run=dry_run,
            jobs=jobs_of(jobs, cluster),
        )


def run_import(
    settings: Settings,
    source: "Source",
    *,
    on_conflict: str,
    label: str | None,
    descriptors: "Sequence[str]" = (),
    strict: bool,
    dry_run: bool,
    jobs: "Jobs | None",
) -> None:
    """Import objects, or check them, and report."""
    from rig.catalog.transfer import Conflict, transfer
    from rig.views.description import PAPER_DESCRIPTOR

    try:
        conflict = Conflict(on_conflict)
    except ValueError as error:
        raise UsageError(
            f"--on-conflict {on_conflict!r} is unknown.", next_step="Give reject, skip or replace."
        ) from error
    clock = SystemClock()
    begin_ns = clock.now_ns()
    nothing = dry_run and not settings.place.may_exist()
    opened = nullcontext() if nothing else settings.open_catalog(read_only=dry_run, create=not dry_run)
    with opened as catalog:
        job = transfer(
            source,
            catalog,
            conflict=conflict,
            label=label,
            descriptors=(PAPER_DESCRIPTOR, *descriptors),
            strict=strict,
            jobs=jobs,
            dry_run=dry_run,
        )
        what = "checking" if dry_run else "importing"
        done = run_job(what, job, interrupted="Interrupted; nothing was imported.")
    _report(settings, done, seconds_between(begin_ns, clock.now_ns()), dry_run=dry_run)


@contextmanager
def _source(source: Path, pattern: str | None, table_angles: bool) -> "Iterator[Source]":
    """Yield what is imported: a bundle, a catalog such as a training set, or photographs."""
    from rig.catalog import Catalog
    from rig.catalog.exchange.bundle import read_bundle
    from rig.catalog.exchange.photographs import DEFAULT_PATTERN, read_folder, read_table
    from rig.catalog.transfer import CatalogSource
    from rig.config.catalog_place import DATABASE_NAME

    clock = SystemClock()
    is_folder = source.is_dir() and not (source / DATABASE_NAME).exists()
    if (pattern is not None or table_angles) and not is_folder:
        raise UsageError(
            f"{source} is not a folder of photographs.",
            next_step="Use --pattern and --table-angles only with a folder of photographs.",
        )
    if is_folder:
        yield read_folder(source, pattern=pattern or DEFAULT_PATTERN, table_angles=table_angles, now=clock.utc())
    elif source.is_dir():
        with Catalog.open(source, clock=clock, create=False, read_only=True) as catalog:
            yield CatalogSource(catalog, own=False)
    elif not source.exists():
        raise ImportRejected(f"{source} does not exist.", next_step="Check the path.")
    elif source.suffix.lower() == ".zip":
        with read_bundle(source, clock) as bundle:
            yield bundle
    elif source.suffix.lower() == ".csv":
        yield read_table(source, now=clock.utc())
    else:
        raise ImportRejected(
            f"{source} is not a folder, a .zip file or a .csv file.", next_step="Give one of these: rig import --help"
        )


def _report(settings: Settings, done: "Transferred", seconds: float, *, dry_run: bool) -> None:
    if settings.json:
        from rig.core.json_form import plain

        values = {**plain(replace(done, rejected=())), "rejected": [file.as_json() for file in done.rejected]}
        settings.print_json({"dry_run": dry_run, "seconds": round(seconds, 3), **values})
        return
    per_second = f", {done.views / seconds:.0f} images a second" if seconds > 0 and not dry_run else ""
    print(
        f"{'Would import' if dry_run else 'Imported'} {counted(done.objects, 'object')} with "
        f"{counted(done.views, 'view')}, {size_words(done.bytes)}, in {seconds:.1f} s{per_second}."
    )
    if done.replaced:
        print(f"Enrolled again: {', '.join(done.replaced[:SHOWN])}")
    if done.skipped:
        print(f"Skipped, already in the catalog: {', '.join(done.skipped[:SHOWN])}")
    if done.gaps:
        print(f"{counted(len(done.gaps), 'missing view')} in the even spacing of the others:")
        by_object: dict[str, list[str]] = {}
        for gap in done.gaps:
            by_object.setdefault(gap.object_name, []).append(f"{gap.azimuth_deg:g}°")
        for name, angles in list(by_object.items())[:SHOWN]:
            print(f"  {name}: {', '.join(angles)}")
        if len(by_object) > SHOWN:
            print(f"  and {len(by_object) - SHOWN} other objects (--json lists all)")
    if done.rejected:
        print(f"{counted(len(done.rejected), 'file')} rejected:", file=sys.stderr)
        for file in done.rejected[:SHOWN]:
            print(f"  {file.path}: {file.reason}", file=sys.stderr)
        if len(done.rejected) > SHOWN:
            print(f"  and {len(done.rejected) - SHOWN} others (--json lists all)", file=sys.stderr)


@command
def export(
    settings: Settings,
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="File or folder to write. It must not exist.")],
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="Names of the objects (default: all).", autocompletion=object_names),
    ] = None,
    format_: Annotated[
        Format | None,
        typer.Option("--format", help="Format (default: by the suffix of the target, coil for a folder)."),
    ] = None,
    label: Annotated[str | None, typer.Option(help="Only objects with this label.")] = None,
    split: Annotated[
        str | None,
        typer.Option(
            metavar="object|view", help="For a training set: divide the objects, or the views of each object."
        ),
    ] = None,
    fractions: Annotated[
        str, typer.Option(metavar="TRAIN,VAL,TEST", help="For a training set: shares of its parts.")
    ] = "0.8,0.1,0.1",
    jobs: Annotated[
        int | None, typer.Option(min=1, help="For a training set: number of processes (default: one per core).")
    ] = None,
) -> None:
    """Export objects in an open format.

    Formats: bundle (everything, for rig import), coil (folder of images), csv (table and images), parquet (table
    without images), sheets (contact sheets), html (page with contact sheets), coco and yolo (training sets with boxes
    and masks; --seed chooses the parts).

    Example: rig export tray.rigcat.zip --label kitchen --bench sim

    Example: rig export training --format coco --split view --bench sim
    """
    from rig.catalog.exchange.bundle import write_bundle
    from rig.catalog.exchange.tables import write_folder, write_parquet, write_table
    from rig.catalog.transfer import CatalogSource
    from rig.report.catalog_page import write_catalog_page, write_sheets

    writers = {
        Format.BUNDLE: write_bundle,
        Format.COIL: write_folder,
        Format.CSV: write_table,
        Format.PARQUET: write_parquet,
        Format.SHEETS: write_sheets,
        Format.HTML: write_catalog_page,
    }
    form = format_ or _format(target)
    with settings.open_catalog(read_only=True) as catalog:
        wanted = list(names or [])
        if label is not None:
            labelled = [item.name for item in catalog.objects() if item.label == label]
            wanted = [name for name in labelled if not wanted or name in wanted]
        if label is not None and not wanted:
            raise ExportFailed(f"No object has the label {label!r}.", next_step=Do.LIST_OBJECTS())
        source = CatalogSource(catalog, wanted)
        if form in (Format.COCO, Format.YOLO):
            _export_training(settings, target, source, form, split, fractions, jobs)
            return
        count = writers[form](target, source)
    settings.say(
        f"Exported {counted(count, 'object')} to {target} ({form}).",
        {"target": str(target), "format": form, "objects": count},
    )


def _export_training(
    settings: Settings,
    target: Path,
    source: "CatalogSource",
    form: Format,
    split: str | None,
    fractions: str,
    jobs: int | None,
) -> None:
    from rig.catalog.exchange.training import Annotations, Split, write_training
    from rig.core.json_form import plain

    try:
        shares = [float(part) for part in fractions.split(",")]
        divided = None if split is None else Split(split)
    except ValueError as error:
        raise UsageError(
            f"--split {split} or --fractions {fractions} is not possible.",
            next_step="Give object or view, and shares such as 0.8,0.1,0.1.",
        ) from error
    job = write_training(
        *(target, source, Annotations(form.value)),
        split=divided,
        fractions=shares,
        seed=settings.seed or 0,
        intrinsics=_intrinsics(settings),
        jobs=jobs,
    )
    done = run_job("exporting", job, interrupted="Interrupted; nothing was exported.")
    parts = ", ".join(f"{name} {views}" for name, views in done.views.items())
    text = f"Exported {counted(done.objects, 'object')} to {target} ({form}). Views: {parts}."
    if done.without_mask:
        what = "marked as a region to ignore" if form is Format.COCO else "left out"
        text += f" No object was found in {counted(done.without_mask, 'view')}, {what}."
    settings.say(text, {"target": str(target), "format": form, **plain(done)})


def _intrinsics(settings: Settings) -> "Intrinsics":
    """Return a function that finds the calibrated camera of a session among the calibration results of its bench."""
    from rig.calibrations import CalibrationStore
    from rig.calibrations.store import CALIBRATIONS

    @cache
    def of_bench(bench: str) -> dict[str, dict[str, float]]:
        results = CalibrationStore(settings.load().calibration_path(bench)).history("camera.intrinsics")
        return {one.id: {name: estimate.value for name, estimate in one.estimates.items()} for one in results}

    def of_session(session: "Session") -> dict[str, float] | None:
        by = session.provenance
        known = of_bench(by.bench) if by.bench == settings.bench_name else {}
        used = by.conditions.get(CALIBRATIONS)
        return next((known[str(one)] for one in used if str(one) in known), None) if isinstance(used, list) else None

    return of_session


def _format(target: Path) -> Format:
    form = _FORMAT_OF.get(target.suffix.lower())
    if form is None:
        suffixes = ", ".join(f"{suffix or 'no suffix'} ({form})" for suffix, form in _FORMAT_OF.items())
        raise UsageError(
            f"The suffix of {target} does not name a format.",
            next_step=f"Use one of these suffixes: {suffixes}. Or give --format.",
        )
    return form
