"""The job that identifies one object, or with ``watch`` one after the other."""

from collections.abc import Callable, Generator
from contextlib import closing
from pathlib import Path

from rig.catalog.results import clean_text
from rig.core.clock import SystemClock
from rig.core.errors import UsageError
from rig.core.next_steps import Do
from rig.events.events import Event, FrameUsed, Identified, Started
from rig.jobs.desk import Desk, Steps
from rig.jobs.regions import warn_of_other_regions
from rig.jobs.table_image import refresh_table_image
from rig.plans.identify import ResultRecorder
from rig.plans.identify import identify as identify_one
from rig.plans.identify import watch as watch_table
from rig.search.model import CurrentModel
from rig.search.saved_run import saving
from rig.search.strategies import descriptor_for
from rig.search.strategies import strategy as strategy_named
from rig.views.description import PAPER_DESCRIPTOR
from rig.views.object_presence import TableWatcher


def identify(
    desk: Desk,
    *,
    strategy: str | None = None,
    max_views: int | None = None,
    seed: int = 0,
    watch: bool = False,
    sample: str | None = None,
    scan: bool = False,
    person: str | None = None,
    next_folder: Callable[[], Path] | None = None,
    live: Callable[[FrameUsed], object] = lambda _: None,
) -> Steps[Identified | None]:
    """Identify the object on the table, record the answer in the catalog, save the run; return the last answer.

    Parameters
    ----------
    desk
        Where the job runs.
    strategy
        Its name; the default is ``identify.strategy``.
    max_views
        The default is ``identify.max_views``.
    seed, live
        As for `rig.plans.identify.identify`.
    watch
        Wait for the next object after each answer, until the job is closed.
    sample, scan
        The sample on the table, or whether the operator is asked for it: with ``watch`` for each object.
    person
        Who works at the bench; None for the user's account.
    next_folder
        Returns the folder of the next saved run; None saves nothing.

    Raises `UsageError`: the sample cannot be recorded, or there is no such strategy. `RigError`: as in
    `rig.plans.identify.identify` and `rig.search.model.load_model`.
    """
    config = desk.config.identify
    sample = _checked(sample, scan=scan, watch=watch, records=config.record != "none")
    name = strategy or config.strategy
    chosen = None if name is None else strategy_named(name)
    answer: Identified | None = None
    with (
        desk.open_to_read() as catalog,
        CurrentModel(catalog, None if chosen is None else descriptor_for(chosen)) as model,
    ):
        with desk.preparing() as progress:
            known = model(progress)  # report a catalog that cannot be searched before the bench is opened
        if scan and not watch:
            sample = desk.operator.ask_sample()
        with desk.open_bench() as bench:
            settings = bench.config if max_views is None else bench.config.with_max_views(max_views)
            yield from warn_of_other_regions(bench, catalog)
            # The camera sees when the operator has put the next object on the table.
            watcher = TableWatcher(bench) if watch and bench.placer is None else None
            placer = watcher or bench.placer
            uses_image = known.descriptor != PAPER_DESCRIPTOR and known.with_empty_table is not False
            if uses_image and placer is not None:
                yield from refresh_table_image(desk, bench, placer, ask=False)

            # The plan: one search, or one after the other.
            def one() -> Generator[Event, None, Identified]:
                enrolled = model() if watch else known  # objects enrolled meanwhile are found
                return identify_one(
                    bench, enrolled, config=settings, placer=placer, strategy=chosen, seed=seed, live=live
                )

            events: Generator[Event, None, object] = watch_table(bench, one) if watch else one()
            recorder = ResultRecorder(
                *(desk.place, bench),
                clock=SystemClock(),
                catalog_version=lambda: model.version,
                operator=person,
                with_image=config.record == "image",
            )
            recorder.sample = sample
            # Each event is saved before it is shown. An answer is recorded after it was shown, so that a catalog that
            # fails does not hide it.
            with closing(events), saving(next_folder, bench, model, settings) as save:
                for event in events:
                    if scan and watch and isinstance(event, Started):  # the object is on the table
                        recorder.sample = desk.operator.ask_sample()
                        if watcher is not None:
                            watcher.wait_until_still()
                    save(event)
                    if isinstance(event, Identified):
                        answer = event
                    if not isinstance(event, FrameUsed):  # shown by ``live`` while the table rotated
                        yield event
                    if config.record != "none" and (recorded := recorder.add(event)):
                        yield recorded
    return answer


def _checked(sample: str | None, *, scan: bool, watch: bool, records: bool) -> str | None:
    if sample is not None and (watch or scan):
        raise UsageError(
            "--sample names the sample of one object; --watch and --scan are for several.",
            next_step=("Leave the sample out. To give the sample of each object,", Do.RUN_AGAIN(scan=True)),
        )
    if (sample is not None or scan) and not records:
        raise UsageError(
            "The answer is not recorded, because identify.record is none.",
            next_step=Do.SET_KEY(key="identify.record", value="image"),
        )
    return None if sample is None else clean_text(sample, "sample")
