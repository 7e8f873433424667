"""`rig identify`."""

import sys
from collections.abc import Generator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.catalog.catalog import report_other_regions
from rig.cli.ui.command import command
from rig.cli.ui.complete import strategy_names
from rig.cli.ui.exit_codes import EXIT_AMBIGUOUS, EXIT_UNKNOWN
from rig.cli.ui.settings import Settings

if TYPE_CHECKING:
    from rig.events.events import Event


@command
def identify(
    settings: Settings,
    max_views: Annotated[
        int | None,
        typer.Option(min=1, max=72, metavar="N", help="Largest number of views (default: identify.max_views)."),
    ] = None,
    strategy: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Search strategy: dense, arc (dense in motion), ahbr, hbr, sweep, random or that of a plug-in "
            "(default: identify.strategy).",
            autocompletion=strategy_names,
        ),
    ] = None,
    top: Annotated[int, typer.Option(min=1, max=100, metavar="N", help="Number of candidates to show.")] = 5,
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

    Put the object on the table in any orientation. The default strategy, dense, rotates to the next best view. It
    stops by the stopping rule, which rig catalog calibrate measures. If the catalog has no descriptors for dense, the
    default is ahbr.

    The catalog records each answer (rig results list).

    p or the space bar pauses and resumes. Ctrl+Z pauses, fg resumes. Ctrl+C stops.

    Example: rig identify --bench sim --seed 3 --strategy sweep --save-run runs/1

    Example: rig identify --watch --scan --operator "A. Silva" --bench sim
    """
    from hbr import Outcome
    from rig.bench import ObjectAlreadyPlaced, TableClearer
    from rig.cli.objects.empty_table import ensure_empty_table_image
    from rig.cli.ui.live import IdentifyView
    from rig.cli.ui.present import console
    from rig.cli.ui.prompts import ask_sample
    from rig.core.clock import SystemClock
    from rig.events.events import FrameUsed, Identified, Recorded, Started, Waiting, event_dict
    from rig.events.lines import line
    from rig.plans.identify import identify as identify_one
    from rig.plans.record import ResultRecorder
    from rig.plans.watch import watch as watch_table
    from rig.search.current_model import CurrentModel
    from rig.search.saved_run import RunSaver
    from rig.search.strategies import descriptor_for
    from rig.search.strategies import strategy as strategy_named
    from rig.views.description import PAPER_DESCRIPTOR
    from rig.views.object_presence import TableWatcher

    if max_views is not None:
        limited = settings.load().identify.limited_to(max_views)
        changes = [f"identify.{key}={getattr(limited, key)}" for key in ("max_views", "min_views")]
        settings = settings.merged(None, None, changes, None, False)
    config = settings.load().identify
    sample = _checked_sample(sample, scan=scan, watch=watch, records=config.record != "none")
    name = strategy or config.strategy
    chosen = None if name is None else strategy_named(name)
    screen = console(stderr=settings.json)
    answer = None
    events: Generator[Event, None, object]
    with (
        settings.open_for_search() as catalog,
        CurrentModel(catalog, None if chosen is None else descriptor_for(chosen)) as model,
    ):
        known = model()  # report a catalog that cannot be searched before the bench is opened
        if scan and not watch:
            sample = ask_sample()
        with ExitStack() as beside, settings.open_bench() as bench, IdentifyView(screen, keys=not scan) as view:
            if watch:
                beside.enter_context(settings.background_check())
                beside.enter_context(settings.background_delivery())
            # Prepare: notes about the catalog, the operator, the empty-table image.
            report_other_regions(settings, catalog, bench)
            seed = settings.seed or 0
            if watch and isinstance(bench.operator, ObjectAlreadyPlaced):
                bench.operator = TableWatcher(bench)  # the camera sees when the operator has put an object there
            uses_image = known.descriptor != PAPER_DESCRIPTOR and known.with_empty_table is not False
            if uses_image and isinstance(bench.operator, TableClearer):
                ensure_empty_table_image(settings, bench, ask=False)

            def show(event: "Event") -> None:
                if settings.json:
                    settings.print_json(event_dict(event))
                # in a pipe, the text on stderr would only repeat the JSON
                if isinstance(event, Recorded):
                    print(line(event), file=sys.stderr)
                elif not settings.json or screen.is_terminal or isinstance(event, Waiting):
                    view.add(event)

            # Search, and show and save each event.
            if watch:
                events = watch_table(bench, model, strategy=chosen, seed=seed, top=top, live=show)
            else:
                events = identify_one(bench, model(), strategy=chosen, seed=seed, top=top, live=show)
            recorder = ResultRecorder(
                *(settings.load().catalog_place(settings.bench_name), bench),
                clock=SystemClock(),
                catalog_version=lambda: model.version,
                operator=operator,
                with_image=config.record == "image",
            )
            recorder.sample = sample
            if config.record != "none":
                events = recorder.stream(events)
            folder = None if save_run is None else partial(_run_folder, save_run, several=watch)
            try:
                with RunSaver(folder, bench, model) as saver:
                    for event in events:
                        if scan and watch and isinstance(event, Started):  # the object is on the table
                            recorder.sample = ask_sample()
                            if isinstance(bench.operator, TableWatcher):
                                bench.operator.wait_until_still()
                        saver.add(event)
                        if not isinstance(event, FrameUsed):  # shown during the revolution
                            show(event)
                        if isinstance(event, Identified):
                            answer = event
            finally:
                events.close()
    if answer is None or answer.outcome is Outcome.UNKNOWN:
        raise typer.Exit(EXIT_UNKNOWN)
    if answer.outcome is Outcome.AMBIGUOUS:
        raise typer.Exit(EXIT_AMBIGUOUS)


def _checked_sample(sample: str | None, *, scan: bool, watch: bool, records: bool) -> str | None:
    from rig.catalog.results import clean_text
    from rig.core.errors import UsageError

    if sample is not None and (watch or scan):
        raise UsageError(
            "--sample names the sample of one object; --watch and --scan are for several.",
            next_step="Remove --sample, and use --scan to give the sample of each object.",
        )
    if (sample is not None or scan) and not records:
        raise UsageError(
            "The answer is not recorded, because identify.record is none.",
            next_step="Allow it: rig config set identify.record image",
        )
    return None if sample is None else clean_text(sample, "sample")


def _run_folder(folder: Path, *, several: bool) -> Path:
    """Return the folder of the next run: ``folder``, or of several runs its subfolder 0001, 0002, ..."""
    if not several:
        return folder
    numbers = [int(path.name) for path in folder.glob("[0-9][0-9][0-9][0-9]") if path.name.isdecimal()]
    return folder / f"{max(numbers, default=0) + 1:04d}"
