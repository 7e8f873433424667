"""`rig catalog ...`: the objects of a catalog, one by one."""

from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.ui.command import command
from rig.cli.ui.complete import object_names
from rig.cli.ui.jobs import size_words
from rig.cli.ui.options import YesOption
from rig.cli.ui.prompts import confirm
from rig.cli.ui.settings import Settings
from rig.core.errors import UsageError
from rig.core.phrases import counted, number

if TYPE_CHECKING:
    from rig.catalog import ObjectDetails, ObjectSummary

app = typer.Typer(help="Manage the enrolled objects.", no_args_is_help=True)

NameArgument = Annotated[str, typer.Argument(metavar="NAME", help="Name of the object.", autocompletion=object_names)]


@app.command("list")
@command
def list_(
    settings: Settings,
    match: Annotated[
        str | None, typer.Argument(metavar="[PATTERN]", help="Only names that match, e.g. 'mug-*'.")
    ] = None,
    label: Annotated[str | None, typer.Option(help="Only objects with this label.")] = None,
    unfinished: Annotated[bool, typer.Option("--unfinished", help="Only unfinished enrollments.")] = False,
    deleted: Annotated[bool, typer.Option("--deleted", help="List deleted objects instead.")] = False,
) -> None:
    """List the enrolled objects. Exit code 7 if the catalog is damaged.

    Columns: name of the object, its label, its number of views (in brackets those of an unfinished enrollment), and the
    time when its enrollment was complete.

    Example: rig catalog list 'mug-*' --label kitchen --bench sim
    """
    from rig.catalog.edit import deleted_objects

    with settings.open_catalog(read_only=True) as catalog:
        found = deleted_objects(catalog) if deleted else catalog.objects()
        objects = [
            item
            for item in found
            if (match is None or fnmatchcase(item.name, match))
            and (label is None or item.label == label)
            and (not unfinished or item.unfinished_views is not None)
        ]
        if settings.json:
            settings.print_json({"catalog": str(catalog.place), "objects": objects})
        elif objects:
            _print_objects(objects)
        else:
            empty = "No deleted objects." if deleted else "No objects yet. Enroll one: rig enroll NAME"
            print(f"None of the {len(found)} objects matches." if found else empty)
        damage = catalog.damage()  # seconds for a large catalog, so the table is shown before
    if damage is not None:
        raise damage


def _print_objects(objects: "list[ObjectSummary]") -> None:
    from rig.cli.ui.present import print_table

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
def show(
    settings: Settings,
    name: NameArgument,
    full: Annotated[
        bool, typer.Option("--full", help="Also show all settings of the devices and conditions of each session.")
    ] = False,
) -> None:
    """Show an object: its enrollments with their sessions, and the angles of its views. Exit code 7 if it is damaged.

    Columns: index of the view, azimuth of the camera, table angle by the servo's encoder and by the IMU, and sharpness.

    Example: rig catalog show mug-white --bench sim
    """
    from rig.core.json_form import plain
    from rig.views.segmentation_evidence import SegmentationSummary

    with settings.open_catalog(read_only=True) as catalog:
        details = catalog.object(name)
        folder, damage = catalog.database.images.where(""), catalog.damage(name)
    if settings.json:
        shown = plain(details)
        for view, shown_view in zip(details.views, shown["views"], strict=True):
            levels = {name: found.tolist() for name, found in view.record.descriptors.items()}
            shown_view["record"]["descriptors"] = levels
        shown["segmentation"] = plain(SegmentationSummary.of(view.record.segmentation for view in details.views))
        settings.print_json(shown)
    else:
        _print_object(details, folder, full=full)
    if damage is not None:
        raise damage


def _print_object(details: "ObjectDetails", folder: str, *, full: bool) -> None:
    from rig.views.segmentation_evidence import SegmentationSummary

    summary = details.summary
    print("  ".join(text for text in (summary.name, summary.label) if text))
    if summary.note:
        print(summary.note)
    for enrollment in details.enrollments:
        print(
            f"enrollment {enrollment.id}: {enrollment.status}, {len(enrollment.present)} of "
            f"{len(enrollment.planned_azimuth_deg)} views, started {enrollment.started_utc:%Y-%m-%d %H:%M} UTC"
        )
        for session in enrollment.sessions:
            provenance = session.provenance
            devices = provenance.devices if full else {part: _model(one) for part, one in provenance.devices.items()}
            source = {"bench": provenance.bench, "software": provenance.software, **devices}
            print(f"  {session.started_utc:%Y-%m-%d %H:%M} UTC: {_in_one_line(source)}")
            if full:
                print(*(f"    {key}: {_in_one_line(value)}" for key, value in provenance.conditions.items()), sep="\n")
            elif provenance.conditions:
                print(f"    {counted(_count(provenance.conditions), 'setting')}: --full")
    if not details.views:
        return
    if segmentation := SegmentationSummary.of(view.record.segmentation for view in details.views).text:
        print(segmentation)
    print(f"images in {folder.rstrip('/')}/{details.views[0].image.rpartition('/')[0]}")
    print("view  azimuth   encoder       IMU  sharpness")
    for view in details.views:
        record = view.record
        print(
            f"{record.index:4d}  {record.azimuth_deg:6.2f}°  {_number(record.encoder_deg, 7, 2)}°  "
            f"{_number(record.imu_deg, 7, 2)}°  {_number(record.evidence.get('sharpness'), 9, 1)}"
        )


