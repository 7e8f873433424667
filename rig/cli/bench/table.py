"""`rig goto`, `rig home`, `rig jog`, `rig acknowledge` and `rig empty-table`."""

import os
import select
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Annotated, Final

import typer

from rig.cli.ui.command import command
from rig.cli.ui.desk import CommandDesk
from rig.cli.ui.exit_codes import EXIT_DECLINED
from rig.cli.ui.settings import Settings
from rig.core.errors import UsageError
from rig.core.next_steps import Do
from rig.events.events import Event, event_dict
from rig.events.wording import line
from rig.jobs import table
from rig.jobs.table import JogKey
from rig.jobs.table_image import take_table_image


@command
def goto(
    settings: Settings,
    angle_deg: Annotated[float, typer.Argument(metavar="ANGLE", help="Table angle in degrees, counter-clockwise.")],
) -> None:
    """Rotate the table to an angle, and print the rotation by encoder and IMU.

    Example: rig goto -90 --bench sim
    """
    desk = CommandDesk(settings)
    desk.run("goto", table.goto(desk, angle_deg))


@command
def home(
    settings: Settings,
    revolutions: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=-250, max=250, help="Revolutions that the cable is wound up; 0 if it hangs free."
        ),
    ] = None,
    here: Annotated[bool, typer.Option("--here", help="Make the present angle home. Moves nothing.")] = False,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Rotate more than half a revolution without asking.")
    ] = False,
) -> None:
    """Rotate the table to home (0°). If its revolutions are in doubt, look at the cable and give --revolutions.

    With a calibrated home mark, the camera sees the angle within the revolution: you only confirm the revolution.

    Example: rig home --revolutions 0 --bench sim
    """
    if here and revolutions is not None:
        raise UsageError("--here and --revolutions cannot be combined.", next_step="Give one of them.")
    desk = CommandDesk(settings, yes=yes)
    job = table.refer(desk, here=True) if here else table.home(desk, revolutions=revolutions)
    if not desk.run("reference" if here else "home", job) and not here:
        raise typer.Exit(EXIT_DECLINED)


@command
def acknowledge(
    settings: Settings,
    reboot: Annotated[
        bool, typer.Option("--reboot", help="Restart the servo first. This clears its hardware errors.")
    ] = False,
) -> None:
    """Acknowledge a latched fault.

    Servo, supply, settings and angle are checked first. A fault stays latched while its cause lasts.

    Example: rig acknowledge --reboot --bench sim
    """
    desk = CommandDesk(settings)
    desk.run("acknowledge", table.acknowledge(desk, reboot=reboot))


@command
def empty_table(
    settings: Settings,
    anyway: Annotated[
        bool,
        typer.Option("--anyway", help="Store the image although something on the table rotates: a pattern or a screw."),
    ] = False,
) -> None:
    """Take an image of the empty table. Do this once a day, and when the light has changed.

    Objects are found by comparing views with this image. First take everything off the table. The table rotates a
    little to check that it is empty. If the check fails, the previous image stays in use. A camera that moves around
    the object takes an image at each azimuth of enroll.views; no check then finds a forgotten object.

    Example: rig empty-table --bench sim
    """
    desk = CommandDesk(settings)
    desk.run("empty-table", take_table_image(desk, anyway=anyway))


# longer: the shown angle is behind the table; shorter: the servo is asked more often than the eye needs
_WAIT_S: Final = 0.2
_KEYS: Final = {
    b"\x1b[C": JogKey.FORWARD,
    b"\x1b[D": JogKey.BACK,
    b"\x1b[A": JogKey.LARGER_STEP,
    b"\x1b[B": JogKey.SMALLER_STEP,
    b"h": JogKey.HOME,
    b"q": JogKey.END,
}
"""The bytes that a terminal sends for each key."""


@command
def jog(settings: Settings, step: Annotated[float, typer.Option(metavar="DEGREES", help="First step.")] = 5.0) -> None:
    """Rotate the table with the arrow keys: right is counter-clockwise, left is clockwise.

    Up and down change the step. h rotates to home. q ends. Ctrl+C stops a rotation at once. Keys that you press during
    a rotation have no effect. At the end the torque is off.

    Example: rig jog --step 1 --bench sim
    """
    if not sys.stdin.isatty():
        raise UsageError("rig jog needs a terminal.", next_step=("In scripts,", Do.GOTO()))

    def show(event: Event) -> None:
        termios.tcflush(sys.stdin, termios.TCIFLUSH)  # a key held down must not rotate the table after its end
        settings.say(line(event), event_dict(event))

    desk = CommandDesk(settings)
    with _keys_at_once():
        desk.run("jog", table.jog(desk, _pressed(step), step_deg=step), show)
    print("The torque is off. To make this angle home: rig home --here", file=sys.stderr)


@contextmanager
def _keys_at_once() -> Iterator[None]:
    """Let the terminal deliver each key at once, and restore it at the end."""
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield
    finally:
        with suppress(termios.error):  # the terminal is gone
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def _pressed(step: float) -> Iterator[JogKey | None]:
    """Show the keys, and yield those that are pressed, or None while there is none; end with the terminal."""
    print(f"→ +{step:g}°   ← −{step:g}°   ↑ ↓ step   h home   q end   Ctrl+C stop", file=sys.stderr)
    while True:
        keys = b""
        if select.select([sys.stdin], [], [], _WAIT_S)[0]:
            try:
                keys = os.read(sys.stdin.fileno(), 64)
            except OSError:
                keys = b""
            if not keys:  # the terminal is gone
                return
        # in the other mode of the cursor keys, O replaces the bracket
        keys = keys.replace(b"\x1bO", b"\x1b[")
        yield next((key for code, key in _KEYS.items() if keys.startswith(code)), None)
