"""The jobs that enroll: one object, some of its views again, or a tray."""

from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass

from rig.catalog import Catalog
from rig.catalog.journal import comparable_views, journal_words
from rig.core.phrases import joined
from rig.events.events import Enrolled, Event, Started
from rig.jobs.desk import Desk, JobResult, Remark, Steps
from rig.jobs.regions import warn_of_other_regions
from rig.jobs.table_image import refresh_table_image
from rig.plans.enroll import enroll as enroll_views
from rig.plans.enroll import retake as retake_views
from rig.plans.enroll import similar_objects
from rig.plans.tray import TrayItem, enroll_tray, left_to_enroll


def enroll(
    desk: Desk,
    name: str,
    *,
    views: int | None = None,
    label: str | None = None,
    note: str | None = None,
    resume: bool = False,
    replace: bool = False,
    fly: bool | None = None,
    ask: bool = True,
) -> Steps[None]:
    """Enroll an object, name the objects that it resembles, and deliver it to the server of the catalog, if any.

    ``ask`` says whether the operator may be asked for a new empty-table image; the rest is as for
    `rig.plans.enroll.enroll`.

    Raises `ObjectExists`, `CatalogError`, `CatalogBusy`: the name cannot be enrolled; nothing has moved. `RigError`: as
    in `rig.plans.enroll.enroll`.
    """
    with desk.open_bench() as bench, desk.open_to_enroll(bench.clock) as catalog:
        catalog.check_enrollable(name, label=label, note=note, resume=resume, replace=replace)
        yield from warn_of_other_regions(bench, catalog)
        yield from refresh_table_image(desk, bench, bench.placer, ask=ask, then=name)
        events = enroll_views(
            bench, catalog, name, views=views, label=label, note=note, resume=resume, replace=replace, fly=fly
        )
        yield from _delivered(desk, catalog, events)


@dataclass(frozen=True, slots=True)
class ViewsTakenAgain:
    """The views of an enrolled object that were taken again."""

    name: str
    """Name of the object."""
    taken_again: tuple[int, ...]
    """Indices of the views."""


def retake(desk: Desk, name: str, views: Sequence[int]) -> Steps[None]:
    """Take ``views`` of an enrolled object again, by their indices, as `rig.plans.enroll.retake`.

    The catalog itself is opened, also if it is on a server: only that has the other views.
    """
    with desk.open_bench() as bench, Catalog.open(desk.place, clock=bench.clock) as catalog:
        yield from warn_of_other_regions(bench, catalog)
        done = yield from retake_views(bench, catalog, name, views)
    numbers = [str(index + 1) for index in done.indices]
    text = f"{'View' if len(numbers) == 1 else 'Views'} {joined(numbers)} of {done.object_name} "
    values = ViewsTakenAgain(done.object_name, done.indices)
    yield JobResult(values, f"{text}{'was' if len(numbers) == 1 else 'were'} taken again.")


def enroll_list(
    desk: Desk, items: Sequence[TrayItem], *, views: int | None = None, fly: bool | None = None, ask: bool = True
) -> Steps[None]:
    """Enroll the objects of a tray one after the other; complete ones are skipped (`rig.plans.tray.enroll_tray`)."""
    with desk.open_bench() as bench, desk.open_to_enroll(bench.clock) as catalog:
        yield from warn_of_other_regions(bench, catalog)
        if left_to_enroll(catalog, items):
            yield from refresh_table_image(desk, bench, bench.placer, ask=ask)
        events = enroll_tray(bench, catalog, items, views=views, operator=desk.who_places(bench), fly=fly)
        yield from _delivered(desk, catalog, events)


def _delivered(desk: Desk, catalog: Catalog, events: Generator[Event, None, object]) -> Steps[None]:
    """Yield the events; compare each new object with the others, and deliver it before the next one is enrolled."""
    with closing(events):
        for event in events:
            if isinstance(event, Started) and (words := journal_words(catalog)):
                yield Remark(words)
            if isinstance(event, Enrolled):  # it is in the catalog now; Enrolled stays its last event
                with desk.preparing() as progress:
                    others = comparable_views(catalog, event.name, progress=progress)
                yield similar_objects(others, event.name)
            yield event
            if isinstance(event, Enrolled):
                yield from desk.deliver()
