"""Show the rig head, or store its serial number."""

from contextlib import closing
from typing import Annotated

import typer

from rig.cli.ui.command import Group
from rig.cli.ui.settings import Settings
from rig.devices.head.link import HeadLink, version
from rig.devices.head.protocol import BAUD, SERIAL_UNSET, Board

app = Group(__doc__)


@app.command("info")
def info(settings: Settings) -> None:
    """Show board, firmware and serial number of the rig head. Switches nothing.

    Example: rig head info --bench sim --set imu.connection=head
    """
    _show(settings, None)


@app.command("set-serial")
def set_serial(
    settings: Settings,
    serial: Annotated[int, typer.Argument(metavar="N", min=0, max=2**32 - 2, help="Serial number of this head.")],
) -> None:
    """Store the serial number that distinguishes this head from others. No program may use the head.

    Example: rig head set-serial 17 --bench sim --set imu.connection=head
    """
    _show(settings, serial)


def _show(settings: Settings, serial: int | None) -> None:
    """Store the serial number unless it is None, and print the head's identity."""
    with settings.open_parts() as context:
        context.require_free()
        port, clock = context.config.head.port, context.computer.clock
        with closing(context.computer.open_serial(port, BAUD, "head")) as connection:
            link = HeadLink(connection, clock, lambda _event: None, port)
            link.greet()
            if serial is not None:
                link.store_serial(serial)
    found = link.identity
    stored = None if found.serial == SERIAL_UNSET else found.serial
    board = Board(found.board).name.lower()
    report = {"port": port, "board": board, "firmware": version(found), "serial": stored}
    shown = "no serial number" if stored is None else f"serial number {stored}"
    settings.say(f"{port}: rig head on {board}, firmware {version(found)}, {shown}", report)
