"""`rig replay` and `rig report`: read what `rig identify --save-run` has saved, and what the bench keeps of moves."""

from pathlib import Path
from typing import Annotated, Final

import typer

from rig.cli.ui.command import command
from rig.cli.ui.live import LiveView
from rig.cli.ui.present import first
from rig.cli.ui.settings import Settings
from rig.core.errors import ReplayMismatch, UsageError
from rig.core.json_form import plain
from rig.core.next_steps import Do
from rig.core.phrases import counted, short
from rig.events.wording import problem_line
from rig.motion.traces import stored
from rig.report import write_report
from rig.report.motion import motion_report
from rig.report.report import run_report
from rig.safety.saved_state import FileStore
from rig.search.replay import confirm
from rig.search.saved_run import load_run

RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a saved run.")]
SHOWN: Final = 3
"""Differences that an error lists without --json."""


@command
def replay(
    settings: Settings,
    run: RunArgument,
    check: Annotated[
        bool, typer.Option("--check", help="Compute every decision again from the images; exit code 6 if one differs.")
    ] = False,
) -> None:
    """Show a saved run again: each view, the candidates after it, and each decision.

    Example: rig replay runs/1 --check
    """
    saved = load_run(run)
    if check:
        try:
            found = confirm(saved)
        except ReplayMismatch as error:
            if not settings.json:
                error.evidence["differences"] = first([short(one, 120) for one in error.evidence["differences"]], SHOWN)
            raise
        settings.say(f"{found} All are as saved.", plain(found))
        return

    if not settings.json:
        about, objects = saved.about, counted(len(saved.views.object_names), "enrolled object")
        print(f"Bench {about.bench}, {about.started_utc:%Y-%m-%d %H:%M} UTC, {objects}")
    with saved.damage(), LiveView(settings, plain=True) as view:
        for event in saved.events():
            view.add(event)
    if saved.error and not settings.json:
        print(problem_line(saved.error))


@command
def report(
    settings: Settings,
    run: Annotated[Path | None, typer.Argument(metavar="RUN", help="Folder of a saved run.")] = None,
    motion: Annotated[bool, typer.Option("--motion", help="Draw the last moves of the table instead.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File to write (default: report.html in the run's folder, or motion.html)."),
    ] = None,
) -> None:
    """Write an HTML page about a saved run: the answer, the camera's path, the scores, the views and the decisions.

    With --motion, the page shows the last moves of the table: angle, rate, ringing and load.

    Example: rig report runs/1 --out run-1.html
    """
    if motion == (run is not None):
        raise UsageError("One report at a time is written.", next_step="Give the folder of a saved run, or --motion.")
    if run is None:
        page, path = _motion(settings), out or Path("motion.html")
    else:
        page, path = run_report(load_run(run)), out or run / "report.html"
    write_report(path, page)
    settings.say(f"Report: {path}", {"report": str(path)})


def _motion(settings: Settings) -> str:
    """Return the page about the last moves of the bench, which may be in use."""
    config, bench = settings.load(), settings.bench_name
    moves = stored(FileStore(config.state_path(bench)))
    if not moves:
        raise UsageError(
            f"The bench {bench} has stored no move yet.",
            next_step=(Do.GOTO(), "A simulated bench stores its moves if state_dir is set."),
        )
    return motion_report(moves, bench=bench, quiet_dps=config.table.quiet_dps)
