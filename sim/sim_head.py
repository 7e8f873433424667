"""`rig sim-head`: a simulated rig head on a serial port."""

import sys
from contextlib import ExitStack
from typing import Annotated, Literal

import typer

from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings
from sim.sim_servo import Link, Seconds, create_link


@command
def sim_head(
    settings: Settings,
    kind: Annotated[
        Literal["memory", "avr"],
        typer.Option(
            help="memory: the firmware built for this computer; avr: the AVR binary in an emulated ATmega328P."
        ),
    ] = "memory",
    spin: Annotated[
        float, typer.Option(metavar="DPS", help="Rotate the platter at this speed, in degrees per second.")
    ] = 0.0,
    link: Link = None,
    seconds: Seconds = None,
) -> None:
    """Simulate a rig head with its IMU on a pseudo-terminal in real time, and print the port to connect to.

    Changes of its outputs are printed. Model and address of the IMU come from the section [imu].

    Example: rig sim-head --spin 30
    """
    from sim.devices import SimDevices
    from sim.head.realtime import HeadPty, PacedClock
    from sim.motion import to_velocity
    from sim.world import World

    config = settings.load()
    imu = config.imu.model_copy(update={"connection": "head"})
    config = config.model_copy(update={"imu": imu, "bench": {**config.bench, "sim": {"head": kind}}})
    world = World(seed=settings.seed or 0)
    with ExitStack() as ends:
        devices = ends.enter_context(SimDevices.connected(config, world))
        head = devices.head
        assert head is not None
        head.listeners.append(
            lambda change: print(f"{change.time_ns * 1e-9:.4f} s: {change.pin} {change.value:g}", file=sys.stderr)
        )
        if spin:
            world.drive(to_velocity(0.0, 0.0, spin, abs(spin), 100.0))
        terminal = HeadPty(head)
        ends.callback(terminal.close)
        create_link(link, terminal.port, ends)
        if settings.json:
            settings.print_json({"port": terminal.port, "kind": kind, "imu": config.imu.model})
        else:
            print(terminal.port, flush=True)
            where = f"--set imu.connection=head --set head.port={terminal.port}"
            print(f"{config.imu.model} on a rig head. Use it with {where}. Stop with Ctrl+C.", file=sys.stderr)
        clock = PacedClock(world.clock)
        while seconds is None or world.clock.now_ns() < seconds * 1e9:
            clock.sleep(0.01)
