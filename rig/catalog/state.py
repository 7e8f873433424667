"""The state of a catalog, which follows from its log: the objects in use, their names, and their enrollments.

The last line that gives an object a state counts, and the last line that gives an enrollment a status. No other module
says which these are.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from difflib import get_close_matches
from hashlib import sha256
from typing import Any, Final

from sqlalchemy import ColumnElement, and_, bindparam, exists, false, func, or_, select, true, union
from sqlalchemy.orm import Session as Transaction
from sqlalchemy.orm import aliased, selectinload

from rig.catalog import digests, log
from rig.catalog.columns import damaged
from rig.catalog.facts import Action, Enrollment, Entry, View, damaged_parts, digest_of, seal_of
from rig.catalog.facts import Session as EnrollmentSession
from rig.catalog.jobs import portions
from rig.catalog.records import EnrollmentStatus, clean_name, is_plan
from rig.core.clock import Clock
from rig.core.errors import CatalogDamaged, CatalogError, ObjectExists, ObjectNotFound
from rig.core.next_steps import Do

COLLECTED: Final = "enrollments"
"""Key of the record of a line `Action.GARBAGE_COLLECTED`: the ids of the removed enrollments."""

Named = aliased(Entry, name="named")
"""The line that gives an object its present state."""
Ended = aliased(Entry, name="ended")
"""The line that gives an enrollment its present status."""
_Later = aliased(Entry, name="later")


def _is_last(entry: type[Entry], key: str, sets: str) -> ColumnElement[bool]:
    """Return the condition that no later line of the same object or enrollment sets the column ``sets``, too."""
    later = exists(1).where(
        getattr(_Later, key) == getattr(entry, key), getattr(_Later, sets).is_not(None), _Later.id > entry.id
    )
    return and_(getattr(entry, sets).is_not(None), ~later)


CURRENT: Final = {
    EnrollmentStatus.COMPLETE: (EnrollmentStatus.SUPERSEDED, Action.ENROLLMENT_SUPERSEDED),
    EnrollmentStatus.IN_PROGRESS: (EnrollmentStatus.ABANDONED, Action.ENROLLMENT_ABANDONED),
}
"""An object has one enrollment of each such status. What becomes of it if it gets another one."""

IS_STATE = _is_last(Named, "object_id", "deleted")
IS_STATUS = _is_last(Ended, "enrollment_id", "status")
IN_USE = and_(IS_STATE, Named.deleted == false())
# Statements that many others ask for: to build one takes longer than to execute it.
_BY_ID = select(Named).where(IS_STATE, Named.object_id == bindparam("object_id"))
_FOLD = select(Named.id).where(IS_STATE), select(Ended.id).where(IS_STATUS)
_USED = (
    select(Named.object_id, Named.object_name, Ended.enrollment_id, Ended.seal, Enrollment.id)
    .join(Ended, Ended.object_id == Named.object_id)
    .outerjoin(Enrollment, Enrollment.id == Ended.enrollment_id)
    .where(IN_USE, IS_STATUS, Ended.status == EnrollmentStatus.COMPLETE)
    .order_by(Named.object_id)
)
_OWNED = (
    select(Enrollment.id, Ended.seal, Enrollment.object_id, Ended.object_id, Named.object_name)
    .select_from(Enrollment)
    .outerjoin(Ended, and_(Ended.enrollment_id == Enrollment.id, IS_STATUS))
    .outerjoin(Named, and_(Named.object_id == Enrollment.object_id, IS_STATE))
    .order_by(Enrollment.id)
)


@dataclass(frozen=True, slots=True)
class ObjectSummary:
    """An object: the number of views of its complete enrollment, and of an unfinished one (None if there is none)."""

    name: str
    label: str
    note: str
    created_utc: datetime
    enrolled_utc: datetime | None
    views: int
    unfinished_views: int | None
    deleted_utc: datetime | None = None


@dataclass(frozen=True, slots=True, eq=False)
class EnrollmentState:
    """An enrollment with its present status; ``seal`` is that of a complete one, and of an earlier one."""

    enrollment: Enrollment
    status: EnrollmentStatus
    finished_utc: datetime | None
    seal: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ObjectDetails:
    """An object with its enrollments, newest first."""

    summary: ObjectSummary
    enrollments: tuple[EnrollmentState, ...]

    @property
    def complete(self) -> Enrollment | None:
        """The enrollment that searches use."""
        return next((one.enrollment for one in self.enrollments if one.status is EnrollmentStatus.COMPLETE), None)

    @property
    def views(self) -> Sequence[View]:
        """The views of that enrollment, by index."""
        return () if self.complete is None else self.complete.views


@dataclass(frozen=True, slots=True)
class Used:
    """A complete enrollment of an object in use: what searches compare with."""

    object_id: int
    name: str
    enrollment_id: int
    seal: str


def used(transaction: Transaction, *, checked: bool = False) -> list[Used]:
    """Return the enrollments that searches use, in the order in which their objects were added.

    Raises `CatalogDamaged`: they are ``checked``, and the name or the seal of an object is not as it was written.
    """
    rows = transaction.execute(_USED).all()
    if checked:
        check_fold(transaction)
    owners = Counter(row[0] for row in rows)
    # An enrollment is missing, or no program wrote this.
    if wrong := [str(row[1]) for row in rows if None in row or owners[row[0]] > 1]:
        raise changed(wrong)
    found: Sequence[Sequence[Any]] = rows
    return [Used(*row[:4]) for row in found]


def first_views(transaction: Transaction, *columns: Any) -> list[Any]:
    """Return these columns of the first view of each enrollment that searches use."""
    ids = sorted(one.enrollment_id for one in used(transaction))
    wanted = select(*columns).where(View.index == 0).order_by(View.enrollment_id)
    return [
        row for part in portions(ids, 500) for row in transaction.execute(wanted.where(View.enrollment_id.in_(part)))
    ]


def version(transaction: Transaction) -> str:
    """Return a digest of what searches compare with: the names of the objects and the seals of their enrollments."""
    return sha256(ascii([(one.name, one.seal) for one in used(transaction)]).encode()).hexdigest()


def check_fold(transaction: Transaction) -> None:
    """Raise `CatalogDamaged` if a line that gives a present state or status is missing or not as it was written."""
    log.check_complete(transaction)
    check_lines(transaction, {line for lines in _FOLD for line in transaction.scalars(lines)})


def check_lines(transaction: Transaction, ids: Collection[int]) -> None:
    """Raise `CatalogDamaged` if one of these lines of the log is not as it was written."""
    if wrong := digests.wrong_lines(transaction, ids):
        raise changed(list(map(str, transaction.scalars(select(Entry.object_name).where(Entry.id.in_(wrong[:20]))))))


def changed(names: Sequence[str]) -> CatalogDamaged:
    """Return the error that objects are not as they were stored."""
    shown = list(dict.fromkeys(names))
    return CatalogDamaged(
        f"{', '.join(map(repr, shown[:3]))}{' and others' if len(shown) > 3 else ''} in the catalog changed after they "
        "were stored.",
        next_step=(Do.VERIFY_CATALOG(), "Then use a backup, or delete these objects and enroll them again."),
        evidence={"objects": shown[:20]},
    )


def find(transaction: Transaction, name: str, *, deleted: bool = False) -> Entry:
    """Return the state of an object in use, or of the last ``deleted`` one that is still stored.

    Raises `ObjectNotFound`: there is no such object. The next step lists similar names.
    """
    name = clean_name(name)
    among = _among(deleted)
    found = transaction.scalar(
        select(Named).where(Named.object_name == name, *among).order_by(Named.id.desc()).limit(1)
    )
    if found is not None:
        check_lines(transaction, [found.id])
        return found
    check_fold(transaction)  # its name or its state may have been changed
    by_folded = {str(known).casefold(): known for known in transaction.scalars(select(Named.object_name).where(*among))}
    near = [by_folded[folded] for folded in get_close_matches(name.casefold(), by_folded)]
    state = "deleted object" if deleted else "object"
    raise ObjectNotFound(
        f"There is no {state} {name!r} in the catalog.",
        next_step=f"Did you mean {' or '.join(map(repr, near))}?" if near else Do.LIST_OBJECTS(deleted=deleted),
        evidence={"near": near},
    )


def _among(deleted: bool) -> list[ColumnElement[bool]]:
    """Return the conditions for the objects in use; or for the deleted ones that `collect_garbage` has not removed."""
    if not deleted:
        return [IN_USE]
    return [IS_STATE, Named.deleted == true(), exists(1).where(Enrollment.object_id == Named.object_id)]


def state_of(transaction: Transaction, name: str) -> Entry | None:
    """Return the state of the object in use with this name, which is clean; None if there is none."""
    found = transaction.scalar(select(Named).where(Named.object_name == name, IN_USE))
    if found is not None:
        check_lines(transaction, [found.id])
    return found


def by_id(transaction: Transaction, object_id: int | None) -> Entry:
    """Return the state of an object, in use or deleted."""
    found = transaction.scalar(_BY_ID, {"object_id": object_id})
    if found is None:
        raise damaged("the owner of an enrollment", object_id)
    check_lines(transaction, [found.id])
    return found


def new_columns(created_utc: datetime, texts: Mapping[str, str]) -> dict[str, Any]:
    """Return the columns of the line of the log that adds an object."""
    return {"label": "", "note": "", "deleted": False, "created_utc": created_utc, **texts}


def columns(known: Entry, texts: Mapping[str, str] | None = None, *, deleted: bool = False) -> dict[str, Any]:
    """Return the columns of a line of the log that gives a known object this state; other texts stay as they are."""
    own = {"label": known.label or "", "note": known.note or "", "created_utc": known.created_utc}
    return {**own, "object_id": known.object_id, "deleted": deleted, **(texts or {})}


def check_free(transaction: Transaction, name: str) -> None:
    """Raise `ObjectExists` if an object in use has this name."""
    if state_of(transaction, name) is not None:
        raise ObjectExists(
            f"There is another object {name!r} in the catalog.",
            next_step=("Choose another name, or", Do.RENAME(name=name)),
        )


def summaries(transaction: Transaction, *, deleted: bool = False, object_id: int | None = None) -> list[ObjectSummary]:
    """Return the objects in use or the deleted ones, or one object, in the order in which they were added."""
    conditions = _among(deleted) if object_id is None else [IS_STATE, Named.object_id == object_id]
    count = select(func.count()).where(View.enrollment_id == Ended.enrollment_id).correlate(Ended).scalar_subquery()
    columns = (
        *(Named.id, Named.object_id, Named.object_name, Named.label, Named.note),
        *(Named.created_utc, Named.time_utc, Named.deleted),
    )
    states = transaction.execute(select(*columns).where(*conditions).order_by(Named.object_id)).all()
    # Two statements for all objects together, and not one for each object.
    planned = func.json_array_length(Enrollment.planned_azimuth_deg)
    wanted = (
        select(Ended.object_id, Ended.status, Ended.finished_utc, count, planned, Ended.id)
        .outerjoin(Enrollment, Enrollment.id == Ended.enrollment_id)
        .where(
            or_(Enrollment.id.is_not(None), Ended.status == EnrollmentStatus.COMPLETE),  # or it was discarded
            IS_STATUS,
            Ended.status.in_([EnrollmentStatus.COMPLETE, EnrollmentStatus.IN_PROGRESS]),
        )
    )
    if object_id is not None:
        wanted = wanted.where(Ended.object_id == object_id)
    current = {(row[0], row[1]): row[2:] for row in transaction.execute(wanted)}
    if object_id is None:
        check_fold(transaction)
    else:
        log.check_complete(transaction)
        check_lines(transaction, {one.id for one in states} | {row[3] for row in current.values()})
    found = []
    for one in states:
        enrolled_utc, views, planned_views, _ = current.get((one.object_id, EnrollmentStatus.COMPLETE), (None, 0, 0, 0))
        _, unfinished, _, _ = current.get((one.object_id, EnrollmentStatus.IN_PROGRESS), (None, None, None, None))
        # A complete enrollment whose views are gone was changed from outside.
        if views != planned_views:
            raise changed([str(one.object_name)])
        found.append(
            ObjectSummary(
                name=str(one.object_name),
                label=one.label or "",
                note=one.note or "",
                created_utc=one.created_utc or one.time_utc,
                enrolled_utc=enrolled_utc,
                views=views,
                unfinished_views=unfinished,
                deleted_utc=one.time_utc if one.deleted else None,
            )
        )
    return found


def of_object(object_id: int | None) -> ColumnElement[bool]:
    """Return the condition for the enrollments of an object: by their own rows, and by the log."""
    own = select(Enrollment.id).where(Enrollment.object_id == object_id)
    logged = select(_Later.enrollment_id).where(_Later.object_id == object_id, _Later.status.is_not(None))
    return Ended.enrollment_id.in_(union(own, logged))


def enrollments(transaction: Transaction, *conditions: ColumnElement[bool]) -> list[EnrollmentState]:
    """Return enrollments with their sessions and views, newest first, all as they were written."""
    wanted = (
        select(Enrollment, Ended)
        .join(Ended, Ended.enrollment_id == Enrollment.id)
        .where(IS_STATUS, *conditions)
        .options(selectinload(Enrollment.sessions), selectinload(Enrollment.views))
        .order_by(Enrollment.id.desc())
        .execution_options(populate_existing=True)
    )
    rows = transaction.execute(wanted).all()
    check_lines(transaction, [ended.id for _, ended in rows])
    for enrollment, ended in rows:
        if damaged_parts(enrollment, ended.seal) or not is_possible(enrollment, ended):
            raise changed([str(by_id(transaction, enrollment.object_id).object_name)])
    transaction.expunge_all()
    return [
        EnrollmentState(one, ended.status, ended.finished_utc, ended.seal)
        for one, ended in rows
        if ended.status is not None
    ]


def missing_enrollments(transaction: Transaction, object_id: int | None = None) -> dict[int, str | None]:
    """Return the enrollments, of one object or of all, that are in the log only, although this program removed none.

    By their ids, with the names of their objects.
    """
    lines = select(Entry.enrollment_id, Entry.object_name).where(Entry.status.is_not(None))
    if object_id is not None:
        lines = lines.where(Entry.object_id == object_id)
    names = {number: name for number, name in transaction.execute(lines) if number is not None}
    ids = select(Enrollment.id)
    present = set(transaction.scalars(ids if object_id is None else ids.where(Enrollment.object_id == object_id)))
    if names.keys() <= present:
        return {}
    removals = select(Entry).where(Entry.action.in_((Action.ENROLLMENT_DISCARDED, Action.GARBAGE_COLLECTED)))
    for line in transaction.scalars(removals):
        collected = (line.record or {}).get(COLLECTED)
        present |= {one for one in collected if isinstance(one, int)} if isinstance(collected, list) else set()
        present |= {line.enrollment_id or 0}
    return {number: names[number] for number in sorted(names.keys() - present)}


def check_present(transaction: Transaction, object_id: int | None = None) -> None:
    """Raise `CatalogDamaged` if an enrollment, of one object or of any, is missing."""
    if names := missing_enrollments(transaction, object_id).values():
        raise changed([str(name) for name in dict.fromkeys(names)])


def is_possible(enrollment: Enrollment, ended: Entry) -> bool:
    """Return whether an enrollment refers to its own rows only, and has values that this program stores.

    A sender can give any values the right digests.
    """
    sessions, plan = range(len(enrollment.sessions)), enrollment.planned_azimuth_deg
    is_complete = ended.status == EnrollmentStatus.COMPLETE
    return (
        is_plan(plan)
        and ended.object_id == enrollment.object_id
        and (ended.finished_utc is None) == (ended.status == EnrollmentStatus.IN_PROGRESS)
        and not (is_complete and enrollment.missing)
        and [session.number for session in enrollment.sessions] == list(sessions)
        and all((one.empty_table is None) == (one.empty_table_bytes is None) for one in enrollment.sessions)
        and all(
            not view.problem and view.index < len(plan) and view.session in sessions and view.image_bytes > 0
            for view in enrollment.views
        )
    )


def view(transaction: Transaction, view_id: int) -> View:
    """Return one view; a `CatalogError` if there is none, or it is not as it was written."""
    found = transaction.get(View, view_id)
    if found is None:
        raise CatalogError(f"There is no view {view_id} in the catalog.", next_step="Load the views again.")
    _check_part(transaction, found, f"view {view_id}")
    return found


def session(transaction: Transaction, enrollment_id: int, number: int) -> EnrollmentSession:
    """Return a session of an enrollment; a `CatalogDamaged` if it is missing or not as it was written."""
    found = transaction.get(EnrollmentSession, (enrollment_id, number))
    if found is None:
        raise damaged("a session of an enrollment", None)
    _check_part(transaction, found, f"the session of {found.started_utc:%Y-%m-%d %H:%M}")
    return found


def _check_part(transaction: Transaction, part: View | EnrollmentSession, name: str) -> None:
    key = transaction.scalar(select(Enrollment.key).where(Enrollment.id == part.enrollment_id))
    if part.digest != digest_of(part, str(key)):
        raise changed([name])


def unfinished(transaction: Transaction, state: Entry) -> EnrollmentState:
    """Return the unfinished enrollment of an object; a `CatalogError` if there is none."""
    found = of_status(transaction, state, EnrollmentStatus.IN_PROGRESS)
    if found is None:
        raise CatalogError(
            f"{state.object_name!r} has no unfinished enrollment.", next_step=Do.ENROLL(name=str(state.object_name))
        )
    return found


def of_status(transaction: Transaction, state: Entry, status: EnrollmentStatus) -> EnrollmentState | None:
    """Return the enrollment of an object that is complete or in progress; None if there is none."""
    return next(iter(enrollments(transaction, of_object(state.object_id), Ended.status == status)), None)


def ending(one: EnrollmentState) -> dict[str, Any]:
    """Return the columns of a line of the log that gives an enrollment its status."""
    enrollment, has_ended = one.enrollment, one.status in (EnrollmentStatus.COMPLETE, EnrollmentStatus.SUPERSEDED)
    return {
        "object_id": enrollment.object_id,
        "enrollment_id": enrollment.id,
        "status": one.status,
        "finished_utc": one.finished_utc,
        "seal": seal_of(enrollment) if has_ended else None,
        "details": {"enrollment_id": enrollment.id, "views": len(enrollment.views)},
    }


def end_current(transaction: Transaction, clock: Clock, known: Entry, status: EnrollmentStatus) -> None:
    """End the enrollment of an object that is complete or in progress, if there is one: another one replaces it."""
    before = of_status(transaction, known, status)
    if before is not None:
        ended, action = CURRENT[status]
        one = replace(before, status=ended, finished_utc=before.finished_utc or clock.utc())
        log.append(transaction, clock, action, known.object_name, **ending(one))


def check_not_enrolled(transaction: Transaction, state: Entry) -> None:
    """Raise an error if an object is enrolled, or its enrollment has begun."""
    name = str(state.object_name)
    if (begun := of_status(transaction, state, EnrollmentStatus.IN_PROGRESS)) is not None:
        raise CatalogError(
            f"The enrollment of {name!r} is unfinished, with {len(begun.enrollment.views)} of "
            f"{len(begun.enrollment.planned_azimuth_deg)} views.",
            next_step=(Do.CONTINUE_ENROLLMENT(name=name), "Or", Do.ENROLL_AGAIN(name=name)),
        )
    if (done := of_status(transaction, state, EnrollmentStatus.COMPLETE)) is not None:
        raise ObjectExists(
            f"{name!r} is enrolled already, with {len(done.enrollment.views)} views.",
            next_step=(
                "Choose another name, or",
                Do.ENROLL_AGAIN(name=name),
                "The old views stay in use until the new ones are complete.",
            ),
        )


def check(transaction: Transaction) -> None:
    """Raise `CatalogDamaged` if objects or enrollments are not as they were written."""
    check_fold(transaction)
    if wrong := damaged_enrollments(transaction):
        raise changed([str(name) for name in wrong.values()])
    used(transaction)


def damaged_enrollments(transaction: Transaction, ids: Collection[int] | None = None) -> dict[int, str | None]:
    """Return which enrollments, of these or of all, are not as they were written, with the names of their objects."""
    rows = transaction.execute(_OWNED if ids is None else _OWNED.where(Enrollment.id.in_(ids))).all()
    wrong = set(digests.damaged_enrollments(transaction, {number: seal for number, seal, *_ in rows}))
    return {number: name for number, _, owner, in_log, name in rows if number in wrong or owner != in_log}
