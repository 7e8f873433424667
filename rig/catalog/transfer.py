"""The one way to move objects into a catalog: from another catalog, a bundle, or photographs.

Everything is checked first. The images are stored next, which does no harm if nothing follows: an image has its SHA-256
as its name. At last, one transaction adds all rows and lines of the log.

Decision: docs/decisions/0011.
"""

import secrets
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from enum import StrEnum
from typing import Any, Final, Protocol

from sqlalchemy import insert, select
from sqlalchemy.orm import Session as Transaction

from rig.catalog import describing, digests
from rig.catalog.catalog import Catalog
from rig.catalog.columns import damaged
from rig.catalog.facts import Action, Derived, Enrollment, Session, View, digest_of, digested, seal_of, sha256_of
from rig.catalog.incoming import Read, ReadImages, RejectedFile, checked, images_of, read_images, store_images
from rig.catalog.jobs import JobProgress, portions
from rig.catalog.records import EnrollmentStatus, check_text, checked_texts, clean_name
from rig.catalog.state import EnrollmentState, ObjectLine, State, check_lines, ending, new_columns
from rig.core.errors import CatalogDamaged, CatalogError, ImportRejected, ObjectExists, RigError, UsageError
from rig.core.next_steps import Do

_OF_SESSION: Final = ("number", "started_utc", "provenance", "empty_table", "empty_table_bytes")
_OF_VIEW: Final = tuple(name for name, _ in digested(View) if name != "session")
"""Fields that every catalog has alike."""


class Conflict(StrEnum):
    """What to do with an object whose name is in the target already."""

    REJECT = "reject"
    SKIP = "skip"
    REPLACE = "replace"


@dataclass(frozen=True, slots=True, eq=False)
class TransferItem:
    """An object with the enrollment that searches use."""

    name: str
    label: str
    note: str
    created_utc: datetime
    enrollment: Enrollment
    finished_utc: datetime | None


class TransferSource(Protocol):
    """Objects that can be transferred."""

    @property
    def origin(self) -> str:
        """Where they are, for the log."""

    @property
    def rejected(self) -> Sequence[RejectedFile]:
        """What cannot be transferred."""

    @property
    def content(self) -> Read:
        """Function that reads an image."""

    def items(self) -> Iterator[TransferItem]:
        """Yield the objects."""


class CatalogSource:
    """The objects in use of a catalog.

    These ``names``, or all. If the catalog is this bench's ``own``, its images are compared with their names, but are
    not decoded again.
    """

    rejected: Sequence[RejectedFile] = ()

    def __init__(self, catalog: Catalog, names: Sequence[str] = (), *, own: bool = True) -> None:
        self.catalog = catalog
        self.names = names
        self.own = own
        self.origin = str(catalog.place)
        self.content: Read = catalog.database.images.read

    def items(self) -> Iterator[TransferItem]:
        """Yield the objects in the order in which they were added.

        Raises `ObjectNotFound`: there is no object of one of the names. `CatalogError`: its enrollment is unfinished.
        """
        with self.catalog.reading() as state:
            used = state.used(checked=True)
            if self.names:
                named = {known.object_id: known for known in map(state.find, dict.fromkeys(self.names))}
                enrolled = {one.object_id for one in used}
                for object_id, known in named.items():
                    if object_id not in enrolled:
                        raise _not_enrolled(state, known)
                used = [one for one in used if one.object_id in named]
            names: set[str] = set()
            for one in used:
                line = state.objects[one.object_id]
                (found,) = state.enrollments(Enrollment.id == one.enrollment_id)
                item = TransferItem(
                    *(one.name, line.label or "", line.note or "", line.created_utc or line.time_utc),
                    *(found.enrollment, found.finished_utc),
                )
                _check(item)
                if item.name in names:
                    raise damaged("the name of two objects", item.name)
                names.add(item.name)
                yield item


