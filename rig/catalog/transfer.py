"""The one way to move objects into a catalog: from another catalog, a bundle, or photographs.

Everything is checked first. The images are stored next, which does no harm if nothing follows: an image has its SHA-256
as its name. At last, one transaction adds all rows and lines of the log.

Decisions: docs/decisions/0015, docs/decisions/0054.
"""

import secrets
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from datetime import datetime
from enum import StrEnum
from typing import Any, Final, NamedTuple, Protocol

from sqlalchemy import func, insert, select, text, update
from sqlalchemy.orm import Session as Transaction

from rig.catalog import derived, digests, log, state
from rig.catalog.catalog import Catalog
from rig.catalog.columns import damaged
from rig.catalog.digests import portions
from rig.catalog.facts import (
    Action,
    Derived,
    Enrollment,
    Entry,
    Property,
    Session,
    View,
    digest_of,
    digested,
    seal_of,
    sha256_of,
)
from rig.catalog.incoming import ReadImages, Reading, read_images
from rig.catalog.jobs import JobProgress
from rig.catalog.records import EnrollmentStatus, check_text, clean_name
from rig.catalog.rejected import Gap, RejectedFile
from rig.catalog.state import Ended, EnrollmentState, Named
from rig.core.errors import CatalogDamaged, CatalogError, ImportRejected, ObjectExists, RigError, UsageError
from rig.core.next_steps import Do
from rig.core.processes import Jobs

MAX_VIEWS: Final = 10_000
"""Most views of one enrollment: one every 0.036°."""

_OF_SESSION: Final = ("number", "started_utc", "provenance", "empty_table", "empty_table_bytes")
_OF_VIEW: Final = tuple(name for name, _ in digested(View) if name != "session")
"""Fields that every catalog has alike."""


class Conflict(StrEnum):
    """What to do with an object whose name is in the target already."""

    REJECT = "reject"
    SKIP = "skip"
    REPLACE = "replace"


@dataclass(frozen=True, slots=True, eq=False)
class Item:
    """An object with its enrollments, oldest first."""

    name: str
    label: str
    note: str
    created_utc: datetime
    enrollments: tuple[EnrollmentState, ...]

    @property
    def keys(self) -> set[str]:
        return {one.enrollment.key for one in self.enrollments}

    @property
    def statuses(self) -> set[EnrollmentStatus]:
        return {one.status for one in self.enrollments}


class Source(Protocol):
    """Objects that can be transferred.

    Attributes
    ----------
    origin
        Where they are, for the log.
    rejected, gaps
        What cannot be transferred, and what is missing.
    content
        Returns the bytes of an image. It can be sent to other processes.
    """

    @property
    def origin(self) -> str: ...

    @property
    def rejected(self) -> Sequence[RejectedFile]: ...

    @property
    def gaps(self) -> Sequence[Gap]: ...

    @property
    def content(self) -> Callable[[str], bytes]: ...

    def items(self) -> Iterator[Item]:
        """Yield the objects."""


class CatalogSource:
    """The objects in use of a catalog.

    Parameters
    ----------
    names
        Names of the objects; all if there are none.
    used_only
        Only the enrollments that searches use.
    own
        It is a catalog of this bench. Its images are compared with their names, but are not decoded again.
    """

    rejected: Sequence[RejectedFile] = ()
    gaps: Sequence[Gap] = ()

    def __init__(
        self, catalog: Catalog, names: Sequence[str] = (), *, used_only: bool = False, own: bool = True
    ) -> None:
        self.catalog = catalog
        self.names = names
        self.used_only = used_only
        self.own = own
        self.origin = str(catalog.place)
        self.content: Callable[[str], bytes] = catalog.database.images.content
        self.reader: Callable[[str], bytes] = catalog.database.images.read
        """Returns the bytes under the name of an image, unchecked."""

    def items(self) -> Iterator[Item]:
        """Yield the objects in the order in which they were added.

        Raises
        ------
        ObjectNotFound
            There is no object of one of the names.
        CatalogDamaged
            Something is not as it was stored, or this program would not have stored it.
        """
        with self.catalog.database.read() as transaction:
            state.used(transaction, checked=True)
            if self.names:
                by_id = {one.id: one for one in (state.find(transaction, name) for name in self.names)}
                wanted: Sequence[Entry] = sorted(by_id.values(), key=lambda one: one.object_id or 0)
            else:
                wanted = transaction.scalars(select(Named).where(state.IN_USE).order_by(Named.object_id)).all()
            transaction.expunge_all()
            used: set[str] = set()
            for known in wanted:
                conditions = [state.of_object(known.object_id)]
                conditions += [Ended.status == EnrollmentStatus.COMPLETE] if self.used_only else []
                found = state.enrollments(transaction, *conditions)
                item = Item(
                    *(str(known.object_name), known.label or "", known.note or "", known.created_utc or known.time_utc),
                    tuple(reversed(found)),
                )
                _check(item)
                if item.name in used:
                    raise damaged("the name of two objects", item.name)
                used.add(item.name)
                if found or not self.used_only:
                    yield item


