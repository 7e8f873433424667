"""`rig catalog ...`: the objects of a catalog, one by one."""

import sys
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.ui.command import command
from rig.cli.ui.complete import object_names
from rig.cli.ui.jobs import confirm, print_table, size_words
from rig.cli.ui.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rig.bench import Bench
    from rig.catalog import Catalog

app = typer.Typer(help="Look after the enrolled objects.", no_args_is_help=True)

NameArgument = Annotated[str, typer.Argument(metavar="NAME", help="Name of the object.", autocompletion=object_names)]
YesOption = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")]


@app.command("list")
@command
def list_(
    settings: Settings,
    match: Annotated[
        str | None, typer.Argument(metavar="[PATTERN]", help="Names like this alone, e.g. 'mug-*'.")
    ] = None,
    label: Annotated[str | None, typer.Option(help="Objects of this label alone.")] = None,
    unfinished: Annotated[bool, typer.Option("--unfinished", help="Those with an interrupted enrollment.")] = False,
    deleted: Annotated[bool, typer.Option("--deleted", help="Those that were deleted and can be taken back.")] = False,
) -> None:
    """List the enrolled objects.

    Example: rig catalog list 'mug-*' --label kitchen --bench sim
    """
    from rig.events.events import plain

    with settings.open_catalog(read_only=True) as catalog:
        found = catalog.deleted() if deleted else catalog.objects()
        path = catalog.path
    objects = [
        item
        for item in found
        if (match is None or fnmatchcase(item.name, match))
        and (label is None or item.label == label)
        and (not unfinished or item.unfinished_views is not None)
    ]
    if settings.json:
        settings.print_json({"catalog": str(path), "objects": plain(objects)})
        return
    if not objects:
        none_at_all = "Nothing was deleted." if deleted else "No objects yet: rig enroll NAME."
        print(f"None of the {len(found)} objects is like that." if found else none_at_all)
        return
    rows = []
    for item in objects:
        views = str(item.views)
        if item.unfinished_views is not None:
            views += f" (+{item.unfinished_views} unfinished)"
        enrolled = f"{item.enrolled_utc:%Y-%m-%d %H:%M}" if item.enrolled_utc else "not yet"
        rows.append((item.name, item.label, views, enrolled))
    print_table(("object", "label", "views", "enrolled (UTC)"), rows)


@app.command("show")
@command
def show(settings: Settings, name: NameArgument) -> None:
    """Show an object: its enrollments, what they were taken with, and the angles and evidence of its views.

    Example: rig catalog show mug-white --bench sim
    """
    from rig.views.segmentation_evidence import SegmentationSummary

    with settings.open_catalog(read_only=True) as catalog:
        details = catalog.object(name)
        folder = catalog.path
    if settings.json:
        from rig.events.events import plain

        told = plain(details)
        for view, told_view in zip(details.views, told["views"], strict=True):
            levels = view.record.descriptor
            told_view["record"]["descriptor"] = None if levels is None else levels.tolist()
        told["segmentation"] = plain(SegmentationSummary.of(view.record.segmentation for view in details.views))
        settings.print_json(told)
        return
    summary = details.summary
    print("  ".join(text for text in (summary.name, summary.label) if text))
    if summary.note:
        print(summary.note)
    for enrollment in details.enrollments:
        print(
            f"enrollment {enrollment.id}: {enrollment.status}, {len(enrollment.present)} of "
            f"{len(enrollment.planned_azimuth_deg)} views, begun {enrollment.started_utc:%Y-%m-%d %H:%M} UTC"
        )
        for sitting in enrollment.sittings:
            provenance = sitting.provenance
            taken_with = _facts({"bench": provenance.bench, "software": provenance.software, **provenance.devices})
            print(f"  {sitting.started_utc:%Y-%m-%d %H:%M} UTC: {taken_with}")
            print(f"    {_facts(provenance.conditions)}")
    if not details.views:
        return
    if text := SegmentationSummary.of(view.record.segmentation for view in details.views).text:
        print(text)
    print(f"images in {(folder / details.views[0].image).parent}")
    print("view  azimuth  encoder      IMU   sharpness")
    for view in details.views:
        record = view.record
        print(
            f"{record.index:4d}  {record.azimuth_deg:6.2f}°  {_number(record.encoder_deg, 7, 2)}  "
            f"{_number(record.imu_deg, 8, 2)}  {_number(record.evidence.get('sharpness'), 8, 1)}"
        )


@app.command("rename")
@command
def rename(
    settings: Settings,
    name: NameArgument,
    new_name: Annotated[str, typer.Argument(metavar="NEW_NAME", help="What it is to be called.")],
) -> None:
    """Give an object another name.

    Example: rig catalog rename mug-whit mug-white --bench sim
    """
    with settings.open_catalog() as catalog:
        catalog.rename(name, new_name)
    settings.say(f"{name} is now called {new_name}.", {"name": new_name, "before": name})


@app.command("label")
@command
def label_(
    settings: Settings,
    name: NameArgument,
    label: Annotated[
        str | None, typer.Argument(metavar="[LABEL]", help="To sort and filter by; '' takes it away.")
    ] = None,
    note: Annotated[str | None, typer.Option(help="A remark; '' takes it away.")] = None,
) -> None:
    """Change the label or the note of an object.

    Example: rig catalog label mug-white kitchen --note "a chip at the rim" --bench sim
    """
    from rig.core.errors import UsageError

    if label is None and note is None:
        raise UsageError("neither a label nor a note is given", next_step="give a label, --note, or both")
    with settings.open_catalog() as catalog:
        catalog.describe(name, label=label, note=note)
        summary = catalog.object(name).summary
    settings.say(
        f"{summary.name}: label {summary.label or '–'}, note {summary.note or '–'}",
        {"name": summary.name, "label": summary.label, "note": summary.note},
    )