def _not_enrolled(state: State, known: ObjectLine) -> CatalogError:
    """Return the error for an object without a complete enrollment: it is unfinished, or was abandoned."""
    name = str(known.object_name)
    if state.of_status(known, EnrollmentStatus.IN_PROGRESS) is not None:
        return CatalogError(f"The enrollment of {name!r} is unfinished.", next_step=Do.CONTINUE_ENROLLMENT(name=name))
    return CatalogError(f"The enrollment of {name!r} was abandoned.", next_step=Do.ENROLL(name=name))


def _check(item: TransferItem) -> None:
    """Raise `CatalogDamaged` if this program would not have stored an object. Its digests are those of its rows."""
    by = [session.provenance for session in item.enrollment.sessions]
    try:
        if clean_name(item.name) != item.name:
            raise damaged("the name of an object", item.name)
        for text in (item.label, item.note, *(text for one in by for text in (one.bench, one.software))):
            check_text(text, "text")
    except UsageError as error:
        raise damaged(error.what.rstrip("."), item.name) from error


@dataclass(frozen=True, slots=True)
class Transferred:
    """What was transferred, left out and replaced."""

    objects: int
    views: int
    bytes: int
    skipped: tuple[str, ...]
    replaced: tuple[str, ...]
    rejected: tuple[RejectedFile, ...]


def transfer(
    source: TransferSource,
    target: Catalog,
    *,
    conflict: Conflict = Conflict.REJECT,
    label: str | None = None,
    descriptors: Sequence[str] = (),
    jobs: int | None = None,
    dry_run: bool = False,
    once: bool = False,
) -> Generator[JobProgress, None, Transferred]:
    """Transfer objects into a catalog, all or nothing; it yields its progress in images.

    Each object comes with the enrollment that searches use. If the target has it already, by its key, it is not added
    a second time. Of photographs, those that cannot be used are left out; of a catalog, nothing is transferred if one
    image is wrong.

    New objects that have no label get this ``label``. The ``descriptors`` are computed at once, unless the source is
    this bench's own; others when they are needed. ``jobs`` is the number of processes; None is one for each core.
    ``dry_run`` only checks everything. With ``once`` an enrollment is delivered: it stays as the target has it, even if
    it was deleted or replaced there, and what was computed from it goes with it.

    Raises `UsageError`: the label cannot be stored. `ImportRejected`: nothing is left to transfer, or an image of a
    catalog was rejected. `ObjectExists`: some objects are in the catalog already, and conflicts are rejected.
    """
    checked_texts(label, None)
    catalog = source if isinstance(source, CatalogSource) else None
    strict = catalog is not None

    # Check all rows, then all images; those of the bench's own catalog are compared with their names when they are
    # stored.
    plan = _Plan(tuple(source.items()))
    with target.reading() as state:
        plan = plan.compared(state, conflict, once=once)
    enrollments = {item.name: item.enrollment for item in plan.wanted}
    if catalog is not None and catalog.own:
        found = {
            name: ReadImages({image: (image, size) for image, size in images_of(one)})
            for name, one in enrollments.items()
        }
    else:
        options = {"are_named": strict, "strict": strict and not dry_run}
        found = yield from read_images(source.content, enrollments, tuple(descriptors), **options, jobs=jobs)
    images = {image: known for one in found.values() for image, known in one.images.items()}
    unusable = {image: file for one in found.values() for image, file in one.rejected.items()}
    rejected = (*source.rejected, *unusable.values())
    if strict and rejected:
        raise _rejection(source, rejected)
    plan = replace(plan, wanted=_kept(plan.wanted, found, are_photographs=not strict))
    tables = {session.empty_table for one in enrollments.values() for session in one.sessions}
    if (unusable and not plan.wanted) or not tables.isdisjoint(unusable):
        raise _rejection(source, rejected)

    # Store the images, now that all of them are right. Then add all rows.
    if not dry_run:
        store = target.database.images
        with target.database.catalog_errors():
            if lost := (yield from store_images(source.content, store, images)):
                raise _rejection(source, lost)
        with target.writing() as state:
            plan = plan.compared(state, conflict, once=once)  # another process may have added objects
            missing = store.missing({name for name, _ in images.values()})
            for image, (name, _) in images.items():
                if name in missing:  # `collect_garbage` removed it: an object that was deleted had it, too
                    content = checked(source.content, image, name)
                    if isinstance(content, RejectedFile):
                        raise _rejection(source, [content])
                    store.put(content)
            if plan.wanted:
                new = _add(state, plan, label)
                details: dict[str, Any] = {"origin": source.origin, "objects": plan.names, "views": plan.views}
                details["replaced"] = list(plan.replaced)
                state.append(Action.IMPORTED, None, details=details)
                rows = [
                    describing.row_of(seal_of(enrollment), what, content)
                    for name, enrollment in new.items()
                    for what, content in found[name].contents.items()
                ]
                if once and catalog is not None:
                    rows += _computed(catalog.catalog, new.values())
                describing.add(state.transaction, rows)
    counts = (len(plan.wanted), plan.views, plan.bytes)
    return Transferred(*counts, plan.skipped, plan.replaced, rejected)


