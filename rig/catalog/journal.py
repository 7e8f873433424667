"""The journal: the catalog of this computer for what is enrolled and answered before a catalog on a server gets it.

Commands and the web server open their catalogs here, so that each of them works while the server does not answer.

Decision: docs/decisions/0011.
"""

import threading
from collections.abc import Callable, Collection
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any, Final, Self, TypeVar

import numpy as np
from sqlalchemy import ColumnElement, and_, func, select
from sqlalchemy.orm import Session as Transaction

import hbr
from rig.catalog import derived, log, state
from rig.catalog.catalog import Catalog, OpenEnrollment
from rig.catalog.copying import Attempts, only_program, open_copy, open_or_copy
from rig.catalog.facts import Action, Entry
from rig.catalog.jobs import JobProgress, finished
from rig.catalog.records import EnrollmentStatus, JsonObject
from rig.catalog.state import ObjectSummary
from rig.catalog.transfer import CatalogSource, Conflict, transfer
from rig.catalog.upkeep import collect_garbage
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock
from rig.core.errors import (
    CatalogDamaged,
    CatalogError,
    CatalogUnavailable,
    ObjectExists,
    ObjectNotFound,
    RigError,
)
from rig.core.next_steps import Do
from rig.views.description import BENCH_DESCRIPTOR

T = TypeVar("T")

CHECK_S: Final = 2.0
"""Time between two checks of the journal."""
# shorter: a server that starts again is asked by all benches at once; longer: deliveries are late
RETRY_S: Final = 15.0
"""Time until the next attempt, if the server did not answer or a person has to decide about a name."""
END_S: Final = 5.0  # longer: Ctrl+C seems to hang
"""How long the end of a program waits for a delivery; the next program continues it."""

_LOCK: Final = "delivering"
_SAME_ANSWER: Final = timedelta(hours=1)
"""An answer is recorded at most so long after a first attempt whose commit the server could not confirm."""


def open_for_enrollment(place: CatalogPlace, clock: Clock) -> Catalog:
    """Open the catalog for new views: the journal of this computer if the catalog is on a server."""
    return Catalog.open(place, clock=clock) if place.url is None else Journal.of(place, clock)


def journal_folder(place: CatalogPlace) -> Path:
    """Return the folder of the journal for a catalog on a server."""
    return place.path / "journal"


class Journal(Catalog):
    """The catalog of this computer that enrollments go into before the server of the catalog gets them.

    So an enrollment needs no server while it takes its views. Names are compared with those of the server, or of its
    local copy. If two benches enroll one name, the second one that delivers it has a conflict.

    ``server`` is the place of the catalog that gets the enrollments. ``unreachable`` is the reason why a name could not
    be compared with those of the server; None if it was.
    """

    server: CatalogPlace
    unreachable: CatalogUnavailable | None = None
    _attempts: Attempts

    @classmethod
    def of(cls, server: CatalogPlace, clock: Clock) -> Self:
        """Open the journal of this computer for a catalog on a server; it is created if there is none."""
        journal = cls.open(journal_folder(server), clock=clock)
        journal.server, journal._attempts = CatalogPlace.of(server), Attempts(clock)
        return journal

    def known_objects(self) -> list[ObjectSummary]:
        """Return the objects of the journal, and those that the server has, by its local copy if it does not answer."""
        own = self.objects()
        names = {one.name for one in own}
        others = self._ask(lambda shared: [one for one in shared.objects() if one.enrolled_utc is not None])
        return [*own, *(one for one in others or () if one.name not in names)]

    def check_enrollable(self, name: str, *, resume: bool = False, replace: bool = False, **texts: str | None) -> None:
        """Raise what `begin` or `resume` would raise; for a new object also if the server has the name."""
        super().check_enrollable(name, resume=resume, replace=replace, **texts)
        if not resume:
            self._ask(lambda shared: shared.check_enrollable(name, replace=replace))

    def begin(self, name: str, *, replace: bool = False, **others: Any) -> OpenEnrollment:
        """Start to enroll an object that the server does not have, or with ``replace`` one that it has."""
        self.check_enrollable(name, replace=replace)
        return super().begin(name, replace=replace, **others)

    def _ask(self, question: Callable[[Catalog], T]) -> T | None:
        """Ask the catalog of the server, or its local copy while it does not answer; return None without a copy."""
        self.unreachable = None
        try:
            with self._attempts.open(self.server, create=True) as shared:
                return question(shared)
        except CatalogUnavailable as error:
            self.unreachable = error
        with suppress(CatalogUnavailable), open_copy(self.server, self.clock) as copy:
            return question(copy)
        return None


def journal_words(catalog: Catalog) -> str:
    """Return a sentence if the views of the enrollment must wait for the server; empty if the server has answered."""
    if not isinstance(catalog, Journal) or catalog.unreachable is None:
        return ""
    error = catalog.unreachable
    return f"{error.what} The views go into the journal of this computer. Next step: {error.next_step}"


