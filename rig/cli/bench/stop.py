"""`rig stop`, which imports little: an operator waits for it."""

from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock
from rig.jobs.stop import stop as stop_bench


@command
def stop(settings: Settings) -> None:
    """Stop the table and switch its torque off, even if another program moves it. Its plan ends and can be resumed.

    Example: rig stop --bench sim
    """
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