def _check(item: Item) -> None:
    """Raise `CatalogDamaged` if this program would not have stored an object. Its digests are those of its rows."""
    try:
        if clean_name(item.name) != item.name:
            raise damaged("the name of an object", item.name)
        texts = {"label": [item.label], "note": [item.note], "bench": [], "software": []}
        for one in item.enrollments:
            texts["bench"] += [session.provenance.bench for session in one.enrollment.sessions]
            texts["software"] += [session.provenance.software for session in one.enrollment.sessions]
        for what, found in texts.items():
            for text in found:
                check_text(text, what)
    except UsageError as error:
        raise damaged(error.what.rstrip("."), item.name) from error
    for status in (EnrollmentStatus.COMPLETE, EnrollmentStatus.IN_PROGRESS):
        if sum(one.status == status for one in item.enrollments) > 1:
            raise damaged(f"the number of {status} enrollments", item.name)
    for one in item.enrollments:
        if not 1 <= len(one.enrollment.planned_azimuth_deg) <= MAX_VIEWS:
            raise damaged("the number of planned views", len(one.enrollment.planned_azimuth_deg))
        if (one.finished_utc is None) != (one.status == EnrollmentStatus.IN_PROGRESS):
            raise damaged("the end of an enrollment", one.finished_utc)


@dataclass(frozen=True, slots=True)
class Transferred:
    """What was transferred, left out and replaced, and which views are missing."""

    objects: int
    views: int
    bytes: int
    skipped: tuple[str, ...]
    replaced: tuple[str, ...]
    rejected: tuple[RejectedFile, ...]
    gaps: tuple[Gap, ...]