def waiting(place: CatalogPlace, clock: Clock) -> int:
    """Return how many objects and answers of the journal wait for the server."""
    if place.url is None or not CatalogPlace(journal_folder(place)).database_file.exists():
        return 0
    with Catalog.open(journal_folder(place), clock=clock, read_only=True) as journal, journal.reading() as found:
        answers = found.transaction.scalar(select(func.count()).where(_is_waiting(found.transaction)))
        return len(found.used()) + (answers or 0)


# Delivery


@dataclass(frozen=True, slots=True)
class Delivery:
    """The outcome for an object of the journal: ``conflict`` is None if the server has it now."""

    name: str
    views: int
    conflict: RigError | None = None


def deliver_journal(place: CatalogPlace, clock: Clock, *, replacing: Collection[str] = ()) -> list[Delivery]:
    """Deliver the journal to the server of the catalog.

    Raises `CatalogUnavailable`: the server does not answer; the journal keeps everything. `CatalogError`,
    `CatalogBusy`: the server or the journal cannot be used, or another program delivers the journal.
    """
    with Journal.of(place, clock) as journal, Catalog.open(place, clock=clock) as server:
        return deliver(journal, server, replacing=replacing)


def deliver(journal: Catalog, server: Catalog, *, replacing: Collection[str] = ()) -> list[Delivery]:
    """Transfer the complete enrollments and the answers of the journal, each exactly once, and remove them there.

    A call that is killed at any point is continued by the next one: the server knows an enrollment by its key, and an
    answer, too.

    Objects named in ``replacing`` replace those of the server.

    Raises `CatalogUnavailable`: the server stopped answering; what was not delivered stays in the journal.
    """
    done = []
    # Another program that delivers would remove objects that this one reads.
    with only_program(journal.path / _LOCK, "delivers the journal"):
        for one in journal.objects():
            if one.enrolled_utc is not None:
                conflict = _deliver(journal, server, one.name, replaces=one.name in replacing)
                done.append(Delivery(one.name, one.views, conflict))
        if journal.objects(deleted=True):
            collect_garbage(journal)
        _deliver_answers(journal, server)
    return done


def _deliver(journal: Catalog, server: Catalog, name: str, *, replaces: bool) -> RigError | None:
    """Transfer one object and remove it from the journal; return the reason why it stays there."""
    try:
        enrollment = journal.object(name).complete
        assert enrollment is not None
        with journal.database.read() as transaction:  # did it begin with the wish to replace a known object?
            lines = select(Entry.details).where(
                Entry.enrollment_id == enrollment.id, Entry.action == Action.ENROLLMENT_STARTED
            )
            replaces |= any(details.get("replace") for details in transaction.scalars(lines))
        conflict = Conflict.REPLACE if replaces else Conflict.REJECT
        finished(transfer(CatalogSource(journal, [name]), server, conflict=conflict, once=True))
    except ObjectExists:
        return ObjectExists(
            f"The journal has {name!r}, and the catalog has another object of that name. Nothing is lost.",
            next_step=(
                Do.DELIVER_RENAMED(name=name),
                *("Or", Do.DELIVER_REPLACING(name=name)),
                *("Or", Do.DISCARD(name=name)),
            ),
        )
    except (CatalogDamaged, ObjectNotFound) as error:
        if "rejected" not in error.evidence:  # it is not about images of the journal
            return error
        fix = ("Restore them from a backup, or", Do.DISCARD(name=name), "Then enroll the object again.")
        return CatalogDamaged(error.what, next_step=fix, evidence=error.evidence)
    with journal.writing() as found:
        known = found.find(name)
        complete = found.of_status(known, EnrollmentStatus.COMPLETE)
        # It may have been enrolled again meanwhile, or be enrolled again now.
        is_same = complete is not None and complete.enrollment.key == enrollment.key
        if is_same and found.of_status(known, EnrollmentStatus.IN_PROGRESS) is None:
            found.append(Action.DELETED, name, **state.columns(known, deleted=True))
    return None


def _is_waiting(transaction: Transaction) -> ColumnElement[bool]:
    """Return the condition for the lines of the journal with answers that wait for the server."""
    last = select(Entry.details).where(Entry.action == Action.DELIVERED).order_by(Entry.id.desc()).limit(1)
    return and_(Entry.result.is_not(None), Entry.id > (transaction.scalar(last) or {}).get("line", 0))


