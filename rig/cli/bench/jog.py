"""`rig jog`."""

import os
import select
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings
from rig.core.errors import RigError, UsageError

if TYPE_CHECKING:
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
    from rig.catalog import Action
    from rig.events.events import event_dict
    from rig.events.lines import line
    from rig.plans.jog import jog as jog_table

    if not sys.stdin.isatty():
        raise UsageError("rig jog needs a terminal.", next_step="Use `rig goto ANGLE` in scripts.")
    angle_deg = None
    with settings.open_bench(devices=("imu",)) as bench, _keys_at_once():
        print(f"→ +{step:g}°   ← −{step:g}°   ↑ ↓ step   h home   q end   Ctrl+C stop", file=sys.stderr)
        events = jog_table(bench, _pressed(), step_deg=step)
        try:
            for event in events:
                if isinstance(event, float):
                    print(f"step {event:g}°", file=sys.stderr, flush=True)
                    continue
                termios.tcflush(sys.stdin, termios.TCIFLUSH)  # a key held down must not rotate the table after its end
                settings.say(line(event), event_dict(event))
                angle_deg = getattr(event, "encoder_deg", angle_deg)
        except RigError as error:
            settings.note(Action.MOVED, to_deg=angle_deg, ended=error.what)
            raise
        finally:
            events.close()
    if angle_deg is not None:
        settings.note(Action.MOVED, to_deg=angle_deg)
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


def _pressed() -> "Iterator[JogKey | None]":
    """Yield the keys that are pressed, and None while there is none; end with the terminal."""
    from rig.plans.jog import JogKey

    while True:
        if not select.select([sys.stdin], [], [], _WAIT_S)[0]:
            yield None
            continue
        try:
            data = os.read(sys.stdin.fileno(), 64)
        except OSError:  # the terminal is gone
            return
        if not data:
            return
        yield next((JogKey(name) for code, name in _KEYS.items() if data.startswith(code)), None)
