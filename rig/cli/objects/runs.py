"""`rig replay` and `rig report`: read what `rig identify --save-run` has saved."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings
from rig.core.errors import ReplayMismatch, RunIncomplete
from rig.core.phrases import counted

if TYPE_CHECKING:
    from rig.search.saved_run import SavedRun

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
    from rig.search.saved_run import load_run

    saved = load_run(run)
    if check:
        _check(settings, saved)
        return
    from rig.cli.ui.live import IdentifyView
    from rig.cli.ui.present import console
    from rig.events.events import event_dict

    if settings.json:
        for event in saved.events():
            settings.print_json(event_dict(event))
        return
    about = saved.about
    started = str(about["started_utc"])[:16].replace("T", " ")
    objects = counted(len(saved.views.object_names), "enrolled object")
    print(f"Bench {about['bench']}, {started} UTC, {objects}")
    with saved.damage(), IdentifyView(console(plain=True)) as view:
        for event in saved.events():
            view.show(event)
    if saved.error:
        print(f"Error {saved.error['code']} ({saved.error['error']}): {saved.error['what']}")


@command
def report(
    settings: Settings,
    run: RunArgument,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File to write (default: report.html in the run's folder).")
    ] = None,
) -> None:
    """Write an HTML page about a saved run: the answer, the camera's path, the scores, the views and the decisions.

    Example: rig report runs/1 --out run-1.html
    """
    from rig.report import write_report
    from rig.report.report import run_report
    from rig.search.saved_run import load_run

    page = run_report(load_run(run))
    path = out or run / "report.html"
    write_report(path, page)
    settings.say(f"Report: {path}", {"report": str(path)})


def _check(settings: Settings, saved: "SavedRun") -> None:
    from rig.core.json_form import plain
    from rig.search.replay import check

    with saved.damage():
        found = check(saved)
    done = f"Computed again: {counted(found.views, 'descriptor')} and {counted(found.decisions, 'decision')}."
    if found.differences:
        more = 0 if settings.json else len(found.differences) - SHOWN
        listed = (
            [str(one) for one in found.differences]
            if settings.json
            else [one.summary() for one in found.differences[:SHOWN]]
        )
        raise ReplayMismatch(
            f"{counted(len(found.differences), 'number')} in the saved run differ from the computed ones. {done}",
            next_step="Check whether the files of the run were changed. If not, this version of the program decides "
            f"differently from {saved.about['software']}, which saved the run.",
            evidence={"differences": [*listed, f"and {more} more: --json"] if more > 0 else listed},
        )
    if not found.is_complete:
        raise RunIncomplete(
            f"The saved run has no end: {'its last line is cut off' if saved.is_cut else 'the answer is missing'}. "
            f"{done} All are as saved.",
            next_step="Search again, or take the run from a backup. The images and decisions so far are good.",
        )
    settings.say(f"{done} All are as saved.", plain(found))