def transfer(
    source: Source,
    target: Catalog | None,
    *,
    conflict: Conflict = Conflict.REJECT,
    label: str | None = None,
    descriptors: Sequence[str] = (),
    strict: bool = False,
    jobs: Jobs | None = None,
    dry_run: bool = False,
    once: bool = False,
) -> Generator[JobProgress, None, Transferred]:
    """Transfer objects into a catalog, all or nothing; it yields its progress in images.

    An enrollment has a key. If the target has it already, with the same views, it is not added a second time.

    Parameters
    ----------
    target
        The catalog; None is one that does not exist yet, for a ``dry_run``.
    label
        Label of new objects that have none.
    descriptors
        Descriptors to be computed at once; others are computed when they are needed.
    strict
        Transfer nothing if one image cannot be used. Objects of a catalog are always transferred so.
    jobs
        Number of processes, or a cluster; None for one process per core.
    dry_run
        Only check everything.
    once
        An enrollment is delivered: it stays as the target has it, even if it was deleted or replaced there. What was
        computed from it goes with it.

    Raises
    ------
    UsageError
        There is no such descriptor.
    ImportRejected
        Nothing is left to transfer, or an image was rejected and the transfer is strict.
    CatalogDamaged
        Something in a catalog is not as it was stored.
    ObjectExists
        Some objects are in the catalog already, and conflicts are rejected.
    CatalogError, CatalogBusy
        A catalog cannot be used.
    """
    for name in descriptors:
        derived.known_descriptor(name)
    catalog = source if isinstance(source, CatalogSource) else None
    is_own = catalog is not None and catalog.own
    strict = strict or catalog is not None
    if strict and source.rejected:
        raise _rejection(source, source.rejected)
    store = None if dry_run or target is None else target.database.images

    # Check all rows, then all images. Photographs are stored at once, without those that are rejected.
    plan = _Plan(tuple(source.items()))
    if target is not None:
        with target.database.read() as transaction:
            plan = plan.compared(transaction, conflict, once=once)
    names = tuple(dict.fromkeys(descriptors))
    tasks = [
        derived.task_of(one.enrollment, one.enrollment.key, item.name, names, None)
        for item in plan.wanted
        for one in item.enrollments
    ]
    reading = Reading(
        source.content if catalog is None else catalog.reader,
        store if is_own or not strict else None,
        is_named=catalog is not None,
        decodes=bool(names) or not is_own,
    )
    with _errors_of(target):
        found = yield from read_images(reading, tasks, strict=strict and not dry_run, jobs=jobs)
    rejected = (*source.rejected, *found.rejected_files)
    wanted = [kept for item in plan.wanted if (kept := _kept(item, found)).enrollments or not item.enrollments]
    if (strict and rejected) or (rejected and plan.wanted and not wanted):
        raise _rejection(source, rejected)

    # Store the images of a strict transfer, now that all of them are right. Then add all rows.
    if store is not None and target is not None:
        with target.database.catalog_errors():
            if reading.store is None:
                again = [task._replace(names=()) for task in tasks]
                storing = replace(reading, store=store, decodes=False)
                stored = yield from read_images(storing, again, strict=True, jobs=jobs)
                if stored.images != found.images:  # the source has just been changed
                    raise _rejection(source, stored.rejected_files)
            store.settle({name for name, _ in found.images.values()})
        with target.database.write() as transaction:
            # Compare again: another process may have added objects meanwhile.
            plan = replace(plan, wanted=tuple(wanted)).compared(transaction, conflict, once=once)
            addition = _Addition(source, target, transaction, label, found.contents, plan.known)
            addition.add(plan, with_computed=once)
            wanted = list(plan.wanted)
    return Transferred(
        len(wanted),
        _Plan(tuple(wanted)).views,
        sum(dict(found.images.values()).values()),
        plan.skipped,
        plan.replaced,
        rejected,
        tuple(source.gaps),
    )


def _rejection(source: Source, rejected: Sequence[RejectedFile]) -> RigError:
    evidence = {"rejected": [f"{file.path}: {file.reason}" for file in rejected[:20]]}
    if isinstance(source, CatalogSource) and source.own:
        return CatalogDamaged(
            f"{len(rejected)} images of the catalog {source.origin} are missing or are not those that were stored.",
            next_step=(Do.VERIFY_CATALOG(), "Then restore them from a backup, or", Do.ENROLL_AGAIN()),
            evidence=evidence,
        )
    return ImportRejected(
        f"{source.origin} was not imported: {len(rejected)} of its files cannot be used.",
        next_step="Fix or remove the listed files and import it again.",
        evidence=evidence,
    )


def _errors_of(target: Catalog | None) -> AbstractContextManager[None]:
    return nullcontext() if target is None else target.database.catalog_errors()


def _kept(item: Item, found: ReadImages) -> Item:
    """Return an object with the stored images, without the views whose images were rejected."""
    return replace(item, enrollments=tuple(kept for one in item.enrollments if (kept := _kept_views(item, one, found))))


def _kept_views(item: Item, state: EnrollmentState, found: ReadImages) -> EnrollmentState | None:
    old = state.enrollment
    good = [view for view in old.views if view.image in found.images]
    if old.views and not good:
        return None
    plan, key = old.planned_azimuth_deg, old.key
    if found.rejected or any(found.images[view.image][0] != view.image for view in good):  # photographs
        plan = tuple(old.planned_azimuth_deg[view.index] for view in good)
        content = ((view.azimuth_deg, found.images[view.image], view.region) for view in good)
        key = sha256_of((item.name, *content))
        found.contents[key] = found.contents.pop(old.key, {})
    new = Enrollment(key=key, object_id=0, started_utc=old.started_utc, planned_azimuth_deg=plan)
    for session in old.sessions:
        new.sessions.append(Session(**{name: getattr(session, name) for name in _OF_SESSION}))
    for index, view in enumerate(good):
        copy = View(**{name: getattr(view, name) for name in _OF_VIEW})
        copy.session = view.session
        copy.index = view.index if key == old.key else index
        copy.image, copy.image_bytes = found.images[view.image]
        new.views.append(copy)
    _digest(new, key)
    return replace(state, enrollment=new)


