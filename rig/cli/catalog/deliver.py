"""`rig catalog deliver`: bring the journal of this computer to the server."""

import sys
from typing import Annotated

import typer

from rig.cli.ui.command import command
from rig.cli.ui.exit_codes import EXIT_CATALOG
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock
from rig.core.errors import UsageError


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
    from rig.catalog import edit
    from rig.catalog.journal import Journal
    from rig.catalog.journal import discard as remove
    from rig.catalog.shared import deliver_journal, delivery_words

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
                edit.rename(journal, *rename)
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
