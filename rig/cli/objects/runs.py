"""`rig replay` and `rig report`: read what `rig identify --save-run` has saved, and what the bench keeps of moves."""

from pathlib import Path
from typing import Annotated, Final

import typer

from rig.cli.ui.command import command
from rig.cli.ui.live import LiveView
from rig.cli.ui.present import first
from rig.cli.ui.settings import Settings
from rig.core.errors import ReplayMismatch, RunIncomplete, UsageError
from rig.core.json_form import plain
from rig.core.next_steps import Do
from rig.core.phrases import counted, short
from rig.events.wording import problem_line
from rig.motion.traces import stored
from rig.report import write_report
from rig.report.motion import motion_report
from rig.report.report import run_report
from rig.safety.saved_state import FileStore
from rig.search.replay import check as check_run
from rig.search.saved_run import SavedRun, load_run

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
        _check(settings, saved)
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


def _check(settings: Settings, saved: SavedRun) -> None:
    with saved.damage():
        found = check_run(saved)
    done = f"Computed again: {counted(found.views, 'descriptor')} and {counted(found.decisions, 'decision')}."
    if found.differences:
        listed = [str(one) for one in found.differences]
        if not settings.json:
            listed = first([short(one, 120) for one in listed], SHOWN)
        raise ReplayMismatch(
            f"{counted(len(found.differences), 'number')} in the saved run differ from the computed ones. {done}",
            next_step="Check whether the files of the run were changed. If not, this version of the program decides "
            f"differently from {saved.about.software}, which saved the run.",
            evidence={"differences": listed},
        )
    if not found.is_complete:
        raise RunIncomplete(
            f"The saved run has no end: {'its last line is cut off' if saved.is_cut else 'the answer is missing'}. "
            f"{done} All are as saved.",
            next_step="Search again, or take the run from a backup. The images and decisions so far are good.",
        )
    settings.say(f"{done} All are as saved.", plain(found))
