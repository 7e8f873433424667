"""`rig identify`."""

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from hbr import Outcome
from rig.cli.ui.command import command
from rig.cli.ui.desk import CommandDesk
from rig.cli.ui.exit_codes import EXIT_AMBIGUOUS, EXIT_UNKNOWN
from rig.cli.ui.live import LiveView
from rig.cli.ui.settings import Settings
from rig.events.events import Identified
from rig.jobs.identify import identify as identify_job


@command
def identify(
    settings: Settings,
    strategy: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Search strategy: dense, arc (dense in motion), ahbr, hbr, sweep, random or hmm "
            "(default: identify.strategy).",
        ),
    ] = None,
    save_run: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Save images and decisions for rig replay and rig report.")
    ] = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="Wait for the next object after each answer. Start with an empty table.")
    ] = False,
    sample: Annotated[
        str | None, typer.Option(metavar="ID", help="Sample on the table, to be recorded with the answer.")
    ] = None,
    scan: Annotated[
        bool,
        typer.Option(
            "--scan", help="Ask for the sample before each search, with --watch for each object: scan it, or type it."
        ),
    ] = False,
    operator: Annotated[
        str | None, typer.Option(metavar="NAME", help="Who works at the bench (default: the user's account).")
    ] = None,
) -> None:
    """Identify the object on the table.

    The exit code is 0 if it is found, 6 if the table is empty, 8 if it is unknown, 10 if it is ambiguous.

    Put the object on the table in any orientation. The default strategy, dense, compares views by edges and colours,
    rotates to the next best view, and stops when the object, or "not enrolled", is probable enough. The paper's is
    ahbr, by CEDD; its successor, the hidden Markov model hmm, stops at a probability of 98 %.

    The catalog records each answer (rig results list).

    Ctrl+Z pauses after the next view, fg resumes. Ctrl+C stops.

    Example: rig identify --bench sim --seed 3 --strategy sweep --save-run runs/1

    Example: rig identify --watch --scan --operator "A. Silva" --bench sim
    """
    with ExitStack() as beside, LiveView(settings) as view:
        desk = CommandDesk(settings, view.hide)
        if watch:
            beside.enter_context(desk.background_delivery())
        job = identify_job(
            desk,
            strategy=strategy,
            seed=settings.seed or 0,
            watch=watch,
            sample=sample,
            scan=scan,
            person=operator,
            next_folder=None if save_run is None else partial(_run_folder, save_run, several=watch),
            live=view.add,
        )
        answer = desk.run("identify", job, view.add)
    if not isinstance(answer, Identified) or answer.outcome is Outcome.UNKNOWN:
        raise typer.Exit(EXIT_UNKNOWN)
    if answer.outcome is Outcome.AMBIGUOUS:
        raise typer.Exit(EXIT_AMBIGUOUS)


def _run_folder(folder: Path, *, several: bool) -> Path:
    """Return the folder of the next run: ``folder``, or of several runs its subfolder 0001, 0002, ..."""
    if not several:
        return folder
    numbers = [int(path.name) for path in folder.glob("[0-9][0-9][0-9][0-9]") if path.name.isdecimal()]
    return folder / f"{max(numbers, default=0) + 1:04d}"
