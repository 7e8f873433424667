"""`rig enroll`."""

import os
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.ui.command import command
from rig.cli.ui.complete import object_names
from rig.cli.ui.settings import Settings
from rig.core.errors import UsageError
from rig.core.next_steps import Do
from rig.core.phrases import counted

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rig.cli.ui.desk import CommandDesk
    from rig.cli.ui.live import EnrollView
    from rig.events.events import Event
    from rig.jobs.desk import Steps
    from rig.report import EnrollmentRecord


@command
def enroll(
    settings: Settings,
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="Name of the object on the table.", autocompletion=object_names)
    ] = None,
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
    fly: Annotated[
        bool,
        typer.Option("--fly", help="Take the views in one revolution without a stop (default: enroll.mode)."),
    ] = False,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write an HTML page with all views and measurements.")
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Do not ask for an empty-table image. Use the old one, or none.")
    ] = False,
) -> None:
    """Enroll an object: one revolution of the table, with a checked view at every step.

    Once a day, the command first asks for an empty table and takes its image (see rig empty-table).

    p or the space bar pauses and resumes. Ctrl+Z pauses, fg resumes. Ctrl+C stops: the views taken so far stay stored.

    With --fly, the table does not stop, and the revolution takes a few seconds. Run rig calibrate camera-time first.

    Example: rig enroll mug-white --bench sim --views 36 --report mug.html

    Example: rig enroll --list tray.csv --bench sim

    Example: rig enroll mug-white --bench sim --fly
    """
    from rig.cli.ui.desk import CommandDesk
    from rig.jobs.enroll import enroll as enroll_job
    from rig.jobs.enroll import enroll_list
    from rig.plans.tray import read_tray

    # Reject wrong options before a device is opened.
    given = {"--views": views, "--label": label, "--note": note, "--report": report, "--yes": yes, "--fly": fly}
    how: dict[str, Any] = {"views": views, "fly": fly or None}
    _check(name, tray, label=label, note=note, resume=resume, replace=replace)
    if report is not None:
        _check_writable(report)
    items = read_tray(tray) if tray else ()

    continued = [name, "--resume"] if name is not None else ["--list", str(tray)]
    others = "" if name is not None else " with the other objects"
    shown = _Shown(settings, report, [f"To continue{others}:", _command(settings, given, *continued)])
    desk = shown.desk = CommandDesk(settings, shown.close_view, yes=yes)
    desk.deliver_waiting()
    if name is not None:
        labels = ", ".join(label) if label else None
        job = enroll_job(desk, name, **how, label=labels, note=note, resume=resume, replace=replace, ask=not yes)
        shown.run(job)
    else:
        shown.run(enroll_list(desk, items, **how, ask=not yes))
        shown.print_total(len(items))


def _command(settings: Settings, given: "Mapping[str, Any]", *arguments: str) -> str:
    """Return the command that continues, with the options that were given, quoted for the shell."""
    options: list[str] = []
    for option, value in given.items():
        for one in value if isinstance(value, list) else [value]:
            if one is True:
                options.append(option)
            elif one not in (None, False):
                options += [option, str(one)]
    return f"  {shlex.join(['rig', 'enroll', *arguments, *options, *settings.arguments()])}"


class _Shown:
    """Shows the events of one or more enrollments, and writes the report."""

    desk: "CommandDesk"

    def __init__(self, settings: Settings, report: Path | None, how_to_continue: list[str]) -> None:
        from rig.cli.ui.present import console

        self._settings = settings
        self._report = report
        self._how_to_continue = how_to_continue
        self._screen = console(stderr=settings.json)
        self._view: EnrollView | None = None
        self._heading = ""
        self._records: list[EnrollmentRecord] = []
        self._stored_views = 0
        self._enrolled = 0

    def close_view(self) -> None:
        """Remove the live table from the screen."""
        if self._view is not None:
            self._view.__exit__(None, None, None)
            self._view = None

    def run(self, job: "Steps[None]") -> None:
        """Run the job to its end; after an interruption print how to continue."""
        try:
            self.desk.run(job, self._show)
        except BaseException:
            self.close_view()
            if self._stored_views or self._enrolled:
                print("\n".join(["The views taken so far are stored.", *self._how_to_continue]), file=sys.stderr)
            raise
        finally:
            self.close_view()
            if self._report is not None and self._records:
                self._write(self._report)

    def print_total(self, items: int) -> None:
        if not self._settings.json:
            print(f"{self._enrolled} of {items} objects enrolled in this run.", file=sys.stderr)

    def _show(self, event: "Event") -> None:
        from rig.cli.ui.live import EnrollView
        from rig.events.events import Accepted, Enrolled, Item, Started, event_dict
        from rig.report import EnrollmentRecord

        if isinstance(event, Item):
            self.close_view()
            self._heading = f"{event.number} of {event.of} "
        if self._settings.json:
            self._settings.print_json(event_dict(event))
        bench = self.desk.bench
        if isinstance(event, Started):
            self.close_view()
            self._records.append(EnrollmentRecord(region=bench.config.view.roi))
        if self._view is None:
            self._view = EnrollView(self._screen, bench.config, self._heading)
            self._view.__enter__()
        self._stored_views += isinstance(event, Accepted)
        if self._records:
            self._records[-1].add(event)
        # in a pipe, the text on stderr would only repeat the JSON
        if not self._settings.json or self._screen.is_terminal:
            self._view.add(event)
        if isinstance(event, Enrolled):
            self._enrolled += 1
            self._stored_views = 0
            self._complete()

    def _complete(self) -> None:
        """Add the views of earlier sessions to the record of a resumed enrollment."""
        from rig.catalog.describing import described

        record, catalog = self._records[-1], self.desk.catalog
        stored = catalog.object(record.name).complete
        if stored is not None and len(stored.views) > len(record.views):
            segmented = described(catalog.database, stored, record.name).segmentation
            record.complete(
                (view, one, catalog.read_image(view.image)) for view, one in zip(stored.views, segmented, strict=True)
            )

    def _write(self, path: Path) -> None:
        from rig.report import Meta, render_report, write_report

        names = ", ".join(record.name for record in self._records[:3])
        title = names if len(self._records) <= 3 else counted(len(self._records), "object")
        meta = Meta(conditions=self._records[-1].conditions, date=self.desk.bench.clock.utc())
        write_report(path, render_report(f"Enrolled: {title}", "", self._records, [], meta=meta))
        print(f"Report: {path}", file=sys.stderr)


def _check(name: str | None, tray: Path | None, *, resume: bool, replace: bool, **texts: Any) -> None:
    if (name is None) == (tray is None):
        raise UsageError(
            "No object is given." if name is None else "NAME and --list cannot be used together.",
            next_step="Give the name of one object, or a list of objects with --list FILE.",
        )
    given = [f"--{key}" for key, value in {**texts, "resume": resume, "replace": replace}.items() if value]
    if tray is not None and given:
        raise UsageError(
            f"{', '.join(given)} cannot be used with --list.",
            next_step=(
                "Write labels and notes into the columns of the list. Interrupted enrollments of a list are resumed "
                "without an option. To replace one object,",
                Do.ENROLL_AGAIN(),
            ),
        )


def _check_writable(report: Path) -> None:
    """Reject a report that cannot be written now rather than after hours of enrollment."""
    reason = "it is a folder" if report.is_dir() else ""
    try:
        report.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or str(error)
    if not reason and not os.access(report.parent, os.W_OK):
        reason = "its folder is not writable"
    if reason:
        raise UsageError(
            f"The report cannot be written to {report}.",
            next_step="Choose another file with --report.",
            evidence={"reason": reason},
        )
