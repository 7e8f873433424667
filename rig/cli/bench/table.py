"""`rig goto`, `rig home`, `rig jog`, `rig status`, `rig stop` and `rig acknowledge`."""

import os
import select
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from rig.cli.bench.doctor import doctor_context
from rig.cli.ui.command import command
from rig.cli.ui.exit_codes import EXIT_DECLINED
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock
from rig.core.errors import UsageError
from rig.core.next_steps import Do

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rig.events.events import Event
    from rig.jobs.table import JogKey


_UNSHOWN: Final = ("_ns", "_number", "who_am_i", "_rthz", "trajectory_deg", "trajectory_dps")
"""Ends of the keys that `rig status` prints with --json only."""


@command
def goto(
    settings: Settings,
    angle_deg: Annotated[float, typer.Argument(metavar="ANGLE", help="Table angle in degrees, counter-clockwise.")],
) -> None:
    """Rotate the table to an angle, and print the rotation by encoder and IMU.

    Example: rig goto -90 --bench sim
    """
    from rig.cli.ui.desk import CommandDesk
    from rig.jobs.table import goto as goto_job

    desk = CommandDesk(settings)
    desk.run("goto", goto_job(desk, angle_deg))


@command
def home(
    settings: Settings,
    revolutions: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=-250,
            max=250,
            help="Revolutions by which the cable is wound up; 0 if it hangs free.",
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
    from rig.cli.ui.desk import CommandDesk
    from rig.jobs.table import home as home_job
    from rig.jobs.table import refer

    if here and revolutions is not None:
        raise UsageError("--here and --revolutions cannot be combined.", next_step="Give one of them.")
    desk = CommandDesk(settings, yes=yes)
    job = refer(desk, here=True) if here else home_job(desk, revolutions=revolutions)
    if not desk.run("reference" if here else "home", job) and not here:
        raise typer.Exit(EXIT_DECLINED)


@command
def status(settings: Settings) -> None:
    """Show the state of the bench and its devices, even if some of them are missing. Moves nothing.

    Example: rig status --bench sim --json
    """
    from rig.jobs.status import bench_report

    report = bench_report(
        settings.load().state_path(settings.bench_name),
        partial(settings.open_bench, tell=False, devices=()),
        partial(doctor_context, settings),
    )
    settings.say("\n".join(_report_lines(report)), report)
    for device in ("servo", "imu", "camera"):  # the exit code is that of the first device that does not work
        if error := report.get(device, {}).get("error"):
            raise typer.Exit(error["code"] // 100)


def _report_lines(report: "Mapping[str, Any]") -> Iterator[str]:
    """Yield a report in lines; of a bench that a server uses, without its devices."""
    from rig.core.next_steps import in_words, steps_from_json
    from rig.core.phrases import angle_words, budget_words

    page, is_open = report.get("page"), "state" in report
    yield f"bench    {report['bench']}{f', served at {page}' if page else '' if is_open else ': not open'}"
    if is_open or page:
        yield f"state    {_state_words(report)}"
    if problem := report.get("error"):
        yield f"error    {problem['code']}: {problem['detail']}"
        yield f"         Next step: {problem['next_step']}"
    if limits_deg := report.get("limits_deg"):
        angle_deg = report.get("table_deg")
        angle = "angle in doubt" if angle_deg is None else angle_words(angle_deg, 2)
        yield f"table    {angle}; cable budget {budget_words(tuple(limits_deg))}"
    if page:
        yield f"job      {report.get('job') or 'none'}"
        return
    for device in ("servo", "imu", "head", "camera"):
        if values := report.get(device):
            error = values.get("error")
            failed = error and [f"error {error['code']}: {error['detail']}", f"Next step: {error['next_step']}"]
            yield from (f"{'' if n else device:8s} {line}" for n, line in enumerate(failed or _device_lines(values)))
    yield from (f"note     {finding}" for finding in report.get("findings", ()))
    if not report.get("fault") and not report.get("doubt") and (steps := report.get("steps")):
        yield f"         {in_words(steps_from_json(steps))}"


def _state_words(report: "Mapping[str, Any]") -> str:
    state, fault, doubt = report.get("state", "not open"), report.get("fault"), report.get("doubt")
    if fault is not None:
        return f"{state} {fault['code']} since {fault['utc']}: {fault['detail']} {fault['next_step']}"
    return f"{state}: {doubt} (`rig home --help`)" if doubt else str(state)


def _device_lines(values: "Mapping[str, Any]") -> Iterator[str]:
    """Yield the values of a device, and in further lines those of its parts: "load 3 %, voltage 12 V"."""
    from rig.config.wording import unit
    from rig.core.phrases import in_unit, number

    parts = {name: part for name, part in values.items() if isinstance(part, dict)}
    for name, part in ({"": {key: value for key, value in values.items() if key not in parts}} | parts).items():
        shown = []
        for key, value in part.items():
            if (
                key.endswith(_UNSHOWN)
                or value is None
                or value is False
                or (value == 0 and name in ("bus", "connection"))
            ):
                continue
            of, suffix = unit(key), f"_{key.rpartition('_')[2]}"
            words = key.removesuffix(suffix if of else "").replace("_", " ")
            if isinstance(value, list):
                words += f" {', '.join(map(str, value)) or 'none'}"
            elif isinstance(value, float):
                words += f" {in_unit(number(value, '.5g'), of)}"
            elif key.endswith("address"):
                words += f" {value:#04x}"
            elif value is not True:
                words += f" {in_unit(str(value), of)}"
            shown.append(words)
        yield f"{name}: {', '.join(shown) or 'none yet'}" if name else ", ".join(shown)


@command
def stop(settings: Settings) -> None:
    """Stop the table and switch its torque off, even if another program moves it. Its plan ends and can be resumed.

    Example: rig stop --bench sim
    """
    from rig.jobs.stop import stop as stop_bench

    done = stop_bench(settings.bench_name, settings.load(), SystemClock(), seed=settings.seed)
    who = done.holder
    if who is None:
        text = f"No program held the bench; the torque was {'on, and is off now' if done.torque_was_on else 'off'}."
    elif done.ended:
        text = f"Process {who.pid} (`{who.command}`) has ended: the table is stopped, its torque off."
    else:
        text = f"Process {who.pid} (`{who.command}`) has stopped the table and its torque; it still holds the bench."
    report = {"bench": settings.bench_name, "pid": who.pid if who else None, "ended": done.ended}
    settings.say(text, {**report, "torque_was_on": done.torque_was_on})


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
    from rig.cli.ui.desk import CommandDesk
    from rig.jobs.table import acknowledge as acknowledge_job

    desk = CommandDesk(settings)
    desk.run("acknowledge", acknowledge_job(desk, reboot=reboot))


# longer: the shown angle is behind the table; shorter: the servo is asked more often than the eye needs
_WAIT_S: Final = 0.2
_KEYS: Final = {
    b"\x1b[C": "forward",
    b"\x1b[D": "back",
    b"\x1b[A": "larger-step",
    b"\x1b[B": "smaller-step",
    b"h": "home",
    b"q": "end",
}
"""The bytes that a terminal sends for each key."""


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
    from rig.events.wording import line
    from rig.jobs.table import jog as jog_job

    if not sys.stdin.isatty():
        raise UsageError("rig jog needs a terminal.", next_step=("In scripts,", Do.GOTO()))

    def show(event: "Event") -> None:
        termios.tcflush(sys.stdin, termios.TCIFLUSH)  # a key held down must not rotate the table after its end
        settings.say(line(event), event_dict(event))

    desk = CommandDesk(settings)
    with _keys_at_once():
        desk.run("jog", jog_job(desk, _pressed(step), step_deg=step), show)
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
    from rig.jobs.table import JogKey

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
        yield next((JogKey(name) for code, name in _KEYS.items() if keys.startswith(code)), None)