def _rejection(source: TransferSource, rejected: Sequence[RejectedFile]) -> RigError:
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


def _kept(
    items: Sequence[TransferItem], found: Mapping[str, ReadImages], *, are_photographs: bool
) -> tuple[TransferItem, ...]:
    """Return new rows of objects with the stored images, without the views whose images were rejected."""
    new = (replace(one, enrollment=_new(one, found[one.name].images, are_photographs)) for one in items)
    return tuple(one for one in new if one.enrollment.views)


def _new(item: TransferItem, images: Mapping[str, tuple[str, int]], is_photographed: bool) -> Enrollment:
    """Return new rows of an enrollment. Photographs have no key: it is the digest of what they are."""
    old = item.enrollment
    good = [view for view in old.views if view.image in images]
    plan, key = old.planned_azimuth_deg, old.key
    if is_photographed:
        plan = tuple(old.planned_azimuth_deg[view.index] for view in good)
        tables = [images.get(session.empty_table or "") for session in old.sessions]
        shown = [(view.azimuth_deg, images[view.image], view.region) for view in good]
        key = sha256_of((item.name, *shown, *([tables] if any(tables) else [])))
    new = Enrollment(key=key, object_id=0, started_utc=old.started_utc, planned_azimuth_deg=plan)
    for session in old.sessions:
        part = same_session(session)
        if (table := images.get(part.empty_table or "")) is not None:
            part.empty_table, part.empty_table_bytes = table
        new.sessions.append(part)
    for place, view in enumerate(good):
        copy = same_view(view)
        copy.index = place if is_photographed else view.index
        copy.image, copy.image_bytes = images[view.image]
        new.views.append(copy)
    digest(new, key)
    return new


def same_session(session: Session) -> Session:
    """Return a new row for a session of another enrollment."""
    return Session(**{name: getattr(session, name) for name in _OF_SESSION})


def same_view(view: View) -> View:
    """Return a new row for a view of another enrollment."""
    copy = View(**{name: getattr(view, name) for name in _OF_VIEW})
    copy.session = view.session
    return copy


def digest(enrollment: Enrollment, key: str) -> None:
    """Give an enrollment its key, and its rows their digests."""
    enrollment.key = key
    parts: tuple[Enrollment | Session | View, ...] = (enrollment, *enrollment.sessions, *enrollment.views)
    for part in parts:
        part.digest = digest_of(part, key)


# What the target has already