@app.command("delete")
@command
def delete(
    settings: Settings,
    names: Annotated[
        list[str], typer.Argument(metavar="NAME...", help="Names of the objects.", autocompletion=object_names)
    ],
    yes: YesOption = False,
) -> None:
    """Take objects out of use; `rig catalog undelete` takes that back, until `rig catalog gc`.

    Example: rig catalog delete mug-white --yes --bench sim
    """
    from rig.events.wording import counted

    with settings.open_catalog() as catalog:
        found = [catalog.object(name).summary for name in dict.fromkeys(names)]
        views = sum(item.views for item in found)
        confirm(
            f"Delete {', '.join(item.name for item in found)} with {counted(views, 'view')}?",
            yes=yes,
            settings=settings,
        )
        catalog.delete(*names)
    deleted = [item.name for item in found]
    settings.say(f"Deleted: {', '.join(deleted)}. Taken back by rig catalog undelete, until gc.", {"deleted": deleted})


@app.command("undelete")
@command
def undelete(settings: Settings, name: Annotated[str, typer.Argument(metavar="NAME")]) -> None:
    """Take the deletion of an object back.

    Example: rig catalog undelete mug-white --bench sim
    """
    from rig.events.wording import counted

    with settings.open_catalog() as catalog:
        catalog.undelete(name)
        views = catalog.object(name).summary.views
    settings.say(f"{name} is back, with {counted(views, 'view')}.", {"name": name, "views": views})


@app.command("stats")
@command
def stats(settings: Settings) -> None:
    """Say what the catalog holds and weighs.

    Example: rig catalog stats --bench sim --json
    """
    from rig.catalog.upkeep import statistics
    from rig.events.events import plain

    with settings.open_catalog(read_only=True) as catalog:
        found = statistics(catalog)
        path = catalog.path
    if settings.json:
        settings.print_json({"catalog": str(path), **plain(found)})
        return
    print(f"catalog      {path}, schema version {found.schema_version}")
    print(f"objects      {found.objects}" + (f" (+{found.deleted_objects} deleted)" if found.deleted_objects else ""))
    print("enrollments  " + (", ".join(f"{count} {status}" for status, count in found.enrollments.items()) or "none"))
    print(f"views        {found.views}")
    print(f"images       {size_words(found.image_bytes)}")
    print(f"database     {size_words(found.database_bytes)}; {size_words(found.free_disk_bytes)} free on its disk")
    if found.labels.keys() - {""}:
        print("labels       " + ", ".join(f"{label or '(none)'} {count}" for label, count in found.labels.items()))
    print(
        "benches      "
        + (", ".join(f"{bench or '(imported)'} {count}" for bench, count in found.benches.items()) or "none")
    )
    for kind in found.descriptors:
        state = "" if kind.current else ", which this program does not compare"
        print(f"described    {kind.views} views by {kind.name} {kind.version}{state}")
    print(f"log          {found.log_entries} entries")
    if found.deleted_image_bytes or found.old_image_bytes:
        print(
            f"to collect   {size_words(found.deleted_image_bytes)} of deleted objects (rig catalog gc), "
            f"{size_words(found.old_image_bytes)} of earlier enrollments (gc --old)"
        )


def tell_other_regions(settings: Settings, catalog: "Catalog", bench: "Bench") -> None:
    """Say on stderr where the bench looks at another part of its images than when the objects were enrolled.

    Regions that followed the object then and now, by calibrations of the axis, show the same of it wherever they are.
    """
    from rig.calibrations import CalibrationStore
    from rig.calibrations.store import CALIBRATIONS

    known = CalibrationStore(bench.config.calibration_path(bench.name)).history("table.axis")
    followed = {(fact.id, tuple(fact.settings["view.roi"])) for fact in known if "view.roi" in fact.settings}

    def follows(region: Any, calibrations: "Iterable[str]") -> bool:
        return any((id_, region) in followed for id_ in calibrations)

    region = bench.config.view.roi
    follows_now = follows(region, bench.conditions.get(CALIBRATIONS, ()))
    others = {
        other
        for other, calibrations in catalog.regions(settings.bench_name)
        if other != region and not (follows_now and follows(other, calibrations))
    }
    if others:
        seen = " and ".join(sorted("the whole image" if other is None else str(list(other)) for other in others))
        argument = "whole" if region is None else ",".join(map(str, region))
        print(
            f"Note: objects of this bench are described within {seen}, view.roi is "
            f"{'the whole image' if region is None else list(region)}"
            f"{' since the axis was calibrated' if follows_now else ''}. If the camera stands where it stood: "
            f"rig catalog redescribe --region {argument}. If it was moved: enroll those objects again, with --replace.",
            file=sys.stderr,
        )


def _number(value: Any, width: int, digits: int) -> str:
    return f"{value:{width}.{digits}f}" if isinstance(value, int | float) else "–".rjust(width)


def _facts(values: Any) -> str:
    """Nested facts in one line: servo (model xl430, id 1), ..."""
    if isinstance(values, dict):
        return ", ".join(
            f"{key} ({_facts(value)})" if isinstance(value, dict) else f"{key} {_facts(value)}"
            for key, value in values.items()
            if value not in (None, "", [], {})
        )
    if isinstance(values, list):
        return "[" + " ".join(_facts(value) for value in values) + "]"
    return f"{values:g}" if isinstance(values, float) else str(values)
