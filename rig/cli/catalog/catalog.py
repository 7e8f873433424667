"""Manage the enrolled objects."""

import sys
from dataclasses import asdict
from typing import Annotated, Any

import typer

from rig.catalog import ObjectDetails
from rig.catalog.describing import Described, described
from rig.catalog.images import path_of
from rig.catalog.journal import Journal, deliver_journal, delivery_words
from rig.catalog.upkeep import collect_garbage
from rig.catalog.verify import verify as verify_job
from rig.cli.ui.command import Group
from rig.cli.ui.exit_codes import EXIT_CATALOG
from rig.cli.ui.options import YesOption
from rig.cli.ui.present import print_table, run_job, size_words
from rig.cli.ui.prompts import confirm
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock
from rig.core.errors import CatalogError, UsageError
from rig.core.json_form import plain
from rig.core.phrases import counted
from rig.views.description import segmentation_summary, segmentation_words

# Decision: docs/decisions/0010.
app = Group(__doc__)

NameArgument = Annotated[str, typer.Argument(metavar="NAME", help="Name of the object.")]


@app.command("list")
def list_(
    settings: Settings,
    label: Annotated[str | None, typer.Option(help="Only objects with this label.")] = None,
    deleted: Annotated[bool, typer.Option("--deleted", help="List deleted objects instead.")] = False,
) -> None:
    """List the enrolled objects. Exit code 7 if the catalog is damaged.

    Example: rig catalog list --label kitchen --bench sim
    """
    with settings.open_catalog(read_only=True) as catalog:
        objects = [one for one in catalog.objects(deleted=deleted) if label in (None, one.label)]
        if settings.json:
            settings.print_json({"catalog": str(catalog.place), "objects": objects})
        elif not objects:
            print("No such objects." if deleted or label else "No objects yet. Enroll one: rig enroll NAME")
        else:
            print_table(
                ("name", "label", "views", "unfinished_views", "enrolled_utc"), [asdict(one) for one in objects]
            )
        damage = catalog.damage()  # seconds for a large catalog, so the table is shown before
    if damage is not None:
        raise damage


@app.command("show")
def show(settings: Settings, name: NameArgument) -> None:
    """Show an object: its enrollments with their sessions, and the angles of its views. Exit code 7 if it is damaged.

    With --json all settings of the devices and conditions of each session are shown, too.

    Example: rig catalog show mug-white --bench sim
    """
    found, problem = Described({}, ()), None
    with settings.open_catalog(read_only=True) as catalog:
        details = catalog.object(name)
        try:
            if details.complete is not None:
                found = described(catalog.database, details.complete, details.summary.name)
        except CatalogError as error:  # an image is missing: the rest is shown before
            problem = error
    if settings.json:
        settings.print_json(_as_json(details, found))
    else:
        _print_object(details, found)
    if problem is not None:
        raise problem


def _as_json(details: ObjectDetails, described: Described) -> dict[str, Any]:
    """Return an object with its views and their descriptions as JSON values: every column by its name."""

    def columns(row: Any) -> dict[str, Any]:
        names = [column.key for column in type(row).__mapper__.column_attrs]
        return {name: getattr(row, name) for name in names if name not in ("key", "digest", "object_id")}

    enrollments = [
        {
            **columns(one.enrollment),
            "status": one.status,
            "finished_utc": one.finished_utc,
            "sessions": [columns(part) for part in one.enrollment.sessions],
        }
        for one in details.enrollments
    ]
    views = [
        {
            **columns(view),
            "image": path_of(view.image),
            "image_sha256": view.image.partition(".")[0],
            "descriptors": {name: levels[place].tolist() for name, levels in described.levels.items()},
            "segmentation": described.segmentation[place] if described.segmentation else None,
        }
        for place, view in enumerate(details.views)
    ]
    segmentation = segmentation_summary(described.segmentation)
    shown = {"summary": details.summary, "enrollments": enrollments, "views": views, "segmentation": segmentation}
    return dict(plain(shown))


