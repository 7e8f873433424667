"""`rig catalog verify`, `gc` and `deliver`: the catalog as a whole.

Decision: docs/decisions/0010.
"""

import sys
from typing import Annotated

import typer

from rig.cli.catalog.catalog import app
from rig.cli.ui.command import command
from rig.cli.ui.exit_codes import EXIT_CATALOG
from rig.cli.ui.options import YesOption
from rig.cli.ui.prompts import confirm
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock
from rig.core.errors import UsageError
from rig.core.phrases import counted


@app.command("verify")
@command
def verify(settings: Settings) -> None:
    """Check whether everything is as it was stored. The exit code is 7 if it is not. Nothing is changed.

    Example: rig catalog verify --bench sim
    """
    from rig.catalog.verify import verify as job
    from rig.cli.ui.present import run_job, size_words

    with settings.open_catalog(read_only=True) as catalog:
        found = run_job("verifying", job(catalog), interrupted="Interrupted; nothing was changed.")
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
    from rig.catalog.upkeep import collect_garbage
    from rig.cli.ui.present import size_words
    from rig.core.json_form import plain

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
    from rig.catalog.journal import Journal, deliver_journal, delivery_words
    from rig.catalog.journal import discard as remove

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
