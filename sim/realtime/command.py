"""`rig sim-bench`: a simulated bench in real time, for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings


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
    seconds: Annotated[float | None, typer.Option(min=0, help="Stop after this time (default: until Ctrl+C).")] = None,
) -> None:
    """Run a simulated bench in real time: servo, IMU, camera and table of one world, for several programs at once.

    Its folder has a rig.toml, so each `rig` command in that folder uses the bench. It starts with the configuration in
    force. Tell it what happens, such as `put mug-white` or `jam`, by this command in another terminal.

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