def _deliver_answers(journal: Catalog, server: Catalog) -> None:
    """Transfer the answers that were recorded without the server; they keep their time and their operator."""
    with journal.database.read() as reading:
        is_waiting = _is_waiting(reading)
        waiting = set(reading.scalars(select(Entry.id).where(is_waiting)))
        if not waiting:
            return
        with_corrections = Entry.result.in_(select(Entry.result).where(is_waiting))
        entries = reading.scalars(select(Entry).where(with_corrections).order_by(Entry.id)).all()
        state.check_lines(reading, entries)
        reading.expunge_all()
    for image in {(one.record or {}).get("image") for one in entries if one.id in waiting} - {None}:
        try:
            content = journal.database.images.content(str(image))
        except CatalogError:  # it is lost; rig catalog verify reports it at the server
            continue
        with server.database.catalog_errors():
            server.database.images.put(content)
    times = [one.time_utc for one in entries]
    with server.database.write() as writing:
        same_time = Entry.time_utc.between(min(times) - _SAME_ANSWER, max(times) + _SAME_ANSWER)
        lines = writing.execute(select(Entry.record, Entry.result).where(Entry.result.is_not(None), same_time))
        known = {_key(record): number for record, number in lines}
        last = writing.scalar(select(func.max(Entry.result))) or 0
        numbers: dict[int | None, int] = {}  # of answers in the journal, and on the server
        for entry in entries:
            number = known.get(_key(entry.record)) or numbers.get(entry.result)
            if number is None:
                number = last = last + 1
            numbers[entry.result] = number
            if _key(entry.record) not in known:
                log.add(writing, log.same(entry, result=number, details={**entry.details, "result": number}))
    journal.note(Action.DELIVERED, line=max(waiting))


def _key(record: JsonObject | None) -> object:
    return (record or {}).get("key")


def delivery_words(one: Delivery, place: CatalogPlace) -> str:
    """Return the outcome for an object of the journal, as a sentence."""
    if one.conflict is not None:
        return f"{one.conflict.what} Next step: {one.conflict.next_step}"
    return f"Delivered {one.name} with {one.views} views to {place}."


def failure_words(error: RigError) -> str:
    """Return the reason why nothing could be delivered, as sentences."""
    kept = "What is in the journal of this computer is delivered later"
    return f"{error.what} {kept}. Next step: {error.next_step}"


# During other work


def comparable_views(
    catalog: Catalog, name: str, *, progress: Callable[[JobProgress], None] | None = None
) -> hbr.Views:
    """Return the views that a new object is compared with, and its own.

    For an object of a journal, the others are those of the server or of its local copy, if there is one.
    """
    views = derived.views(catalog, BENCH_DESCRIPTOR, progress)
    if not isinstance(catalog, Journal):
        return views
    try:
        with open_or_copy(catalog.server, catalog.clock) as shared:
            others = derived.views(shared, BENCH_DESCRIPTOR, progress)
    except RigError:  # no server, and no copy yet
        return views
    own = views.select(views.object_index == views.object_names.index(name))
    own = hbr.Views.of_object(name, own.descriptors, own.azimuth_deg, own.descriptor)
    kept = others.select(np.array([one != name for one in others.object_names], bool)[others.object_index])
    return hbr.Views.concatenate([own, kept])


@dataclass(frozen=True, slots=True)
class JournalState:
    """The numbers of objects and answers that wait for the server, and the reasons: sentences for the operator."""

    waiting: int = 0
    reasons: tuple[str, ...] = ()


@dataclass(eq=False)
class BackgroundDelivery(AbstractContextManager["BackgroundDelivery"]):
    """A thread that delivers the journal, whenever the server answers, during the work of a ``with`` block.

    It has its own connections. ``report`` gets a sentence about each delivered object, and one about each reason why an
    object was not delivered. ``changed`` gets each new state. Both are called in the thread.
    """

    place: CatalogPlace
    clock: Clock
    report: Callable[[str], None]
    changed: Callable[[JournalState], None] = lambda _: None
    check_s: float = CHECK_S
    retry_s: float = RETRY_S
    state: JournalState = field(default=JournalState(), init=False)

    def __post_init__(self) -> None:
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="catalog delivery", daemon=True)
        if self.place.url is not None:
            self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join(END_S)

    def _run(self) -> None:
        while True:
            state, before = self._attempt(), self.state
            if state != before:
                self.state = state
                for reason in state.reasons:
                    if reason not in before.reasons:
                        self.report(reason)
                self.changed(state)
            if self._ended.wait(self.retry_s if state.reasons else self.check_s):
                return

    def _attempt(self) -> JournalState:
        left = self.state.waiting
        try:
            left = waiting(self.place, self.clock)
            if not left:
                return JournalState()
            done = deliver_journal(self.place, self.clock)
            for one in done:
                if one.conflict is None:
                    self.report(delivery_words(one, self.place))
            reasons = tuple(delivery_words(one, self.place) for one in done if one.conflict is not None)
            return JournalState(waiting(self.place, self.clock), reasons)
        except RigError as error:
            return JournalState(left, (failure_words(error),))