@app.command("rename")
@command
def rename_(
    settings: Settings,
    name: NameArgument,
    new_name: Annotated[str, typer.Argument(metavar="NEW_NAME", help="New name.")],
) -> None:
    """Rename an object.

    Example: rig catalog rename mug-whit mug-white --bench sim
    """
    from rig.catalog.edit import rename

    with settings.open_catalog() as catalog:
        rename(catalog, name, new_name)
    settings.say(f"Renamed {name} to {new_name}.", {"name": new_name, "before": name})


@app.command("label")
@command
def label_(
    settings: Settings,
    name: NameArgument,
    label: Annotated[str | None, typer.Argument(metavar="[LABEL]", help="Text to filter by; '' removes it.")] = None,
    note: Annotated[str | None, typer.Option(help="Any text; '' removes it.")] = None,
) -> None:
    """Change the label or the note of an object.

    Example: rig catalog label mug-white kitchen --note "a chip at the rim" --bench sim
    """
    from rig.catalog.edit import set_texts

    if label is None and note is None:
        raise UsageError("Neither a label nor a note is given.", next_step="Give a label, --note, or both.")
    with settings.open_catalog() as catalog:
        set_texts(catalog, name, label=label, note=note)
        summary = catalog.object(name).summary
    settings.say(
        f"{summary.name}: label {summary.label or '–'}, note {summary.note or '–'}",
        {"name": summary.name, "label": summary.label, "note": summary.note},
    )


@app.command("delete")
@command
def delete_(
    settings: Settings,
    names: Annotated[
        list[str], typer.Argument(metavar="NAME...", help="Names of the objects.", autocompletion=object_names)
    ],
    yes: YesOption = False,
) -> None:
    """Delete objects. `rig catalog undelete` restores them until `rig catalog gc` removes them permanently.

    Example: rig catalog delete mug-white --yes --bench sim
    """
    from rig.catalog.edit import delete

    with settings.open_catalog() as catalog:
        found = [catalog.summary(name) for name in dict.fromkeys(names)]
        views = sum(item.views for item in found)
        confirm(
            f"Delete {', '.join(item.name for item in found)} with {counted(views, 'view')}?",
            yes=yes,
            settings=settings,
        )
        delete(catalog, *names)
    deleted = [item.name for item in found]
    settings.say(f"Deleted {', '.join(deleted)}. To restore: rig catalog undelete NAME", {"deleted": deleted})


@app.command("undelete")
@command
def undelete_(
    settings: Settings, name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the deleted object.")]
) -> None:
    """Restore a deleted object.

    Example: rig catalog undelete mug-white --bench sim
    """
    from rig.catalog.edit import undelete

    with settings.open_catalog() as catalog:
        undelete(catalog, name)
        views = catalog.object(name).summary.views
    settings.say(f"Restored {name} with {counted(views, 'view')}.", {"name": name, "views": views})


@app.command("stats")
@command
def stats(settings: Settings) -> None:
    """Show what the catalog contains, and its size.

    Example: rig catalog stats --bench sim --json
    """
    from rig.catalog.upkeep import statistics
    from rig.core.json_form import plain

    with settings.open_catalog(read_only=True) as catalog:
        found = statistics(catalog)
        path = catalog.place
    if settings.json:
        settings.print_json({"catalog": str(path), **plain(found)})
        return
    print(f"catalog      {path}, schema version {found.schema_version}")
    print(f"objects      {found.objects}" + (f" (+{found.deleted_objects} deleted)" if found.deleted_objects else ""))
    print("enrollments  " + (", ".join(f"{count} {status}" for status, count in found.enrollments.items()) or "none"))
    print(f"views        {found.views}")
    print(f"images       {size_words(found.image_bytes)}")
    room = found.free_disk_bytes
    free = "" if room is None else f"; {size_words(room)} free on the disk of the images"
    print(f"database     {size_words(found.database_bytes)}{free}")
    if found.labels.keys() - {""}:
        print("labels       " + ", ".join(f"{label or '(none)'} {count}" for label, count in found.labels.items()))
    print(
        "benches      "
        + (", ".join(f"{bench or '(imported)'} {count}" for bench, count in found.benches.items()) or "none")
    )
    for kind in found.descriptors:
        state = "" if kind.current else ", a version that this program cannot compare"
        print(f"descriptor   {kind.name} {kind.version}: {kind.views} views{state}")
    print(f"log          {found.log_entries} entries")
    print(f"results      {found.results}, {size_words(found.result_image_bytes)} of images")
    if found.deleted_image_bytes or found.old_image_bytes:
        print(
            f"removable    {size_words(found.deleted_image_bytes)} of deleted objects (rig catalog gc), "
            f"{size_words(found.old_image_bytes)} of earlier enrollments (rig catalog gc --old)"
        )


def _number(value: Any, width: int, digits: int) -> str:
    return (number(value, f".{digits}f") if isinstance(value, int | float) else "–").rjust(width)


def _model(identity: Any) -> Any:
    """Return the short name of a device."""
    named = identity if isinstance(identity, dict) else {}
    return next((named[key] for key in ("model", "device", "name") if named.get(key)), identity)


def _count(values: Any) -> int:
    """Return the number of single values in nested ones."""
    return sum(map(_count, values.values())) if isinstance(values, dict) else 1


def _in_one_line(values: Any) -> str:
    """Return nested values in one line: servo (model xl430, id 1), ..."""
    if isinstance(values, dict):
        return ", ".join(
            f"{key} ({_in_one_line(value)})" if isinstance(value, dict) else f"{key} {_in_one_line(value)}"
            for key, value in values.items()
            if value not in (None, "", [], {})
        )
    if isinstance(values, list):
        return "[" + " ".join(_in_one_line(value) for value in values) + "]"
    return f"{values:g}" if isinstance(values, float) else str(values)
