"""`rig enroll`."""

import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from rig.cli.ui.command import command
from rig.cli.ui.desk import CommandDesk
from rig.cli.ui.live import LiveView
from rig.cli.ui.settings import Settings
from rig.core.errors import UsageError
from rig.core.next_steps import Do, in_words
from rig.events.events import Accepted, Enrolled, Event, Started
from rig.jobs.enroll import enroll as enroll_job
from rig.jobs.enroll import enroll_list
from rig.jobs.enroll import retake as retake_job
from rig.motion.move import MotionTimes
from rig.plans.tray import read_tray


@command
def enroll(
    settings: Settings,
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Name of the object on the table.")] = None,
    views: Annotated[
        int | None,
        typer.Option(min=4, max=720, metavar="N", help="Number of views in a revolution (default: enroll.views)."),
    ] = None,
    label: Annotated[
        list[str] | None, typer.Option(metavar="TEXT", help="Label to sort and filter by. Repeatable.")
    ] = None,
    note: Annotated[str | None, typer.Option(metavar="TEXT", help="Note about the object.")] = None,
    tray: Annotated[
        Path | None,
        typer.Option(
            "--list", metavar="FILE", help="Enroll all objects of a CSV file with the columns name, label, note, views."
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Take the missing views of an interrupted enrollment.")
    ] = False,
    replace: Annotated[
        bool, typer.Option("--replace", help="Enroll again. The old views stay in use until the new ones are complete.")
    ] = False,
    retake: Annotated[
        list[int] | None,
        typer.Option(
            min=1, metavar="N", help="Take view N of the enrolled object again; it stands as it stood. Repeatable."
        ),
    ] = None,
    fly: Annotated[
        bool, typer.Option("--fly", help="Take the views in one revolution without a stop (default: enroll.mode).")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Do not ask for an empty-table image. Use the old one, or none.")
    ] = False,
) -> None:
    """Enroll an object: one revolution of the table, with a checked view at every step.

    Once a day, the command first asks for an empty table and takes its image (see rig empty-table).

    Ctrl+Z pauses after the next view, fg resumes. Ctrl+C stops: the views taken so far stay stored.

    With --fly, the table does not stop, and the revolution takes a few seconds. Run rig calibrate camera-time first.

    Example: rig enroll mug-white --bench sim --views 36

    Example: rig enroll --list tray.csv --bench sim

    Example: rig enroll mug-white --bench sim --fly

    Example: rig enroll mug-white --bench sim --retake 6
    """
    # What is asked for: one object, some of its views again, or a list.
    again = [number - 1 for number in retake or ()]
    options = {"label": label, "note": note, "resume": resume, "replace": replace, "views": views, "fly": fly}
    _check(name, tray, retake=retake, **options)
    items = read_tray(tray) if tray else ()
    how: dict[str, Any] = {"views": views, "fly": fly or None, "ask": not yes}
    stored_views = enrolled = 0

    def show(event: Event) -> None:
        nonlocal stored_views, enrolled
        if isinstance(event, Started):
            view.left = partial(MotionTimes(desk.bench.config).left_s, event.angles_deg, in_motion=event.in_motion)
        stored_views += isinstance(event, Accepted)
        enrolled += isinstance(event, Enrolled)
        view.add(event)

    with LiveView(settings) as view:
        desk = CommandDesk(settings, view.hide, yes=yes)
        desk.deliver_waiting()
        if name is not None and again:
            job = retake_job(desk, name, again)
        elif name is not None:
            labels = ", ".join(label) if label else None
            job = enroll_job(desk, name, **how, label=labels, note=note, resume=resume, replace=replace)
        else:
            job = enroll_list(desk, items, **how)
        try:
            desk.run("tray" if name is None else "retake" if again else "enroll", job, show)
        except BaseException:  # also Ctrl+C: how to continue is the last that the operator reads
            view.hide()
            if stored_views and not again:
                one = Do.CONTINUE_ENROLLMENT(name=name).with_options(settings.arguments())
                step = one if tray is None else "To continue with the list, run the same command again."
                print(f"The views taken so far are stored. {in_words(step)}", file=sys.stderr)
            raise
    if tray is not None and not settings.json:
        print(f"{enrolled} of {len(items)} objects enrolled in this run.", file=sys.stderr)


def _check(name: str | None, tray: Path | None, *, retake: object, **options: object) -> None:
    if (name is None) == (tray is None):
        raise UsageError(
            "No object is given." if name is None else "NAME and --list cannot be used together.",
            next_step="Give the name of one object, or a list of objects with --list FILE.",
        )
    given = [f"--{key}" for key, value in options.items() if value]
    if tray is not None:
        option, step = "--list", "Write labels and notes into the list; it resumes by itself. To replace one object,"
        given = [*(one for one in given if one not in ("--views", "--fly")), *(["--retake"] if retake else [])]
    else:
        option, step = "--retake", "The view is taken at rest, at its angle. To take all views again,"
    if given and (tray is not None or retake):
        raise UsageError(f"{', '.join(given)} cannot be used with {option}.", next_step=(step, Do.ENROLL_AGAIN()))