@dataclass(frozen=True, slots=True)
class _Plan:
    """The objects to add, and the names of those that are left out and that get new enrollments.

    ``named`` are the states of objects of the target by their names, ``known`` its enrollments by their keys.
    """

    wanted: tuple[TransferItem, ...]
    skipped: tuple[str, ...] = ()
    replaced: tuple[str, ...] = ()
    named: Mapping[str | None, ObjectLine] = field(default_factory=dict)
    known: Mapping[str, EnrollmentState] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        return [item.name for item in self.wanted]

    @property
    def views(self) -> int:
        return sum(len(item.enrollment.views) for item in self.wanted)

    @property
    def bytes(self) -> int:
        """Sizes of all images, each once."""
        return sum({image: size for item in self.wanted for image, size in images_of(item.enrollment)}.values())

    def compared(self, state: State, conflict: Conflict, *, once: bool) -> "_Plan":
        """Return the plan after a comparison with the target. `ObjectExists` if a conflict is rejected."""
        known = {
            one.enrollment.key: one
            for part in portions([item.enrollment.key for item in self.wanted], digests.AT_ONCE)
            for one in state.enrollments(Enrollment.key.in_(part))
        }
        in_use = state.in_use()
        wanted_names = set(self.names)
        named: dict[str | None, ObjectLine] = {
            line.object_name: line for line in in_use if line.object_name in wanted_names
        }
        check_lines(state.transaction, named.values())
        used = {line.object_id for line in in_use}

        def is_there(item: TransferItem) -> bool:
            """Return whether the target has the enrollment, and an object of this name has it in use."""
            there = known.get(item.enrollment.key)
            if there is None or once:
                return there is not None
            owner, own = there.enrollment.object_id, named.get(item.name)
            is_used = own is None or (owner == own.object_id and there.status is EnrollmentStatus.COMPLETE)
            return owner in used and is_used and _are_equal(there.enrollment, item.enrollment)

        wanted = [item for item in self.wanted if not is_there(item)]
        both = [item.name for item in wanted if item.name in named]
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
        left = [item for item in wanted if conflict is Conflict.REPLACE or item.name not in named]
        kept = {item.name for item in left}
        skipped = (*self.skipped, *(item.name for item in self.wanted if item.name not in kept))
        return _Plan(tuple(left), skipped, tuple(both) if conflict is Conflict.REPLACE else (), named, known)


# Add


def _add(state: State, plan: _Plan, label: str | None) -> dict[str, Enrollment]:
    """Add the rows of objects, and a line of the log for each enrollment; return the new ones by name."""
    new = {}
    for item in plan.wanted:
        known = plan.named.get(item.name)
        object_id = state.id_of(known)
        enrollment, there = item.enrollment, plan.known.get(item.enrollment.key)
        if there is not None and there.enrollment.object_id == object_id and _are_equal(there.enrollment, enrollment):
            enrollment = there.enrollment  # an earlier one of the object: it comes into use again
        else:
            if there is not None:  # with other views, or of an object that is deleted or has another name
                digest(enrollment, secrets.token_hex(32))
            new[item.name] = add_rows(state.transaction, enrollment, object_id)
        if known is not None:
            state.end_current(known, EnrollmentStatus.COMPLETE)
        columns = ending(EnrollmentState(enrollment, EnrollmentStatus.COMPLETE, item.finished_utc))
        if known is None:
            columns |= new_columns(item.created_utc, {"label": item.label or label or "", "note": item.note})
        state.append(Action.IMPORTED, item.name, **columns)
    return new


def _are_equal(one: Enrollment, other: Enrollment) -> bool:
    """Return whether two enrollments with one key have the same views; photographs have a new time at each import."""
    return [view.digest for view in one.views] == [view.digest for view in other.views]


def add_rows(transaction: Transaction, enrollment: Enrollment, object_id: int) -> Enrollment:
    """Add the rows of an enrollment to an object."""
    enrollment.object_id = object_id
    views = list(enrollment.views)
    enrollment.views.clear()
    transaction.add(enrollment)
    transaction.flush()  # the views refer to the sessions
    rows = [{name: getattr(view, name) for name in (*_OF_VIEW, "session", "digest")} for view in views]
    if rows:
        transaction.execute(insert(View), [{"enrollment_id": enrollment.id, **row} for row in rows])
    transaction.expunge(enrollment)
    enrollment.views = views
    return enrollment


def _computed(source: Catalog, new: Iterable[Enrollment]) -> list[dict[str, Any]]:
    """Return the rows of what the catalog ``source`` has computed from these enrollments."""
    rows: list[dict[str, Any]] = []
    with source.database.read() as reading:
        for part in portions(map(seal_of, new), digests.AT_ONCE):
            found = reading.execute(select(Derived.__table__).where(Derived.seal.in_(part)))
            rows += map(dict, found.mappings())
    return rows
