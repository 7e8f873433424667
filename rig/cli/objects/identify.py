"""`rig identify`."""

from collections.abc import Callable, Generator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.catalog.catalog import tell_other_regions
from rig.cli.ui.command import command
from rig.cli.ui.complete import strategy_names
from rig.cli.ui.settings import Settings

if TYPE_CHECKING:
    from rig.bench import Bench
    from rig.catalog import Catalog
    from rig.events.events import Event
    from rig.search.model import Model
    from rig.search.saved_run import RunWriter

EXIT_UNKNOWN = 8


@command
def identify(
    settings: Settings,
    max_views: Annotated[
        int | None, typer.Option(min=1, max=72, help="Views at most; identify.max_views otherwise.")
    ] = None,
    strategy: Annotated[
        str | None,
        typer.Option(
            help="How the object is searched: dense, ahbr, hbr, sweep, random, or a plug-in's; identify.strategy "
            "otherwise.",
            autocompletion=strategy_names,
        ),
    ] = None,
    top: Annotated[int, typer.Option(min=1, max=100, help="Candidates that are named.")] = 5,
    save_run: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Keep frames and decisions, for rig replay and rig report.")
    ] = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="Wait for the next object after each answer, endlessly; begin empty.")
    ] = False,
) -> None:
    """Find out what stands on the table; ends with exit code 8 if it is unknown.

    By default the bench's own search, which turns to where the likeliest objects differ most and stops by rules that
    were rehearsed on the catalog (rig catalog calibrate); the paper's where the catalog is not described for it.
    p or the space bar pauses and goes on, Ctrl+Z too; Ctrl+C stops.

    Example: rig identify --bench sim --seed 3 --strategy sweep --save-run runs/1

    Example: rig identify --watch --bench sim --json
    """
    from rig.bench import TableClearer
    from rig.cli.objects.empty_table import ensure_empty_table_image
    from rig.cli.ui.live import IdentifyView
    from rig.cli.ui.present import console
    from rig.events.events import Identified, Waiting, event_dict
    from rig.plans.identify import identify as identify_one
    from rig.plans.watch import watch as watch_table
    from rig.search.strategies import descriptor_for
    from rig.search.strategies import strategy as strategy_named
    from rig.views.description import PAPER_DESCRIPTOR

    if max_views is not None:
        settings = settings.merged(None, None, [f"identify.max_views={max_views}"], None, False)
    name = strategy or settings.load().identify.strategy
    chosen = None if name is None else strategy_named(name)
    screen = console(stderr=settings.json)
    answer = None
    events: Generator[Event, None, object]
    with settings.open_catalog(read_only=True) as catalog:
        model = _Model(catalog, None if chosen is None else descriptor_for(chosen))
        model()  # before anything moves
        with settings.open_bench() as bench, IdentifyView(screen) as view:
            tell_other_regions(settings, catalog, bench)
            seed = settings.seed or 0
            if watch:
                _bring_by_camera(bench)
            known = model()
            sees = known.descriptor != PAPER_DESCRIPTOR and known.pictured is not False
            if sees and isinstance(bench.operator, TableClearer):
                ensure_empty_table_image(settings, bench, ask=False)
            if watch:
                events = watch_table(bench, model, strategy=chosen, seed=seed, top=top)
            else:
                events = identify_one(bench, model(), strategy=chosen, seed=seed, top=top)
            keeper = _Keeper(save_run, bench, model, several=watch)
            try:
                with keeper:
                    for event in events:
                        keeper.add(event)
                        if settings.json:
                            settings.print_json(event_dict(event))
                        # people's lines would be the same as the JSON, once more, where neither is looked at
                        if not settings.json or screen.is_terminal or isinstance(event, Waiting):
                            view.add(event)
                        if isinstance(event, Identified):
                            answer = event
            finally:
                events.close()
    if answer is None or answer.name is None:
        raise typer.Exit(EXIT_UNKNOWN)


class _Model:
    """What is enrolled, loaded again when something was enrolled, deleted or calibrated meanwhile."""

    def __init__(self, catalog: "Catalog", descriptor: str | None = None) -> None:
        self._catalog = catalog
        self._descriptor = descriptor
        self._seen: object = None
        self._model: Model

    def __call__(self) -> "Model":
        from rig.search.model import load_model
        from rig.search.stopping_rules import FILE

        rules = self._catalog.path / FILE
        now = (
            [(summary.name, summary.enrolled_utc, summary.views) for summary in self._catalog.objects()],
            rules.stat().st_mtime_ns if rules.exists() else None,
        )
        if now != self._seen:
            self._model, self._seen = load_model(self._catalog, descriptor=self._descriptor), now
        return self._model


class _Keeper:
    """Keeps runs in a folder, where one is given; ``several`` in folders within it, 0001, 0002, ..."""

    def __init__(self, folder: Path | None, bench: "Bench", model: Callable[[], "Model"], *, several: bool) -> None:
        self._folder = folder
        self._bench = bench
        self._model = model
        self._several = several
        self._writer: RunWriter | None = None

    def __enter__(self) -> "_Keeper":
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if self._writer is not None:
            self._writer.__exit__(None, error, None)
            self._writer = None

    def add(self, event: "Event") -> None:
        from rig.events.events import Failed, Identified, Started
        from rig.search.saved_run import RunWriter

        if self._folder is None:
            return
        if isinstance(event, Started):
            folder = self._next() if self._several else self._folder
            self._writer = RunWriter(folder, self._bench, self._model())
        if self._writer is not None:
            self._writer.add(event)
            if isinstance(event, Identified | Failed):
                self._writer.close()
                self._writer = None

    def _next(self) -> Path:
        assert self._folder is not None
        taken = [int(path.name) for path in self._folder.glob("[0-9][0-9][0-9][0-9]") if path.name.isdecimal()]
        return self._folder / f"{max(taken, default=0) + 1:04d}"


def _bring_by_camera(bench: "Bench") -> None:
    """Have a bench without hands see by its camera when the next object stands there."""
    from rig.bench import ObjectAlreadyPlaced
    from rig.views.object_presence import TableWatcher

    if isinstance(bench.operator, ObjectAlreadyPlaced):
        bench.operator = TableWatcher(bench)
