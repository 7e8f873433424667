"""`rig demo`: the main job on the simulated bench."""

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.ui.command import command
from rig.cli.ui.complete import strategy_names
from rig.cli.ui.settings import Settings

EXIT_QUALITY = 6


@command
def demo(
    settings: Settings,
    objects: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Photographs obj{N}__{A}.png instead of the built-in objects.")
    ] = None,
    count: Annotated[int | None, typer.Option(min=2, help="Objects to enroll: 16, or the folder's first 20.")] = None,
    change: Annotated[
        list[str] | None,
        typer.Option(
            "--change",
            metavar="NAME",
            help="What is another when objects are looked for: light (exposure and white balance, too), placement, or "
            "bench, all of it before another table and wall. Repeatable.",
        ),
    ] = None,
    strategy: Annotated[
        str | None,
        typer.Option(help="How objects are searched: dense, ahbr, ...", autocompletion=strategy_names),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option("--fault", metavar="NAME[@TIME]", help="Let a fault happen, e.g. jam@move3+2s. See rig faults."),
    ] = None,
    faults: Annotated[
        Path | None, typer.Option("--faults", metavar="FILE", help="Faults from a TOML file.", show_default=False)
    ] = None,
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Where report.html is written.")] = Path("rig-demo"),
) -> None:
    """Enroll objects on the simulated bench, then find each of them again, and two that were never enrolled.

    Example: rig demo --seed 7 --out /tmp/demo

    Example: rig demo --change light
    """
    from sim.change import Change
    from sim.demo.run import run_demo
    from sim.faults import Fault, load_faults

    planned = [*(load_faults(faults) if faults else ()), *(Fault.parse(text) for text in fault or ())]
    result = run_demo(
        settings,
        objects=objects,
        count=count,
        out=out,
        strategy=strategy,
        change=Change.named(change or ()),
        faults=planned,
    )
    if settings.json:
        settings.print_json(result.as_dict())
    if not result.good:
        raise typer.Exit(EXIT_QUALITY)
