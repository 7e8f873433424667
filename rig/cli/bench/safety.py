"""`rig stop` and `rig acknowledge`."""

from typing import Annotated

import typer

from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock


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
