"""A catalog on a server, as a bench uses it: with the journal and the local copy of this computer.

Both are ordinary catalogs in folders. Enrollments go into the journal, and from there to the server. Searches read the
local copy while the server does not answer. Commands and the web server open their catalogs here, so that each of them
works without the server.

Decision: docs/decisions/0051.
"""

import fcntl
import json
import os
import shutil
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Final, Self, TypeVar

import numpy as np
from sqlalchemy import ColumnElement, Table, and_, delete, func, insert, select
from sqlalchemy.orm import Session as Transaction

import hbr
from rig.catalog import derived, log, state
from rig.catalog.catalog import Catalog
from rig.catalog.database import properties
from rig.catalog.digests import portions
from rig.catalog.enrolling import OpenEnrollment
from rig.catalog.facts import Action, Derived, Enrollment, Entry, Property, Row, Session, View
from rig.catalog.jobs import JobProgress, finished
from rig.catalog.records import EnrollmentStatus, JsonObject
from rig.catalog.state import ObjectSummary
from rig.catalog.transfer import CatalogSource, Conflict, transfer
from rig.catalog.upkeep import collect_garbage
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock
from rig.core.errors import (
    CatalogBusy,
    CatalogDamaged,
    CatalogError,
    CatalogUnavailable,
    ObjectExists,
    ObjectNotFound,
    RigError,
)
from rig.core.files import json_values, no_follow
from rig.core.next_steps import Do
from rig.views.description import BENCH_DESCRIPTOR

T = TypeVar("T")

CHECK_S: Final = 2.0
"""Time between two checks of the journal."""
RETRY_S: Final = 15.0
"""Time until the next attempt, if the server did not answer or a person has to decide about a name."""
END_S: Final = 5.0
"""How long the end of a program waits for a delivery; the next program continues it."""
RULES: Final = "search_rules.json"
"""The stopping rule beside a catalog (`rig.search.stopping_rules`)."""

_PATIENCE: Final = 20
_LOCK: Final = "delivering"
_COPY: Final = "copy"
"""Property of a local copy: of which catalog, up to which line of its log, and when."""
_SAME_ANSWER: Final = timedelta(hours=1)
"""An answer is recorded at most so long after a first attempt whose commit the server could not confirm."""
_AT_ONCE: Final = 100
"""Enrollments, and lines of the log, that are read from the server at once."""


# Open


