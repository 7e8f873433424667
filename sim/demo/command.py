"""`rig demo`: enroll and identify objects on the simulated bench; and `rig faults`: what can be simulated to fail."""

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.ui.command import command
from rig.cli.ui.exit_codes import EXIT_QUALITY
from rig.cli.ui.settings import Settings


@command
def demo(
    settings: Settings,
    objects: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Use photographs, as on the bench photographs, not the built-in objects."),
    ] = None,
    count: Annotated[
        int | None,
        typer.Option(min=2, metavar="N", help="Number of objects to enroll (default: 16, or 20 of a folder)."),
    ] = None,
    views: Annotated[
        int | None,
        typer.Option(
            min=4,
            max=720,
            metavar="N",
            help="Number of views of each object (default: enroll.views if it is set, or 36).",
        ),
    ] = None,
    change: Annotated[
        list[str] | None,
        typer.Option(
            "--change",
            metavar="NAME",
            help="Change the bench between enrollment and search: light (with exposure and white balance), placement, "
            "bench (both, with another table and wall), hard (all that rig eval hard-change changes), or the "
            "paper's noise: gn (variance 0.012), gn-sd (standard deviation 0.012), mb (motion blur; it needs --set "
            "view.min_sharpness=0). Repeatable.",
        ),
    ] = None,
    strategy: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Search strategy: dense, ahbr, ... (default: identify.strategy).",
        ),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option("--fault", metavar="NAME[@TIME]", help="Inject a fault: jam@move3+2s. See rig faults."),
    ] = None,
    no_empty_table: Annotated[
        bool, typer.Option("--no-empty-table", help="Take no empty-table images before the enrollment.")
    ] = False,
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for report.html.")] = Path("rig-demo"),
) -> None:
    """Enroll objects on the simulated bench, then identify each of them, and two objects that are not enrolled.

    The demo takes 36 views of each object, half as many as rig enroll; --views 72 takes as many. The exit code is 6 if
    fewer than 80 % of the answers are right.

    Example: rig demo --seed 7 --out /tmp/demo

    Example: rig demo --change light
    """
    from sim.change import Change
    from sim.demo.run import GOOD_SHARE, run_demo
    from sim.faults import Fault

    totals = run_demo(
        settings,
        objects=objects,
        count=count,
        views=views,
        out=out,
        strategy=strategy,
        change=Change.named(change or ()),
        faults=[Fault.parse(text) for text in fault or ()],
        empty_table=not no_empty_table,
    )
    if settings.json:
        settings.print_json(totals)
    right, of = totals["found"] + totals["unknown_recognised"], totals["of"] + totals["of_unknown"]
    if right < GOOD_SHARE * of:
        raise typer.Exit(EXIT_QUALITY)


@command
def faults(settings: Settings) -> None:
    """List the faults that the simulator can inject, with parameters, defaults and units.

    Example: rig faults; then rig demo --fault jam@move3+2s --fault crc_flip:rate=0.2
    """
    from sim.faults import fault_kinds
    from sim.faults.kind import NOTATION

    if settings.json:
        for kind in fault_kinds().values():
            settings.print_json(
                {
                    "fault": kind.name,
                    "what": kind.what,
                    "parameters": {n: {"default": p.default, "meaning": p.meaning} for n, p in kind.parameters.items()},
                }
            )
        return
    width = max(map(len, fault_kinds()))
    for kind in fault_kinds().values():
        typer.echo(f"{kind.name:<{width}}  {kind.what}")
        for name, parameter in kind.parameters.items():
            typer.echo(f"{'':<{width}}    {name}={parameter.default:g}  {parameter.meaning}")
    typer.echo(f"\nTo inject a fault: rig demo --fault {NOTATION}.")
    typer.echo('In rig.toml ([bench.sim]): faults = ["jam@move3+2s", "babble@20s+5s"]')
