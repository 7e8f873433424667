"""`rig sim-servo`: simulated servos on a serial port."""

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings
from rig.core.errors import UsageError

Link = Annotated[Path | None, typer.Option(metavar="PATH", help="Create this link to the port while the program runs.")]
Seconds = Annotated[float | None, typer.Option(min=0, help="Stop after this time. Default: until Ctrl+C.")]


def create_link(link: Path | None, port: str, ends: ExitStack) -> None:
    """Create a link to a port, and remove it at the end of ``ends``. Raises `UsageError` if that is not possible."""
    if link is not None:
        try:
            link.symlink_to(port)
        except OSError as error:
            step = "Give a name that is not in use."
            raise UsageError(f"Cannot create {link}: {error.strerror}.", next_step=step) from error
        ends.callback(link.unlink, missing_ok=True)


@command
def sim_servo(
    settings: Settings,
    ids: Annotated[
        list[int] | None, typer.Option("--id", min=0, max=252, help="Id of a servo. Repeatable. Default: servo.id.")
    ] = None,
    link: Link = None,
    seconds: Seconds = None,
) -> None:
    """Simulate servos on a pseudo-terminal in real time, and print the port to connect to.

    Model, id and gear ratio come from the section [servo]. The port accepts any baud rate.

    Example: rig sim-servo --set servo.model=xm430_w350 --id 1 --id 2
    """
    from rig.core.clock import SystemClock
    from sim.servo import ServoBus
    from sim.servo.configured import simulated_servo
    from sim.servo.terminal import ServoTerminal
    from sim.world import World

    config = settings.load()
    wanted = sorted(set(ids or [config.servo.id]))
    bus: ServoBus | None = None
    for bus_id in wanted:
        world = World(seed=(settings.seed or 0) + bus_id, clock=bus.clock if bus else None)
        bus = bus or ServoBus(world.clock)
        bus.attach(simulated_servo(world, config.servo.model_copy(update={"id": bus_id})))
    assert bus is not None
    with ExitStack() as ends:
        terminal = ends.enter_context(ServoTerminal(bus, config.servo.baud, SystemClock()))
        port = terminal.port
        create_link(link, port, ends)
        if settings.json:
            settings.print_json({"port": port, "model": config.servo.model, "ids": wanted})
        else:
            print(port, flush=True)
            what = f"{config.servo.model}, id {', '.join(map(str, wanted))}"
            print(f"{what}. Use it with --set servo.port={port}. Stop with Ctrl+C.", file=sys.stderr)
        terminal.serve(seconds)