def _digest(enrollment: Enrollment, key: str) -> None:
    enrollment.key = key
    parts: tuple[Enrollment | Session | View, ...] = (enrollment, *enrollment.sessions, *enrollment.views)
    for part in parts:
        part.digest = digest_of(part, key)


# What the target has already


class _Known(NamedTuple):
    """An enrollment that the target has, of the object with this id."""

    state: EnrollmentState
    object_id: int
    in_use: bool


@dataclass(frozen=True, slots=True)
class _Plan:
    """The objects to add, and the names of those that are left out and that get new enrollments.

    ``known`` are enrollments of the target by their keys.
    """

    wanted: tuple[Item, ...]
    skipped: tuple[str, ...] = ()
    replaced: tuple[str, ...] = ()
    known: Mapping[str, _Known] = field(default_factory=dict)

    @property
    def views(self) -> int:
        return sum(len(one.enrollment.views) for item in self.wanted for one in item.enrollments)

    def compared(self, transaction: Transaction, conflict: Conflict, *, once: bool) -> "_Plan":
        """Return the plan after a comparison with the target. `ObjectExists` if a conflict is rejected."""
        known = _known(transaction, [key for item in self.wanted for key in item.keys])
        ids = _ids(transaction, [item.name for item in self.wanted])
        wanted = [item for item in self.wanted if not _is_there(item, ids.get(item.name), known, once=once)]
        both = [item.name for item in wanted if item.name in ids]
        if both and conflict is Conflict.REJECT:
            raise ObjectExists(
                f"{len(both)} of {len(self.wanted)} objects {'is' if len(both) == 1 else 'are'} in the catalog "
                "already; nothing was imported.",
                next_step=(
                    "To skip them,",
                    Do.RUN_AGAIN(on_conflict="skip"),
                    "To import them as new enrollments,",
                    Do.RUN_AGAIN(on_conflict="replace"),
                ),
                evidence={"objects": both[:20]},
            )
        left = [item for item in wanted if conflict is Conflict.REPLACE or item.name not in ids]
        kept = {item.name for item in left}
        skipped = (*self.skipped, *(item.name for item in self.wanted if item.name not in kept))
        return _Plan(tuple(left), skipped, tuple(both) if conflict is Conflict.REPLACE else (), known)


def _known(transaction: Transaction, keys: Sequence[str]) -> dict[str, _Known]:
    used = set(transaction.scalars(select(Named.object_id).where(state.IN_USE)))
    found = {}
    for part in portions(keys, digests.AT_ONCE):
        for one in state.enrollments(transaction, Enrollment.key.in_(part)):
            owner = one.enrollment.object_id
            found[one.enrollment.key] = _Known(one, owner, owner in used)
    return found


def _ids(transaction: Transaction, names: Sequence[str]) -> dict[str, int]:
    """Return the ids of the objects in use with these names."""
    found: dict[str, int] = {}
    for part in portions(names, 500):
        rows = transaction.execute(
            select(Named.object_name, Named.object_id, Named.id).where(state.IN_USE, Named.object_name.in_(part))
        ).all()
        state.check_lines(transaction, [row.id for row in rows])
        found.update((row.object_name, row.object_id) for row in rows)
    return found


def _is_there(item: Item, object_id: int | None, known: Mapping[str, _Known], *, once: bool) -> bool:
    """Return whether the target has the enrollments of an object, and an object of its name has them in use alike."""
    if not item.enrollments or not item.keys <= known.keys():
        return False
    if once:
        return True
    for one in item.enrollments:
        there = known[one.enrollment.key]
        if not there.in_use or seal_of(there.state.enrollment) != seal_of(one.enrollment):
            return False
        if object_id is not None and (there.object_id, there.state.status) != (object_id, one.status):
            return False
    return True


# Add


