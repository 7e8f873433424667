"""`rig enroll`."""

import os
import shlex
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.ui.command import command
from rig.cli.ui.complete import object_names
from rig.cli.ui.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rig.bench import Bench
    from rig.catalog import Catalog
    from rig.events.events import Event
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
    step: Annotated[
        float | None,
        typer.Option(min=0.5, max=90, metavar="DEGREES", help="Angle between two views, instead of --views."),
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
        bool | None,
        typer.Option(
            "--fly/--at-rest",
            help="Take the views in one revolution without a stop, or at rest (default: enroll.mode).",
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only show the plan: views, duration, table angles. Nothing moves.")
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
    from rig.plans.tray import read_tray

    # Reject wrong options before a device is opened.
    given = {"--views": views, "--step": step, "--label": label, "--note": note, "--report": report, "--yes": yes}
    given |= {"--fly": fly is True, "--at-rest": fly is False}
    views = _views(views, step)
    _check(name, tray, label=label, note=note, resume=resume, replace=replace)
    if report is not None:
        _check_writable(report)
    items = read_tray(tray) if tray else ()
    if dry_run:
        names = {name: None} if name else {item.name: item.views for item in items}
        _dry_run(settings, names, views, resume=resume, replace=replace, fly=fly)
        return

    settings.deliver_waiting()
    with (
        settings.open_bench() as bench,
        settings.open_for_enrollment(bench.clock) as catalog,
        settings.background_check(),
    ):
        from rig.bench import ObjectAlreadyPlaced
        from rig.cli.catalog.catalog import report_other_regions
        from rig.cli.objects.empty_table import ensure_empty_table_image
        from rig.cli.ui.operator_prompts import OperatorPrompts
        from rig.plans.enroll import enroll as enroll_one
        from rig.plans.tray import AutomaticOperator, enroll_tray, left_to_enroll

        labels = ", ".join(label) if label else None
        if name is not None:  # reject it before the operator clears the table
            catalog.check_enrollable(name, label=labels, note=note, resume=resume, replace=replace)
        report_other_regions(settings, catalog, bench)
        if name is not None or left_to_enroll(catalog, items):
            ensure_empty_table_image(settings, bench, ask=not yes, then=name)
        job = _Job(settings, bench, catalog)
        if name is not None:
            events = enroll_one(
                bench, catalog, name, views=views, label=labels, note=note, resume=resume, replace=replace, fly=fly
            )
            job.run(events, ["To continue:", _command(settings, given, name, "--resume")], report)
        else:
            asks = isinstance(bench.operator, ObjectAlreadyPlaced)
            operator = OperatorPrompts(job.close_view) if asks else AutomaticOperator()
            job.run(
                enroll_tray(bench, catalog, items, views=views, operator=operator, fly=fly),
                ["To continue with the other objects:", _command(settings, given, "--list", str(tray))],
                report,
            )
            job.print_total(len(items))


def _command(settings: Settings, given: "Mapping[str, Any]", *arguments: str) -> str:
    """Return the command that continues, with the options that were given, quoted for the shell."""
    options: list[str] = []
    for option, value in given.items():
        for one in value if isinstance(value, list) else [value]:
            if one is True:
                options.append(option)
            elif one not in (None, False):
                options += [option, f"{one:g}" if isinstance(one, float) else str(one)]
    return f"  {shlex.join(['rig', 'enroll', *arguments, *options, *settings.arguments()])}"


class _Job:
    """Runs the plan of one or more enrollments, shows its events, and writes the report."""

    def __init__(self, settings: Settings, bench: "Bench", catalog: "Catalog") -> None:
        from rig.cli.ui.live import EnrollView
        from rig.cli.ui.present import console

        self._settings = settings
        self._bench = bench
        self._catalog = catalog
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

    def run(self, events: Any, how_to_continue: list[str], report: Path | None) -> None:
        """Run the plan to its end; after an interruption print how to continue."""
        from rig.catalog.shared import comparable_views
        from rig.cli.ui.jobs import progress_bar
        from rig.events.events import Enrolled, Item
        from rig.plans.similar_objects import similar_objects

        try:
            for event in events:
                if isinstance(event, Item):
                    self.close_view()
                    self._heading = f"{event.number} of {event.of} "
                if isinstance(event, Enrolled):  # it is in the catalog now; Enrolled stays its last event
                    with progress_bar("Preparing objects for searches") as progress:
                        views = comparable_views(self._catalog, event.name, progress=progress)
                    self._show(similar_objects(views, event.name))
                self._show(event)
                if isinstance(event, Enrolled):
                    self._enrolled += 1
                    self._complete()
                    self._stored_views = 0
                    self._deliver()
        except BaseException:
            self.close_view()
            if self._stored_views or self._enrolled:
                print("\n".join(["The views taken so far are stored.", *how_to_continue]), file=sys.stderr)
            raise
        finally:
            events.close()
            self.close_view()
            if report is not None and self._records:
                self._write(report)

    def _deliver(self) -> None:
        """Deliver the object, so that the other benches have it before this one has enrolled the next."""
        from rig.catalog.journal import Journal

        if isinstance(self._catalog, Journal):
            self.close_view()
            self._settings.deliver()

    def print_total(self, items: int) -> None:
        if not self._settings.json:
            print(f"{self._enrolled} of {items} objects enrolled in this run.", file=sys.stderr)

    def _show(self, event: "Event") -> None:
        from rig.cli.ui.live import EnrollView
        from rig.events.events import Accepted, Started, event_dict
        from rig.report import EnrollmentRecord

        if self._settings.json:
            self._settings.print_json(event_dict(event))
        if isinstance(event, Started):
            self.close_view()
            self._report_journal()
            self._records.append(EnrollmentRecord(region=self._bench.config.view.roi))
        if self._view is None:
            self._view = EnrollView(self._screen, self._bench.config, self._heading)
            self._view.__enter__()
        self._stored_views += isinstance(event, Accepted)
        if self._records:
            self._records[-1].add(event)
        # in a pipe, the text on stderr would only repeat the JSON
        if not self._settings.json or self._screen.is_terminal:
            self._view.add(event)

    def _report_journal(self) -> None:
        """Say that the server of the catalog does not answer, and that the views are stored all the same."""
        from rig.catalog.shared import journal_words

        if words := journal_words(self._catalog):
            print(f"Note: {words}", file=sys.stderr)

    def _complete(self) -> None:
        """Add the views of earlier sessions to the record of a resumed enrollment."""
        record = self._records[-1]
        stored = self._catalog.object(record.name).views
        if len(stored) > len(record.views):
            record.complete((view.record, self._catalog.read_image(view)) for view in stored)

    def _write(self, path: Path) -> None:
        from rig.core.phrases import counted
        from rig.report import Meta, render_report, write_report

        names = ", ".join(record.name for record in self._records[:3])
        title = names if len(self._records) <= 3 else counted(len(self._records), "object")
        meta = Meta(conditions=self._records[-1].conditions, date=self._bench.clock.utc())
        write_report(path, render_report(f"Enrolled: {title}", "", self._records, [], meta=meta))
        print(f"Report: {path}", file=sys.stderr)


def _views(views: int | None, step: float | None) -> int | None:
    from rig.core.errors import UsageError

    if step is None:
        return views
    if views is not None:
        raise UsageError("--views and --step cannot be used together.", next_step="Remove one of them.")
    count = round(360.0 / step)
    if abs(count * step - 360.0) > 1e-6:
        raise UsageError(
            f"A revolution cannot be divided into steps of {step:g}°.",
            next_step=f"Use --views {count} (steps of {360.0 / count:.2f}°), or a step that divides 360.",
        )
    return count


def _check(name: str | None, tray: Path | None, *, resume: bool, replace: bool, **texts: Any) -> None:
    from rig.core.errors import UsageError

    if (name is None) == (tray is None):
        raise UsageError(
            "No object is given." if name is None else "NAME and --list cannot be used together.",
            next_step="Give the name of one object, or a list of objects with --list FILE.",
        )
    given = [f"--{key}" for key, value in {**texts, "resume": resume, "replace": replace}.items() if value]
    if tray is not None and given:
        raise UsageError(
            f"{', '.join(given)} cannot be used with --list.",
            next_step="Write labels and notes into the columns of the list. Interrupted enrollments of a list are "
            "resumed without an option. To replace one object: rig enroll NAME --replace",
        )


def _check_writable(report: Path) -> None:
    """Reject a report that cannot be written now rather than after hours of enrollment."""
    from rig.core.errors import UsageError

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


def _dry_run(
    settings: Settings,
    names: "Mapping[str, int | None]",
    views: int | None,
    *,
    resume: bool,
    replace: bool,
    fly: bool | None,
) -> None:
    """Print the plan of an enrollment; nothing moves and nothing is stored."""
    from rig.cli.ui.present import console, dry_run_lines
    from rig.events.events import plain
    from rig.plans.estimate import dry_run

    with settings.open_bench() as bench, settings.catalog_to_plan(bench.clock) or nullcontext() as catalog:
        found = dry_run(bench, catalog, names, views=views, resume=resume, replace=replace, fly=fly)
    if settings.json:
        settings.print_json({"dry_run": plain(found)})
        return
    screen = console()
    for line in dry_run_lines(found):
        screen.print(line, markup=False, highlight=False, soft_wrap=not screen.is_terminal)
