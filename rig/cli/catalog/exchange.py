"""`rig import` and `rig export`."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Final, Literal

import typer

from rig.calibrations import CalibrationStore
from rig.catalog import Catalog
from rig.catalog.exchange.bundle import read_bundle, write_bundle
from rig.catalog.exchange.photographs import Photographs, read_photographs
from rig.catalog.exchange.scan import ScanFormat, write_scan
from rig.catalog.exchange.tables import TableFormat, write_folder, write_views
from rig.catalog.exchange.training import Annotations, write_training
from rig.catalog.transfer import CatalogSource, Conflict, TransferSource, transfer
from rig.cli.ui.command import command
from rig.cli.ui.options import JobsOption
from rig.cli.ui.present import first, run_job, size_words
from rig.cli.ui.settings import Settings
from rig.config.catalog_place import DATABASE_NAME
from rig.core.clock import SystemClock, seconds_between
from rig.core.errors import ExportFailed, ImportRejected, UsageError
from rig.core.json_form import plain
from rig.core.next_steps import Do
from rig.core.phrases import counted
from rig.views.description import DESCRIPTORS

SHOWN: Final = 20
"""Number of rejected files and of objects that are listed. With --json all of them are."""


_FORMAT_OF: Final = {"": "folder", ".zip": "bundle", ".csv": "csv", ".json": "json", ".parquet": "parquet"}
"""The format that the suffix of a target names."""


@command
def import_(
    settings: Settings,
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE", help="Folder of photographs or of a catalog, bundle (.rigcat.zip), or table (.csv)."
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
    empty_table: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="For photographs: image of the empty table, or a folder of them, named by object (mug.png) or by "
            "angle (90.png).",
        ),
    ] = None,
    label: Annotated[str | None, typer.Option(help="Label for objects without a label.")] = None,
    on_conflict: Annotated[
        Literal["reject", "skip", "replace"], typer.Option(help="What to do with objects that are enrolled already.")
    ] = "reject",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only report what would be imported.")] = False,
    jobs: JobsOption = None,
) -> None:
    """Import photographs with known angles, or the enrolled objects of another catalog; all or nothing.

    Example: rig import coil-100 --label coil --bench sim

    Example: rig import photographs --empty-table empty.png --bench sim

    Example: rig import /media/stick/catalog --on-conflict skip --bench sim
    """
    clock = SystemClock()
    begin_ns = clock.now_ns()
    with _source(source, pattern, table_angles, empty_table) as objects, _target(settings, dry_run) as catalog:
        job = transfer(
            *(objects, catalog),
            conflict=Conflict(on_conflict),
            label=label,
            descriptors=DESCRIPTORS,
            jobs=jobs,
            dry_run=dry_run,
        )
        what = "checking" if dry_run else "importing"
        done = run_job(what, job, interrupted="Interrupted; nothing was imported.")
    seconds = seconds_between(begin_ns, clock.now_ns())
    # What was imported, on stdout; the files that were not are a warning.
    lines = [
        f"{'Would import' if dry_run else 'Imported'} {counted(done.objects, 'object')} with "
        f"{counted(done.views, 'view')}, {size_words(done.bytes)}, in {seconds:.1f} s."
    ]
    if isinstance(objects, Photographs) and objects.are_whole:
        lines.append("Whole photographs are described: view.roi is only for the frames of the bench.")
    for title, names in (("Enrolled again", done.replaced), ("Skipped, already in the catalog", done.skipped)):
        lines += [f"{title}: {', '.join(names[:SHOWN])}"] if names else []
    settings.say("\n".join(lines), {"dry_run": dry_run, "seconds": round(seconds, 3), **plain(done)})
    if done.rejected:
        shown = first([f"{file.path}: {file.reason}" for file in done.rejected], SHOWN)
        print(f"{counted(len(done.rejected), 'file')} rejected:", *shown, sep="\n  ", file=sys.stderr)


@contextmanager
def _target(settings: Settings, dry_run: bool) -> Iterator[Catalog]:
    """Yield the catalog; an empty one in its place for a ``dry_run`` before there is one."""
    if not dry_run or settings.place.may_exist():
        with settings.open_catalog(read_only=dry_run, create=not dry_run) as catalog:
            yield catalog
        return
    with TemporaryDirectory() as folder, Catalog.open(folder, clock=SystemClock()) as catalog:
        yield catalog


@contextmanager
def _source(
    source: Path, pattern: str | None, table_angles: bool, empty_table: Path | None
) -> Iterator[TransferSource]:
    """Yield what is imported: a bundle, a catalog such as a training set, or photographs."""
    clock = SystemClock()
    is_folder = source.is_dir() and not (source / DATABASE_NAME).exists()
    has_photographs = is_folder or (source.suffix.lower() == ".csv" and source.is_file())
    is_named = pattern is not None or table_angles
    if source.exists() and ((is_named and not is_folder) or (empty_table is not None and not has_photographs)):
        raise UsageError(
            f"{source} is not a folder of photographs.",
            next_step="Use --pattern and --table-angles only with a folder of photographs, and --empty-table with that "
            "or with a table (.csv).",
        )
    if has_photographs:
        photographs = read_photographs(source, pattern=pattern, table_angles=table_angles, now=clock.utc())
        if empty_table is not None:
            photographs.use_empty_tables(empty_table, table_angles=table_angles)
        yield photographs
    elif source.is_dir():
        with Catalog.open(source, clock=clock, create=False, read_only=True) as catalog:
            yield CatalogSource(catalog, own=False)
    elif not source.exists():
        raise ImportRejected(f"{source} does not exist.", next_step="Check the path.")
    elif source.suffix.lower() == ".zip":
        with read_bundle(source, clock) as bundle:
            yield bundle
    else:
        raise ImportRejected(
            f"{source} is not a folder, a .zip file or a .csv file.", next_step="Give one of these: rig import --help"
        )


@command
def export(
    settings: Settings,
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="File or folder to write. It must not exist.")],
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="Names of the objects (default: all).")
    ] = None,
    format_: Annotated[
        Literal["bundle", "folder", "csv", "json", "parquet", "coco", "yolo", "colmap", "nerfstudio"] | None,
        typer.Option("--format", help="Format (default: by the suffix of the target, folder without one)."),
    ] = None,
    label: Annotated[str | None, typer.Option(help="Only objects with this label.")] = None,
) -> None:
    """Export objects in an open format.

    Formats: bundle (for rig import), folder (images named as in COIL-100, with a table views.csv), csv,
    json and parquet (table without images), coco and yolo (training sets with boxes and masks, divided into train, val
    and test), colmap and nerfstudio (one object with masks and the poses of the camera, to reconstruct it).

    Example: rig export tray.rigcat.zip --label kitchen --bench sim

    Example: rig export training --format coco --bench sim

    Example: rig export scan mug-white --format colmap --bench sim
    """
    form = format_ or _FORMAT_OF.get(target.suffix.lower())
    if form is None:
        suffixes = ", ".join(f"{suffix or 'no suffix'} ({form})" for suffix, form in _FORMAT_OF.items())
        raise UsageError(
            f"The suffix of {target} does not name a format.",
            next_step=f"Use one of these suffixes: {suffixes}. Or give --format.",
        )
    words, values = "", {}
    with settings.open_catalog(read_only=True) as catalog:
        # Which objects: names, a label, or both.
        wanted = list(names or [])
        if label is not None:
            labelled = [item.name for item in catalog.objects() if item.label == label and item.views]
            wanted = [name for name in labelled if not wanted or name in wanted]
            if not wanted:
                raise ExportFailed(f"No enrolled object has the label {label!r}.", next_step=Do.LIST_OBJECTS())
        source = CatalogSource(catalog, wanted)
        match form:
            case "coco" | "yolo":
                job = write_training(target, source, Annotations(form))
                done = run_job("exporting", job, interrupted="Interrupted; nothing was exported.")
                count, values = done.objects, plain(done)
                words = f" Views: {', '.join(f'{part} {views}' for part, views in done.views.items())}."
                if done.without_mask:
                    what = "marked as a region to ignore" if form == "coco" else "left out"
                    words += f" No object was found in {counted(done.without_mask, 'view')}, {what}."
            case "colmap" | "nerfstudio":
                results = CalibrationStore(settings.load().calibration_path(settings.bench_name)).history()
                views = write_scan(target, source, ScanFormat(form), results)
                count, values, words = 1, {"views": views}, f" Views: {views}."
            case "bundle":
                count = write_bundle(target, source)
            case "folder":
                count = write_folder(target, source)
            case _:
                count = write_views(target, source, TableFormat(form))
    settings.say(
        f"Exported {counted(count, 'object')} to {target} ({form}).{words}",
        {"target": str(target), "format": form, "objects": count, **values},
    )
