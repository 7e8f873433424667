"""`rig faults`: the list of simulated faults."""

import typer

from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings


@command
def faults(settings: Settings) -> None:
    """List the faults that the simulator can inject, with parameters, defaults and units.

    Example: rig faults; then rig demo --fault jam@move3+2s --fault crc_flip:rate=0.2
    """
    from sim.faults import fault_kinds
    from sim.faults.schedule import NOTATION

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
    typer.echo('In a file (--faults FILE) or in rig.toml ([bench.sim]): faults = ["jam@move3+2s", "babble@20s+5s"]')
