"""`rig enroll`."""

import sys
from typing import Annotated

import typer

from rig.cli.command import Settings, command


@command
def enroll(
    settings: Settings,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the object that stands on the table.")],
    views: Annotated[int | None, typer.Option(min=4, max=720, help="Views in a turn; enroll.views otherwise.")] = None,
    label: Annotated[str | None, typer.Option(help="A label, to sort and filter by.")] = None,
    note: Annotated[str | None, typer.Option(help="A remark.")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Take the missing views of an interrupted enrollment.")
    ] = False,
    replace: Annotated[
        bool, typer.Option("--replace", help="Enroll anew; the old views stay in use until the new ones are complete.")
    ] = False,
) -> None:
    """Enroll an object: one turn of the table, a checked view at every step.

    Example: rig enroll mug-white --bench sim --views 36
    """
    from rig.cli.present import Progress, line
    from rig.plans.enroll import enroll as plan
    from rig.plans.events import Accepted, Enrolled, Moved, Rejected, Started, event_dict

    with settings.open_bench() as bench, settings.open_catalog(clock=bench.clock, create=True) as catalog:
        events = plan(bench, catalog, name, views=views, label=label, note=note, resume=resume, replace=replace)
        kept = 0
        try:
            with Progress(name) as progress:
                for event in events:
                    if settings.json:
                        settings.print_json(event_dict(event))
                    match event:
                        case Started():
                            progress.start(event.views)
                        case Accepted():
                            kept += 1
                            progress.advance()
                        case Rejected():
                            progress.note(line(event))
                        case Moved(agrees=False):
                            progress.note(line(event))
                        case Enrolled() if not settings.json:
                            progress.note(line(event))
                        case _:
                            pass
        except BaseException:
            if kept:
                print(
                    "The views taken so far are kept; the same command with --resume takes the others.", file=sys.stderr
                )
            raise
        finally:
            events.close()