def _print_object(details: ObjectDetails, described: Described) -> None:
    summary = details.summary
    print("  ".join(filter(None, (summary.name, summary.label))))
    if summary.note:
        print(summary.note)
    for one in details.enrollments:
        enrollment = one.enrollment
        print(
            f"enrollment {enrollment.id}: {one.status}, {len(enrollment.present)} of "
            f"{len(enrollment.planned_azimuth_deg)} views, started {enrollment.started_utc:%Y-%m-%d %H:%M} UTC"
        )
        for session in enrollment.sessions:
            by = session.provenance
            print(f"  {session.started_utc:%Y-%m-%d %H:%M} UTC: bench {by.bench or '–'}, software {by.software}")
    if details.views:
        if words := segmentation_words(segmentation_summary(described.segmentation)):
            print(words)
        names = ("index", "azimuth_deg", "encoder_deg", "imu_deg")
        rows = [
            {**{name: getattr(view, name) for name in names}, "sharpness": view.evidence.get("sharpness")}
            for view in details.views
        ]
        print_table((*names, "sharpness"), rows)


@app.command("rename")
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
def delete_(
    settings: Settings,
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="Names of the objects.")],
    yes: YesOption = False,
) -> None:
    """Delete objects. `rig catalog undelete` restores them until `rig catalog gc` removes them permanently.

    Example: rig catalog delete mug-white --yes --bench sim
    """
    with settings.open_catalog() as catalog:
        found = [catalog.summary(name) for name in dict.fromkeys(names)]
        deleted = [one.name for one in found]
        views = counted(sum(one.views for one in found), "view")
        confirm(f"Delete {', '.join(deleted)} with {views}?", yes=yes, settings=settings)
        catalog.delete(*names)
    settings.say(f"Deleted {', '.join(deleted)}. To restore: rig catalog undelete NAME", {"deleted": deleted})


@app.command("undelete")
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


# -- the catalog as a whole -------------------------------------------------------------------------------------------


@app.command("verify")
def verify(settings: Settings) -> None:
    """Check whether everything is as it was stored. The exit code is 7 if it is not. Nothing is changed.

    Example: rig catalog verify --bench sim
    """
    with settings.open_catalog(read_only=True) as catalog:
        found = run_job("verifying", verify_job(catalog), interrupted="Interrupted; nothing was changed.")
    checked = ", ".join(
        counted(number, noun)
        for number, noun in ((found.objects, "object"), (found.views, "view"), (found.results, "result"))
    )
    problems = counted(len(found.findings), "problem")
    outcome = problems if found.findings else "everything is as it was stored"
    summary = f"{checked}, {size_words(found.image_bytes)} of images: {outcome}"
    settings.say("\n".join([*(finding.text for finding in found.findings), summary]), found)
    if found.findings:
        raise typer.Exit(EXIT_CATALOG)


@app.command("gc")
def gc(
    settings: Settings,
    old: Annotated[bool, typer.Option("--old", help="Also remove replaced and abandoned enrollments.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only report what would be removed.")] = False,
    yes: YesOption = False,
) -> None:
    """Remove deleted objects permanently, and images of interrupted work that are older than a day.

    Example: rig catalog gc --dry-run --bench sim
    """
    with settings.open_catalog() as catalog:
        found = collect_garbage(catalog, old=old, dry_run=True)
        names = ", ".join(found.objects[:10]) + (" and others" if len(found.objects) > 10 else "")
        words = (
            f"{counted(len(found.objects), 'deleted object')}{f' ({names})' if names else ''}, "
            f"{counted(found.enrollments, 'enrollment')}, {counted(found.views, 'view')} and "
            f"{counted(found.files, 'file')}, {size_words(found.bytes)}"
        )
        nothing = not (found.enrollments or found.files)
        if not dry_run and not nothing:
            confirm(f"Remove {words} permanently?", yes=yes, settings=settings)
            found = collect_garbage(catalog, old=old)
    text = f"{'Would remove' if dry_run else 'Removed'} {words}."
    settings.say("There is nothing to remove." if nothing else text, {"dry_run": dry_run, **plain(found)})


@app.command("deliver")
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
                journal.delete(discard)  # and the delivery removes it
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