@dataclass
class _Addition:
    """Adds objects to the target: rows of enrollments, and a line of the log for each new state and status."""

    source: Source
    target: Catalog
    transaction: Transaction
    label: str | None
    contents: Mapping[str, Mapping[str, bytes]]
    known: Mapping[str, _Known]
    _lines: list[tuple[Entry, Enrollment | None]] = field(default_factory=list)
    _new: dict[str, Enrollment] = field(default_factory=dict)
    """New enrollments by their keys in the source."""

    def add(self, plan: _Plan, *, with_computed: bool) -> None:
        ids = _ids(self.transaction, [item.name for item in plan.wanted])
        first = log.head(self.transaction)[0] + 1
        for item in plan.wanted:
            if item.name in ids:
                self._end_others(item, ids[item.name])
                self._add_object(item, ids[item.name])
            else:
                texts = {"label": item.label or self.label or "", "note": item.note}
                columns = state.columns(None, item.created_utc, texts)
                self._add_object(item, first + len(self._lines), **columns)
        self._store_new()
        for entry, enrollment in self._lines:
            if enrollment is not None:
                entry.enrollment_id = enrollment.id
                entry.details = {"enrollment_id": enrollment.id, "views": len(enrollment.views)}
                if entry.status in (EnrollmentStatus.COMPLETE, EnrollmentStatus.SUPERSEDED):
                    entry.seal = seal_of(enrollment)
        log.add(self.transaction, *(entry for entry, _ in self._lines))
        self._store_computed(with_computed=with_computed)
        log.append(
            self.transaction,
            self.target.clock,
            Action.IMPORTED,
            details={
                "origin": self.source.origin,
                "objects": [item.name for item in plan.wanted],
                "views": plan.views,
                "replaced": list(plan.replaced),
            },
        )

    def _end_others(self, item: Item, object_id: int) -> None:
        """End the enrollments of an object in the target that those of the item replace."""
        known = state.by_id(self.transaction, object_id)
        for status, ended, action in (
            (EnrollmentStatus.COMPLETE, EnrollmentStatus.SUPERSEDED, Action.ENROLLMENT_SUPERSEDED),
            (EnrollmentStatus.IN_PROGRESS, EnrollmentStatus.ABANDONED, Action.ENROLLMENT_ABANDONED),
        ):
            before = state.of_status(self.transaction, known, status) if status in item.statuses else None
            if before is not None and before.enrollment.key not in item.keys:
                when = before.finished_utc or self.target.clock.utc()
                self._line(action, item, object_id, before.enrollment, status=ended, finished_utc=when)

    def _add_object(self, item: Item, object_id: int, **columns: Any) -> None:
        for one in item.enrollments:
            enrollment, there = one.enrollment, self.known.get(one.enrollment.key)
            if there is None or there.object_id != object_id or seal_of(there.state.enrollment) != seal_of(enrollment):
                self._new[enrollment.key] = enrollment
                if there is not None:  # with other views, or of an object that is deleted or has another name
                    _digest(enrollment, secrets.token_hex(32))
                enrollment.object_id = object_id
            elif there.state.status == one.status:
                continue
            else:
                enrollment = there.state.enrollment
            ended = {"status": one.status, "finished_utc": one.finished_utc}
            self._line(Action.IMPORTED, item, object_id, enrollment, **ended, **columns)
            columns = {}
        if columns:
            self._line(Action.IMPORTED, item, object_id, None, **columns)

    def _line(self, action: Action, item: Item, object_id: int, enrollment: Enrollment | None, **columns: Any) -> None:
        about = {"object_name": item.name, "object_id": object_id, **log.author()}
        entry = Entry(id=0, time_utc=self.target.clock.utc(), action=action, **about, **columns)
        self._lines.append((entry, enrollment))

    def _store_new(self) -> None:
        views = []
        for enrollment in self._new.values():  # the views refer to the sessions, so these are stored first
            views.append(list(enrollment.views))
            enrollment.views.clear()
        self.transaction.add_all(self._new.values())
        self.transaction.flush()
        for enrollment, own in zip(self._new.values(), views, strict=True):
            enrollment.views.extend(own)
        self.transaction.flush()

    def _store_computed(self, *, with_computed: bool) -> None:
        rows = [
            derived.row_of(seal_of(enrollment), what, None, content)
            for key, enrollment in self._new.items()
            for what, content in self.contents.get(key, {}).items()
        ]
        if with_computed and isinstance(self.source, CatalogSource):
            seals = [seal_of(enrollment) for enrollment in self._new.values()]
            with self.source.catalog.database.read() as reading:
                for part in portions(seals, digests.AT_ONCE):
                    found = reading.execute(select(Derived.__table__).where(Derived.seal.in_(part)))
                    rows += map(dict, found.mappings())
        derived.add(self.transaction, rows)


