"""`rig goto`, `rig home`, `rig status`, `rig stop` and `rig acknowledge`."""

from typing import Annotated

import typer

from rig.cli.bench.findings import doctor_context
from rig.cli.ui.command import command
from rig.cli.ui.exit_codes import EXIT_DECLINED
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock
from rig.core.errors import DeviceMismatch, DeviceNotFound, DeviceSilent, UsageError


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
    desk.run(goto_job(desk, angle_deg))


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

    Example: rig home --revolutions 0 --bench sim
    """
    from rig.cli.ui.desk import CommandDesk
    from rig.jobs.table import home as home_job
    from rig.jobs.table import refer

    if here and revolutions is not None:
        raise UsageError("--here and --revolutions cannot be combined.", next_step="Give one of them.")
    desk = CommandDesk(settings, yes=yes)
    if not desk.run(refer(desk, here=True) if here else home_job(desk, revolutions=revolutions)) and not here:
        raise typer.Exit(EXIT_DECLINED)


@command
def status(settings: Settings) -> None:
    """Show the state of the bench and its devices, even if some of them are missing. Moves nothing.

    Example: rig status --bench sim --json
    """
    from rig.cli.bench.bench_report import report_lines, report_of, report_of_server, report_without_servo
    from rig.safety.saved_state import server_address

    if server := server_address(settings.load().state_path(settings.bench_name)):
        report = report_of_server(server)
    else:
        try:
            bench = settings.open_bench(tell=False, devices=())
        except (DeviceNotFound, DeviceMismatch, DeviceSilent) as missing:
            with doctor_context(settings) as context:
                report = report_without_servo(context, missing)
        else:
            with bench:
                report = report_of(bench)
    settings.say("\n".join(report_lines(report)), report)
    for device in ("servo", "imu", "camera"):  # the exit code is that of the first device that does not work
        if error := report.get(device, {}).get("error"):
            raise typer.Exit(error["code"] // 100)


@command
def stop(settings: Settings) -> None:
    """Stop the table and switch its torque off, even if another program moves it. Its plan ends and can be resumed.

    Example: rig stop --bench sim
    """
    from rig.motion.stop_request import stop as stop_bench

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
    desk.run(acknowledge_job(desk, reboot=reboot))
