"""`rig jog`."""

import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rig.cli.ui.command import command
from rig.cli.ui.keys import read_keys
from rig.cli.ui.settings import Settings
from rig.core.errors import UsageError
from rig.core.next_steps import Do

if TYPE_CHECKING:
    from rig.events.events import Event
    from rig.plans.jog import JogKey

_WAIT_S: Final = 0.2
_KEYS: Final = {
    b"\x1b[C": "forward",
    b"\x1bOC": "forward",
    b"\x1b[D": "back",
    b"\x1bOD": "back",
    b"\x1b[A": "larger-step",
    b"\x1bOA": "larger-step",
    b"\x1b[B": "smaller-step",
    b"\x1bOB": "smaller-step",
    b"h": "home",
    b"q": "end",
}
"""The bytes that a terminal sends for each key; cursor keys have two forms."""


@command
def jog(
    settings: Settings,
    step: Annotated[float, typer.Option(metavar="DEGREES", help="First step.")] = 5.0,
) -> None:
    """Rotate the table with the arrow keys: right is counter-clockwise, left is clockwise.

    Up and down change the step. h rotates to home. q ends. Ctrl+C stops a rotation at once. Keys that you press during
    a rotation have no effect. At the end the torque is off.

    Example: rig jog --step 1 --bench sim
    """
    from rig.cli.ui.desk import CommandDesk
    from rig.events.events import event_dict
    from rig.events.lines import line
    from rig.jobs.table import jog as jog_job

    if not sys.stdin.isatty():
        raise UsageError("rig jog needs a terminal.", next_step=("In scripts,", Do.GOTO()))

    def show(event: "Event") -> None:
        termios.tcflush(sys.stdin, termios.TCIFLUSH)  # a key held down must not rotate the table after its end
        settings.say(line(event), event_dict(event))

    desk = CommandDesk(settings)
    with _keys_at_once():
        desk.run(jog_job(desk, _pressed(step), step_deg=step), show)
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


def _pressed(step: float) -> "Iterator[JogKey | None]":
    """Show the keys, and yield those that are pressed, or None while there is none; end with the terminal."""
    from rig.plans.jog import JogKey

    print(f"→ +{step:g}°   ← −{step:g}°   ↑ ↓ step   h home   q end   Ctrl+C stop", file=sys.stderr)
    while (keys := read_keys(_WAIT_S)) is not None:
        yield next((JogKey(name) for code, name in _KEYS.items() if keys.startswith(code)), None)