# Copy


class Copied(NamedTuple):
    """What was copied."""

    objects: int
    views: int
    results: int
    images: int
    image_bytes: int


def copy(source: Catalog, target: Catalog) -> Generator[JobProgress, None, Copied]:
    """Copy everything from a catalog into an empty one. The target stays empty if the call does not end.

    Every row keeps its id and its digest. An interrupted copy can be repeated.

    Raises
    ------
    CatalogError, CatalogBusy
        The target is not empty, or one of them cannot be used.
    CatalogDamaged
        Something in the source is not as it was stored.
    """
    with source.database.read() as reading:
        _check_all(reading)
        with target.database.read() as transaction:
            _check_empty(transaction, target)
        size = 0
        wanted = sorted(_images(reading))
        for done, name in enumerate(wanted):
            if done % 50 == 0:
                yield JobProgress(done, len(wanted))
            with source.database.catalog_errors():
                content = source.database.images.content(name)
            size += len(content)
            with target.database.catalog_errors():
                target.database.images.put(content, settled=False)
        yield JobProgress(len(wanted), len(wanted))
        with target.database.catalog_errors():
            target.database.images.settle(wanted)
        with target.database.write() as writing:
            _check_empty(writing, target)
            for table in (Entry, Enrollment, Session, View, Derived):
                for part in reading.execute(select(table.__table__)).mappings().partitions(500):
                    writing.execute(insert(table.__table__), list(map(dict, part)))  # type: ignore[arg-type]
            head = reading.scalar(select(Property.value).where(Property.key == "head"))
            writing.execute(update(Property).where(Property.key == "head").values(value=head))
            _set_last_ids(writing)
            _check_all(writing)
            results = writing.scalar(select(func.count()).where(Entry.action == Action.IDENTIFIED)) or 0
        objects = len(target.objects())
        views = reading.scalar(select(func.count()).select_from(View)) or 0
    copied = Copied(objects, views, results, len(wanted), size)
    target.note(Action.COPIED, origin=str(source.place), **copied._asdict())
    return copied


def _check_all(transaction: Transaction) -> None:
    """Raise `CatalogDamaged` if a line of the log or a row of an enrollment is not as it was written."""
    state.check(transaction)
    wrong = next(log.wrong_lines(transaction), None)
    if wrong is not None:
        raise damaged("its log", f"wrong at line {wrong}")


def _check_empty(transaction: Transaction, target: Catalog) -> None:
    if log.head(transaction)[0] or transaction.scalar(select(Enrollment.id).limit(1)) is not None:
        raise CatalogError(
            f"The catalog {target.place} is not empty.",
            next_step=("Give a new place, or", Do.MERGE()),
        )


def _images(transaction: Transaction) -> set[str]:
    """Return the names of all images that rows or answers name."""
    answers = select(Entry.record["image"].as_string()).where(Entry.action == Action.IDENTIFIED)
    named = (select(View.image), select(Session.empty_table), answers)
    return {image for query in named for image in transaction.scalars(query) if image is not None}


def _set_last_ids(transaction: Transaction) -> None:
    """Let the next enrollment and the next view have new ids: an id that was given once must not be given again."""
    enrollment = transaction.scalar(select(func.max(Entry.enrollment_id))) or 0
    for table, last in (("enrollments", enrollment), ("views", transaction.scalar(select(func.max(View.id))) or 0)):
        values = {"name": table, "last": last}
        if last and transaction.get_bind().dialect.name == "postgresql":
            transaction.execute(text(f"SELECT setval('{table}_id_seq', :last)"), values)
        elif last:
            transaction.execute(text("DELETE FROM sqlite_sequence WHERE name = :name"), values)
            transaction.execute(text("INSERT INTO sqlite_sequence (name, seq) VALUES (:name, :last)"), values)