class Attempts:
    """Attempts to open catalogs, with pauses, so that the operator does not wait repeatedly for a server that is down.

    An attempt that failed after a time t is repeated after 20 t: a host that rejects a connection takes milliseconds,
    a network that drops packets takes seconds. Until then the same error is raised at once.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._not_before_ns = clock.now_ns()
        self._error: CatalogUnavailable | None = None

    def open(self, place: CatalogPlace, *, create: bool = False) -> Catalog:
        """Open a catalog, for reading only unless it is created if there is none; errors as `Catalog.open`."""
        begun_ns = self._clock.now_ns()
        if self._error is not None and begun_ns < self._not_before_ns:
            raise self._error.with_traceback(None)  # a traceback grows each time that an error is raised
        try:
            return Catalog.open(place, clock=self._clock, create=create, read_only=not create)
        except CatalogUnavailable as error:
            now_ns = self._clock.now_ns()
            self._error, self._not_before_ns = error, now_ns + _PATIENCE * (now_ns - begun_ns)
            raise


def open_copy(place: CatalogPlace, clock: Clock) -> Catalog:
    """Return the local copy, open for reading; `Catalog.copied_utc` says when it was made.

    Raises
    ------
    CatalogUnavailable
        There is no copy of this catalog.
    """
    with suppress(CatalogError):
        copy = Catalog.open(place.copy_folder, clock=clock, create=False, read_only=True)
        with copy.database.read() as transaction:
            made = _copied(transaction)
        if made.get("catalog") == str(place):
            copy.copied_utc, copy.copy_of = datetime.fromisoformat(made["copied_utc"]), place
            return copy
        copy.close()
    raise CatalogUnavailable(
        f"This computer has no copy of the catalog {place}.",
        next_step="Search once while the server answers: the search makes the copy.",
    )


def open_or_copy(
    place: CatalogPlace, clock: Clock, *, create: bool = False, attempts: Attempts | None = None
) -> Catalog:
    """Return a catalog, open for reading; its local copy while its server or its store does not answer.

    With ``create`` the catalog is created if there is none, and is open for writing. ``attempts`` are those of a
    program that opens the catalog often.

    Raises
    ------
    CatalogUnavailable
        There is no copy either.
    """
    try:
        return (attempts or Attempts(clock)).open(place, create=create)
    except CatalogUnavailable as error:
        try:
            return open_copy(place, clock)
        except CatalogUnavailable as missing:
            raise CatalogUnavailable(
                f"{error.what} {missing.what}",
                next_step=(*error.steps, *missing.steps),
                evidence=error.evidence,
            ) from error


def open_for_enrollment(place: CatalogPlace, clock: Clock) -> Catalog:
    """Open the catalog for new views: the journal of this computer if the catalog is on a server."""
    return Catalog.open(place, clock=clock) if place.url is None else Journal.of(place, clock)


# The journal


def journal_folder(place: CatalogPlace) -> Path:
    """Return the folder of the journal for a catalog on a server."""
    return place.path / "journal"


class Journal(Catalog):
    """The catalog of this computer that enrollments go into before the server of the catalog gets them.

    So an enrollment needs no server while it takes its views. Names are compared with those of the server, or of its
    local copy. If two benches enroll one name, the second one that delivers it has a conflict.

    Attributes
    ----------
    server
        Place of the catalog that gets the enrollments.
    unreachable
        The reason why a name could not be compared with those of the server; None if it was.
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

    def check_enrollable(
        self,
        name: str,
        *,
        label: str | None = None,
        note: str | None = None,
        resume: bool = False,
        replace: bool = False,
    ) -> None:
        """Raise what `begin` or `resume` would raise; for a new object also if the server has the name."""
        super().check_enrollable(name, label=label, note=note, resume=resume, replace=replace)
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
    with (
        Catalog.open(journal_folder(place), clock=clock, read_only=True) as journal,
        journal.database.read() as transaction,
    ):
        answers = transaction.scalar(select(func.count()).where(_is_waiting(transaction)))
        return len(state.used(transaction)) + (answers or 0)


def discard(journal: Catalog, name: str) -> None:
    """Remove an object from the journal without delivering it. Errors as for `Catalog.delete`."""
    journal.delete(name)
    collect_garbage(journal)


# Delivery


@dataclass(frozen=True, slots=True)
class Delivery:
    """The outcome for an object of the journal: ``conflict`` is None if the server has it now."""

    name: str
    views: int
    conflict: RigError | None = None


def deliver_journal(place: CatalogPlace, clock: Clock, *, replacing: Collection[str] = ()) -> list[Delivery]:
    """Deliver the journal to the server of the catalog.

    Raises
    ------
    CatalogUnavailable
        The server does not answer; the journal keeps everything.
    CatalogError, CatalogBusy
        The server or the journal cannot be used, or another program delivers the journal.
    """
    with Journal.of(place, clock) as journal, Catalog.open(place, clock=clock) as server:
        return deliver(journal, server, replacing=replacing)


def deliver(journal: Catalog, server: Catalog, *, replacing: Collection[str] = ()) -> list[Delivery]:
    """Transfer the complete enrollments and the answers of the journal, each exactly once, and remove them there.

    A call that is killed at any point is continued by the next one: the server knows an enrollment by its key, and an
    answer, too.

    Parameters
    ----------
    replacing
        Names of objects that replace those of the server.

    Raises
    ------
    CatalogUnavailable
        The server stopped answering; what was not delivered stays in the journal.
    CatalogBusy
        Another program delivers this journal.
    """
    done = []
    with _only_delivery(journal):
        for one in journal.objects():
            if one.enrolled_utc is not None:
                conflict = _deliver(journal, server, one.name, replaces=one.name in replacing)
                done.append(Delivery(one.name, one.views, conflict))
        if journal.objects(deleted=True):
            collect_garbage(journal)
        _deliver_answers(journal, server)
    return done


