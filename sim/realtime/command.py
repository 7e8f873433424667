"""`rig sim-bench`, `rig sim-servo` and `rig sim-head`: simulated devices in real time, for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings

Link = Annotated[Path | None, typer.Option(metavar="PATH", help="Create this link to the port while the program runs.")]
Seconds = Annotated[float | None, typer.Option(min=0, help="Stop after this time (default: until Ctrl+C).")]


@command
def sim_bench(
    settings: Settings,
    words: Annotated[
        list[str] | None,
        typer.Argument(metavar="[WORD]...", help="Tell a running bench what happens: put mug-white, jam, help, ..."),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Folder of the bench (default: sim-bench, or that of rig.toml)."),
    ] = None,
    seconds: Seconds = None,
) -> None:
    """Run a simulated bench in real time: servo, IMU, camera and table of one world, for several programs at once.

    Its folder has a rig.toml, so each `rig` command in that folder uses the bench. It starts with the configuration in
    force. Type commands such as `put mug-white` or `jam` into its terminal, or give them as arguments
    of this command in another terminal.

    Example: rig sim-bench; in a second terminal: cd sim-bench; rig sim-bench put mug-white; rig goto 90; rig stop
    """
    known = settings.load().bench.get("sim-bench", {}).get("folder")
    folder = folder or (Path(str(known)) if known else None)
    if words:
        from sim.realtime.wire import DEFAULT_FOLDER, send_command

        answer = send_command((folder or DEFAULT_FOLDER).absolute(), *words)
        settings.say(answer["text"], answer)
        return
    from sim.realtime.run import run_bench

    run_bench(settings, folder, seconds)


@command
def sim_servo(
    settings: Settings,
    ids: Annotated[
        list[int] | None, typer.Option("--id", min=0, max=252, help="Id of a servo. Repeatable (default: servo.id).")
    ] = None,
    link: Link = None,
    seconds: Seconds = None,
) -> None:
    """Simulate servos on a pseudo-terminal in real time, and print the port to connect to.

    Model, id and gear ratio come from the section [servo]. The port accepts any baud rate.

    Example: rig sim-servo --set servo.model=xm430_w350 --id 1 --id 2
    """
    from sim.realtime.run import run_servos

    run_servos(settings, ids, link, seconds)


@command
def sim_head(
    settings: Settings,
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
    from sim.realtime.run import run_head

    run_head(settings, spin, link, seconds)
