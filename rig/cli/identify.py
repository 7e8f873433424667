"""`rig identify`."""

from typing import Annotated

import typer

from rig.cli.command import Settings, command

EXIT_UNKNOWN = 8


@command
def identify(
    settings: Settings,
    max_views: Annotated[
        int | None, typer.Option(min=1, max=72, help="Views at most; identify.max_views otherwise.")
    ] = None,
) -> None:
    """Find out what stands on the table; ends with exit code 8 if it is unknown.

    Example: rig identify --bench sim --seed 3 --json
    """
    from hbr import ViewIndex
    from rig.cli.present import line
    from rig.plans.events import Identified, event_dict
    from rig.plans.identify import identify as plan

    if max_views is not None:
        settings = settings.merged(None, None, [f"identify.max_views={max_views}"], None, False)
    with settings.open_catalog(read_only=True) as catalog:
        index = ViewIndex(catalog.views().views)
    answer = None
    with settings.open_bench() as bench:
        events = plan(bench, index)
        try:
            for event in events:
                if settings.json:
                    settings.print_json(event_dict(event))
                elif text := line(event):
                    print(text, flush=True)
                if isinstance(event, Identified):
                    answer = event
        finally:
            events.close()
    if answer is None or answer.name is None:
        raise typer.Exit(EXIT_UNKNOWN)