@contextmanager
def _only_delivery(journal: Catalog) -> Iterator[None]:
    """Prevent a delivery of the journal by another program: each would remove objects that the other one reads."""
    lock = no_follow(str(journal.path / _LOCK), os.O_RDWR | os.O_CREAT, mode=0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the system releases it when the process ends
    except BlockingIOError as error:
        raise CatalogBusy("Another program delivers the journal now.", next_step="Try again later.") from error
    else:
        yield
    finally:
        os.close(lock)


def _deliver(journal: Catalog, server: Catalog, name: str, *, replaces: bool) -> RigError | None:
    """Transfer one object and remove it from the journal; return the reason why it stays there."""
    try:
        enrollment = journal.object(name).complete
        assert enrollment is not None
        conflict = Conflict.REPLACE if replaces or _replaces(journal, enrollment) else Conflict.REJECT
        finished(transfer(CatalogSource(journal, [name], used_only=True), server, conflict=conflict, once=True, jobs=1))
    except ObjectExists:
        return ObjectExists(
            f"The journal has {name!r}, and the catalog has another object of that name. Nothing is lost.",
            next_step=(
                Do.DELIVER_RENAMED(name=name),
                "Or",
                Do.DELIVER_REPLACING(name=name),
                "Or",
                Do.DISCARD(name=name),
            ),
        )
    except (CatalogDamaged, ObjectNotFound) as error:
        if "rejected" not in error.evidence:  # it is not about images of the journal
            return error
        fix = ("Restore them from a backup, or", Do.DISCARD(name=name), "Then enroll the object again.")
        return CatalogDamaged(error.what, next_step=fix, evidence=error.evidence)
    _forget(journal, name, enrollment.key)
    return None


def _replaces(journal: Catalog, enrollment: Enrollment) -> bool:
    """Return whether an enrollment began with the wish to replace that of a known object."""
    with journal.database.read() as transaction:
        begun = transaction.scalars(
            select(Entry.details).where(Entry.enrollment_id == enrollment.id, Entry.action == Action.ENROLLMENT_STARTED)
        )
        return any(details.get("replace") for details in begun)


def _forget(journal: Catalog, name: str, key: str) -> None:
    """Remove a delivered object from the journal, unless it has been or is being enrolled again."""
    with journal.database.write() as transaction:
        known = state.find(transaction, name)
        complete = state.of_status(transaction, known, EnrollmentStatus.COMPLETE)
        again = state.of_status(transaction, known, EnrollmentStatus.IN_PROGRESS) is not None
        if not again and complete is not None and complete.enrollment.key == key:
            columns = state.columns(known, known.time_utc, deleted=True)
            log.append(transaction, journal.clock, Action.DELETED, name, **columns)


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
        state.check_lines(reading, [one.id for one in entries])
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
                log.add(writing, _same(entry, result=number, details={**entry.details, "result": number}))
    journal.note(Action.DELIVERED, line=max(waiting))


def _key(record: JsonObject | None) -> object:
    return (record or {}).get("key")


def _same(entry: Entry, **others: Any) -> Entry:
    """Return a line of the log for another catalog; these columns are other ones."""
    columns = {column.name: getattr(entry, column.name) for column in Entry.__table__.columns}
    del columns["digest"]
    return Entry(**{**columns, **others})


def delivery_words(one: Delivery, place: CatalogPlace) -> str:
    """Return the outcome for an object of the journal, as a sentence."""
    if one.conflict is not None:
        return f"{one.conflict.what} Next step: {one.conflict.next_step}"
    return f"Delivered {one.name} with {one.views} views to {place}."


def failure_words(error: RigError) -> str:
    """Return the reason why nothing could be delivered, as sentences."""
    kept = "What is in the journal of this computer is delivered later"
    return f"{error.what} {kept}. Next step: {error.next_step}"


# The local copy


def _copied(transaction: Transaction) -> dict[str, Any]:
    """Return what a local copy has: place and id of the catalog, last line of its log with its digest, and the time."""
    stored = transaction.scalar(select(Property.value).where(Property.key == _COPY))
    with suppress(ValueError, TypeError):
        return dict(json_values((stored or "").encode()))
    return {}


def update_copy(catalog: Catalog) -> bool:
    """Bring the local copy up to date; return whether anything had changed. Only what is new is read.

    A copy that is damaged, or of another catalog, is made again.

    Raises
    ------
    CatalogDamaged
        The catalog is not as it was stored; the copy stays as it is.
    CatalogError, CatalogBusy
        One of them cannot be used, or another program updates the copy.
    """
    folder = catalog.place.copy_folder
    try:
        changed = _update(catalog, folder)
    except CatalogDamaged:
        made = folder.with_name(f"{folder.name}.new")
        shutil.rmtree(made, ignore_errors=True)
        changed = _update(catalog, made)
        shutil.rmtree(folder, ignore_errors=True)
        made.rename(folder)
    with suppress(FileNotFoundError):
        shutil.copyfile(catalog.path / RULES, folder / RULES)
    return changed


def _update(catalog: Catalog, folder: Path) -> bool:
    with Catalog.open(folder, clock=catalog.clock) as copy:
        with catalog.database.read() as reading, copy.database.write() as writing:
            before = _copied(writing)
            line, digest = log.head(reading)
            own = {"catalog": str(catalog.place), "id": properties(reading)["id"]}
            now = {**own, "line": line, "digest": digest, "copied_utc": catalog.clock.utc().isoformat()}
            known = reading.scalar(select(Entry.digest).where(Entry.id == before.get("line"))) or ""
            if {**before, **own, "digest": known} != before and log.head(writing)[0]:
                raise CatalogDamaged("The local copy is one of another catalog.", next_step=Do.RUN_AGAIN())
            _copy_log(reading, writing, after=before.get("line", 0))
            _copy_enrollments(reading, writing)
            _copy_derived(reading, writing)
            writing.merge(Property(key=_COPY, value=json.dumps(now)))
        newest = derived.empty_tables(copy).newest
        store = copy.database.images
        with copy.database.catalog_errors():
            if newest is not None and not store.size(newest):
                with suppress(CatalogError):  # rig catalog verify reports it
                    store.put(catalog.database.images.content(newest))
            store.remove(store.names() - {newest})
    return bool(before.get("line") != line)


def _copy_log(reading: Transaction, writing: Transaction, *, after: int) -> None:
    """Add the new lines of the catalog's log to that of the copy, without answers: so it has the same state."""
    new = select(Entry).where(Entry.result.is_(None)).order_by(Entry.id).limit(_AT_ONCE)
    while part := reading.scalars(new.where(Entry.id > after)).all():
        state.check_lines(reading, [one.id for one in part])
        log.add(writing, *map(_same, part))
        after = part[-1].id
        reading.expunge_all()


def _copy_enrollments(reading: Transaction, writing: Transaction) -> None:
    """Copy the rows of the enrollments that searches use, with their ids, and remove the others."""
    used = {one.enrollment_id for one in state.used(reading)}
    known = set(writing.scalars(select(Enrollment.id)))
    owners: tuple[tuple[type[Row], Any], ...] = (
        (Enrollment, Enrollment.id),
        (Session, Session.enrollment_id),
        (View, View.enrollment_id),
    )
    for part in portions(sorted(known - used), _AT_ONCE):
        for table, owner in reversed(owners):
            writing.execute(delete(table).where(owner.in_(part)))
    for part in portions(sorted(used - known), _AT_ONCE):
        for table, owner in owners:
            _copy_rows(reading, writing, table, owner.in_(part))


def _copy_derived(reading: Transaction, writing: Transaction) -> None:
    """Copy what is computed from these enrollments, if it is new or another program has computed it again."""
    used = {one.seal for one in state.used(writing)}
    columns = select(Derived.seal, Derived.what, Derived.made_by, Derived.sha256)
    there = {tuple(row) for row in reading.execute(columns) if row.seal in used}
    here = {tuple(row) for row in writing.execute(columns)}
    for part in portions(sorted({str(row[0]) for row in there ^ here}), _AT_ONCE):
        writing.execute(delete(Derived).where(Derived.seal.in_(part)))
        _copy_rows(reading, writing, Derived, Derived.seal.in_(used.intersection(part)))


def _copy_rows(reading: Transaction, writing: Transaction, table: type[Row], wanted: ColumnElement[bool]) -> None:
    columns = table.__table__
    assert isinstance(columns, Table)
    rows = [dict(row) for row in reading.execute(select(columns).where(wanted)).mappings()]
    if rows:
        writing.execute(insert(columns), rows)


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
        """Deliver what is in the journal; return what stays there."""
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
