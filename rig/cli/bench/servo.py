"""Change the settings, the id and the baud rate of the servo, and record a trace."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from rig.bench.bench import set_key
from rig.cli.ui.command import Group
from rig.cli.ui.desk import CommandDesk
from rig.cli.ui.exit_codes import EXIT_DEVICE
from rig.cli.ui.options import YesOption
from rig.cli.ui.present import first, show_progress
from rig.cli.ui.prompts import confirm
from rig.cli.ui.settings import Settings
from rig.config.values import default_path
from rig.core.errors import ReplayMismatch
from rig.core.next_steps import Do
from rig.core.phrases import counted
from rig.devices.dynamixel import settings as servo_settings
from rig.devices.trace import read_trace
from rig.doctor.examination import open_context
from rig.doctor.replay import replay_devices, replay_drivers
from rig.doctor.servo_scan import SingleServo, single_servo
from rig.jobs.trace import REACH_DEG
from rig.jobs.trace import record as record_job

app = Group(__doc__)
SHOWN: Final = 8
"""Differences that an error lists without --json."""


@app.command("settings")
def settings_(
    settings: Settings,
    write: Annotated[
        bool, typer.Option("--write", help="Write the differing settings with the torque off, and verify them.")
    ] = False,
    yes: YesOption = False,
) -> None:
    """Compare the servo's permanent settings (EEPROM) with the required ones. Exit code 4 if they differ.

    Example: rig servo settings --write --bench sim
    """
    show_progress("searching for the servo ...")
    with settings.open_parts() as context, single_servo(context) as servo:
        show_progress("")
        differences = servo_settings.compare(servo.bus, servo.found.bus_id, servo.table, context.config.table.mode)
        if not settings.json:
            print(servo.found)
            print("\n".join(f"  {difference}" for difference in differences) or "  all as required")
        if written := bool(differences) and write:
            confirm("Write these settings?", yes=yes, settings=settings)
            servo_settings.write(servo.bus, servo.found.bus_id, servo.table, differences)
    if settings.json:
        rows = [{"register": d.register, "found": d.found, "wanted": d.wanted, "reason": d.reason} for d in differences]
        settings.print_json({**_identity(servo), "differences": rows, "written": written})
    elif written:
        print("Written and verified.")
    elif differences:
        print(f"To write them: {context.step(Do.SERVO_SETTINGS()).command}")
    if differences and not written:
        raise typer.Exit(EXIT_DEVICE)


@app.command("set-id")
def set_id(
    settings: Settings,
    new: Annotated[int, typer.Argument(metavar="ID", min=0, max=252, help="New id.")],
    yes: YesOption = False,
) -> None:
    """Change the id of the only servo on the bus, with its torque off, and verify it. Updates rig.toml.

    Example: rig servo set-id 2 --bench sim --yes
    """
    _change(settings, "id", new, yes)


@app.command("set-baud")
def set_baud(
    settings: Settings,
    rate: Annotated[int, typer.Argument(metavar="RATE", min=1, help="New baud rate, for example 1000000.")],
    yes: YesOption = False,
) -> None:
    """Change the baud rate of the only servo on the bus, with its torque off, and verify it. Updates rig.toml.

    Example: rig servo set-baud 1000000 --bench sim --yes
    """
    _change(settings, "baud", rate, yes)


@app.command("record")
def record(
    settings: Settings,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="New file for the trace.")],
    still: Annotated[bool, typer.Option("--still", help="Move nothing.")] = False,
    yes: YesOption = False,
) -> None:
    """Record what servo, IMU and camera send while the table rotates a little: to compare the simulated ones with them.

    The table rotates by up to 45° and back, within its limits, and stops once on its way.

    Example: rig servo record servo.jsonl --bench sim --yes
    """
    if not still:
        confirm(f"The table rotates by up to {REACH_DEG:.0f}° and back.", yes=yes, settings=settings)
    # The adapter delays replies, so the trace says which one it is.
    with settings.open_parts() as context:
        port = context.computer.serial_port(context.config.servo.port)
    adapter: dict[str, Any] = {key: port.usb.get(key) for key in ("idVendor", "idProduct")} if port else {}
    adapter["latency_ms"] = port.latency_ms if port else None
    desk = CommandDesk(settings.tracing(file))
    desk.run("record", record_job(desk, still=still, adapter=adapter))


@app.command("replay")
def replay_(
    settings: Settings, file: Annotated[Path, typer.Argument(metavar="FILE", help="Trace from rig servo record.")]
) -> None:
    """Compare a trace with the drivers and with the simulated devices. Exit code 6 if something differs.

    Example: rig servo replay servo.jsonl
    """
    trace = read_trace(file)
    # The sensor of a rig head is not compared, and the head would switch the servo's supply.
    sensor = trace.config.imu.model_copy(update={"connection": "i2c"})
    config = trace.config.model_copy(update={"bench": settings.load().bench, "imu": sensor})
    with open_context("sim", config, seed=settings.seed) as context:
        simulated = replay_devices(trace, context.computer)
    # Once with the drivers on the recorded bytes, and once with the recorded requests on the simulated devices.
    results = {"driver": replay_drivers(trace).as_dict(), "simulator": simulated.as_dict()}
    values = {"bench": trace.header.bench, "software": trace.header.software, "is_cut": trace.is_cut, **results}
    lines = ["Its last line is cut off: the recording was interrupted."] * trace.is_cut
    if times := results["simulator"]["reply_ms"]:
        was, now = times["recorded"]["median"], times["now"]["median"]
        lines.append(f"Replies of the servo: after {was:.1f} ms, of the simulated one after {now:.1f} ms.")
    found = [f"{name}: {one}" for name, result in results.items() for one in result["differences"]]
    if found:
        raise ReplayMismatch(
            " ".join([f"The trace {file} differs in {counted(len(found), 'field')}.", *lines]),
            next_step="If a real device sent it, correct its driver or its simulation, or send the trace to us.",
            evidence=values if settings.json else {"differences": first(found, SHOWN)},
        )
    counts = [f"{counted(result['compared'], 'value')} against the {name}" for name, result in results.items()]
    settings.say("\n".join([f"No difference: {', '.join(counts)}.", *lines]), values)


def _change(settings: Settings, what: str, new: int, yes: bool) -> None:
    """Change id or baud rate of the servo, and in the configuration file if that has the old value."""
    show_progress("searching for the servo ...")
    with settings.open_parts() as context, single_servo(context) as servo:
        show_progress("")
        old = servo.found.bus_id if what == "id" else servo.found.baud
        if old != new:
            question = f"{servo.found}: change {what} from {old} to {new}, with the torque off?"
            confirm(question, yes=yes, settings=settings)
            change = servo.set_id if what == "id" else servo.set_baud
            change(new)
    text = f"The servo has {what} {new} already." if old == new else f"Changed {what} to {new}, and verified it."
    configured, path, followed = getattr(context.config.servo, what), settings.config or default_path(), None
    if path is not None and path.exists() and configured == old != new:
        set_key(path, f"servo.{what}", str(new))
        text, followed = f"{text}\n{path}: servo.{what} = {new}", str(path)
    elif configured != new:
        text += f"\nTo use it: {context.step(Do.SET_KEY(key=f'servo.{what}', value=new)).command}"
    settings.say(text, {**_identity(servo), what: new, "was": old, "config_changed": followed})


def _identity(servo: SingleServo) -> dict[str, Any]:
    return {key.removeprefix("bus_"): value for key, value in asdict(servo.found).items()}
