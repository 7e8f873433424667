"""`rig catalog ...`: the objects of a catalog, one by one."""

from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Annotated, Any, Final

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
    from rig.catalog import ObjectDetails, ObjectSummary, Session, View
    from rig.catalog.describing import Described

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
    with settings.open_catalog(read_only=True) as catalog:
        found = catalog.objects(deleted=deleted)
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
    from rig.catalog.derived import described
    from rig.catalog.describing import Described
    from rig.core.errors import CatalogError

    found, problem = Described({}, ()), None
    with settings.open_catalog(read_only=True) as catalog:
        details = catalog.object(name)
        folder = catalog.database.images.where("")
        try:
            if details.complete is not None:
                found = described(catalog, details.complete, details.summary.name)
        except CatalogError as error:  # an image is missing: the rest is shown before
            problem = error
    if settings.json:
        settings.print_json(_as_json(details, found))
    else:
        _print_object(details, found, folder, full=full)
    if problem is not None:
        raise problem


def _as_json(details: "ObjectDetails", described: "Described") -> dict[str, Any]:
    """Return an object with its views and their descriptions as JSON values."""
    from rig.catalog.images import path_of
    from rig.core.json_form import plain
    from rig.views.segmentation_evidence import SegmentationSummary

    def session(one: "Session") -> dict[str, Any]:
        return {
            "id": one.number,
            "started_utc": one.started_utc,
            "provenance": one.provenance,
            "empty_table_image": one.empty_table and path_of(one.empty_table),
        }

    def view(place: int, one: "View") -> dict[str, Any]:
        record = {key: getattr(one, key) for key in _OF_A_RECORD}
        record["descriptors"] = {name: levels[place].tolist() for name, levels in described.levels.items()}
        record["segmentation"] = described.segmentation[place] if described.segmentation else None
        return {
            "id": one.id,
            "object_name": details.summary.name,
            "enrollment_id": one.enrollment_id,
            "session": session(sessions[one.session]),
            "record": record,
            "captured_utc": one.captured_utc,
            "image": path_of(one.image),
            "image_sha256": one.image.partition(".")[0],
            "image_bytes": one.image_bytes,
        }

    sessions = () if details.complete is None else details.complete.sessions
    enrollments = [
        {
            "id": one.enrollment.id,
            "status": one.status,
            "started_utc": one.enrollment.started_utc,
            "finished_utc": one.finished_utc,
            "planned_azimuth_deg": one.enrollment.planned_azimuth_deg,
            "present": one.enrollment.present,
            "sessions": [session(part) for part in one.enrollment.sessions],
        }
        for one in details.enrollments
    ]
    shown: dict[str, Any] = plain(
        {
            "summary": details.summary,
            "enrollments": enrollments,
            "views": [view(place, one) for place, one in enumerate(details.views)],
            "segmentation": SegmentationSummary.of(described.segmentation),
        }
    )
    return shown


_OF_A_RECORD: Final = (
    *("index", "commanded_deg", "encoder_deg", "azimuth_deg", "captured_ns", "imu_deg", "imu_sigma_deg"),
    *("evidence", "region"),
)


def _print_object(details: "ObjectDetails", described: "Described", folder: str, *, full: bool) -> None:
    from rig.views.segmentation_evidence import SegmentationSummary

    summary = details.summary
    print("  ".join(text for text in (summary.name, summary.label) if text))
    if summary.note:
        print(summary.note)
    for one in details.enrollments:
        enrollment = one.enrollment
        print(
            f"enrollment {enrollment.id}: {one.status}, {len(enrollment.present)} of "
            f"{len(enrollment.planned_azimuth_deg)} views, started {enrollment.started_utc:%Y-%m-%d %H:%M} UTC"
        )
        for session in enrollment.sessions:
            provenance = session.provenance
            devices = {part: value if full else _model(value) for part, value in provenance.devices.items()}
            source = {"bench": provenance.bench, "software": provenance.software, **devices}
            print(f"  {session.started_utc:%Y-%m-%d %H:%M} UTC: {_in_one_line(source)}")
            if full:
                print(*(f"    {key}: {_in_one_line(value)}" for key, value in provenance.conditions.items()), sep="\n")
            elif provenance.conditions:
                print(f"    {counted(_count(provenance.conditions), 'setting')}: --full")
    if not details.views:
        return
    if segmentation := SegmentationSummary.of(described.segmentation).text:
        print(segmentation)
    print(f"images in {folder}")
    print("view  azimuth   encoder       IMU  sharpness")
    for view in details.views:
        print(
            f"{view.index:4d}  {view.azimuth_deg:6.2f}°  {_number(view.encoder_deg, 7, 2)}°  "
            f"{_number(view.imu_deg, 7, 2)}°  {_number(view.evidence.get('sharpness'), 9, 1)}"
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
    with settings.open_catalog() as catalog:
        catalog.rename(name, new_name)
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
    if label is None and note is None:
        raise UsageError("Neither a label nor a note is given.", next_step="Give a label, --note, or both.")
    with settings.open_catalog() as catalog:
        catalog.set_texts(name, label=label, note=note)
        summary = catalog.summary(name)
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
    with settings.open_catalog() as catalog:
        found = [catalog.summary(name) for name in dict.fromkeys(names)]
        views = sum(item.views for item in found)
        confirm(
            f"Delete {', '.join(item.name for item in found)} with {counted(views, 'view')}?",
            yes=yes,
            settings=settings,
        )
        catalog.delete(*names)
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
    with settings.open_catalog() as catalog:
        catalog.undelete(name)
        views = catalog.summary(name).views
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
        state = "" if kind.current else ", by another version of the program: they are computed again"
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
