"""The state of a catalog, a fold over its log: the objects in use, their names, and their enrollments.

The last line that gives an object a state counts, and the last line that gives an enrollment a status. No other module
says which these are.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from difflib import get_close_matches
from functools import cached_property
from hashlib import sha256
from typing import Any, Final, NamedTuple

from sqlalchemy import ColumnElement, Select, func, or_, select
from sqlalchemy.orm import InstrumentedAttribute, selectinload
from sqlalchemy.orm import Session as Transaction

from rig.catalog import digests, log
from rig.catalog.columns import damaged
from rig.catalog.facts import Action, Enrollment, Entry, View, digest_of, seal_of
from rig.catalog.facts import Session as EnrollmentSession
from rig.catalog.jobs import portions
from rig.catalog.records import EnrollmentStatus, clean_name, is_plan
from rig.core.clock import Clock
from rig.core.errors import CatalogDamaged, CatalogError, ObjectExists, ObjectNotFound
from rig.core.next_steps import Do

COLLECTED: Final = "enrollments"
"""Key of the record of a line `Action.GARBAGE_COLLECTED`: the ids of the removed enrollments."""

CURRENT: Final = {
    EnrollmentStatus.COMPLETE: (EnrollmentStatus.SUPERSEDED, Action.ENROLLMENT_SUPERSEDED),
    EnrollmentStatus.IN_PROGRESS: (EnrollmentStatus.ABANDONED, Action.ENROLLMENT_ABANDONED),
}
"""An object has one enrollment of each such status. What becomes of it if it gets another one."""


class ObjectLine(NamedTuple):
    """What a line of the log says about the state of an object."""

    id: int
    object_id: int
    object_name: str | None
    label: str | None
    note: str | None
    created_utc: datetime | None
    time_utc: datetime
    deleted: bool


class StatusLine(NamedTuple):
    """What a line of the log says about the status of an enrollment."""

    id: int
    enrollment_id: int
    object_id: int
    object_name: str | None
    status: EnrollmentStatus
    finished_utc: datetime | None
    seal: str | None


def _last_lines(
    kind: type[NamedTuple],
    sets: InstrumentedAttribute[Any],
    of: InstrumentedAttribute[Any],
    *conditions: ColumnElement[bool],
) -> Select[Any]:
    """Return the last lines of the log that set this column, of each object or enrollment, or of some of them.

    Only these columns are read: an object of each whole line takes several times as long.
    """
    last = select(func.max(Entry.id)).where(sets.is_not(None), *conditions).group_by(of)
    return select(*(getattr(Entry, name) for name in kind._fields)).where(Entry.id.in_(last)).order_by(of)


# Statements that many others ask for: to build one takes longer than to execute it.
_STATES: Final = _last_lines(ObjectLine, Entry.deleted, Entry.object_id)
_STATUSES: Final = _last_lines(StatusLine, Entry.status, Entry.enrollment_id)


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


class Used(NamedTuple):
    """A complete enrollment of an object in use: what searches compare with."""

    name: str
    object_id: int
    enrollment_id: int
    seal: str


class State:
    """The state of a catalog as a transaction sees it.

    Lines of the log are read when they are needed: with each view, a bench asks for one object and one enrollment only.
    They are as they are stored: a method compares those that it uses with their digests, unless it says otherwise.
    """

    def __init__(self, transaction: Transaction, clock: Clock) -> None:
        self.transaction, self._clock = transaction, clock

    @cached_property
    def objects(self) -> dict[int, ObjectLine]:
        """The lines that give each object its present state, by its id, in the order in which they were added."""
        return {row.object_id: ObjectLine(*row) for row in self.transaction.execute(_STATES)}

    @cached_property
    def statuses(self) -> dict[int, StatusLine]:
        """The lines that give each enrollment its present status, by its id."""
        return {row.enrollment_id: StatusLine(*row) for row in self.transaction.execute(_STATUSES)}

    def check(self) -> None:
        """Raise `CatalogDamaged` if a line of the state is missing or not as it was written."""
        log.check_complete(self.transaction)
        check_lines(self.transaction, (*self.objects.values(), *self.statuses.values()))

    def in_use(self) -> list[ObjectLine]:
        """Return the states of the objects in use, unchecked."""
        return [line for line in self.objects.values() if not line.deleted]

    def deleted(self) -> list[ObjectLine]:
        """Return the states of the deleted objects that `collect_garbage` has not removed, unchecked."""
        stored = set(self.transaction.scalars(select(Enrollment.object_id)))
        return [line for line in self.objects.values() if line.deleted and line.object_id in stored]

    # Objects

    def find(self, name: str, *, deleted: bool = False) -> ObjectLine:
        """Return the state of an object in use, or of the last ``deleted`` one that is still stored.

        Raises `ObjectNotFound`: there is no such object. The next step lists similar names.
        """
        name = clean_name(name)
        if not deleted and (found := self.named(name)) is not None:
            return found
        among = self.deleted() if deleted else self.in_use()
        if own := [line for line in among if line.object_name == name]:
            return self.by_id(max(own).object_id)
        self.check()  # its name or its state may have been changed
        by_folded = {str(line.object_name).casefold(): str(line.object_name) for line in among}
        near = [by_folded[folded] for folded in get_close_matches(name.casefold(), by_folded)]
        kind = "deleted object" if deleted else "object"
        raise ObjectNotFound(
            f"There is no {kind} {name!r} in the catalog.",
            next_step=f"Did you mean {' or '.join(map(repr, near))}?" if near else Do.LIST_OBJECTS(deleted=deleted),
            evidence={"near": near},
        )

    def named(self, name: str) -> ObjectLine | None:
        """Return the state of the object in use with this name, which is clean; None if there is none."""
        ids = select(Entry.object_id).where(Entry.object_name == name, Entry.deleted.is_not(None))
        lines = self._last_states(Entry.object_id.in_(ids))
        last = max((line for line in lines if line.object_name == name and not line.deleted), default=None)
        check_lines(self.transaction, [last] if last else [])
        return last

    def by_id(self, object_id: int | None) -> ObjectLine:
        """Return the state of an object, in use or deleted."""
        found = self._last_states(Entry.object_id == object_id)
        if not found:
            raise damaged("the owner of an enrollment", object_id)
        check_lines(self.transaction, found)
        return found[0]

    def status_of(self, enrollment_id: int) -> EnrollmentStatus | None:
        """Return the status of an enrollment, unchecked; None if there is none."""
        found = self._last_statuses(Entry.enrollment_id == enrollment_id).get(enrollment_id)
        return None if found is None else found.status

    def _last_states(self, *conditions: ColumnElement[bool]) -> list[ObjectLine]:
        wanted = _last_lines(ObjectLine, Entry.deleted, Entry.object_id, *conditions)
        return [ObjectLine(*row) for row in self.transaction.execute(wanted)]

    def id_of(self, known: ObjectLine | None) -> int:
        """Return the id of an object; for None that of the one which the next line of the log adds."""
        return known.object_id if known and known.object_id else log.head(self.transaction)[0] + 1

    def append(self, action: Action, object_name: str | None = None, **columns: Any) -> None:
        """Add a line to the log; this state stays as it was before."""
        log.append(self.transaction, self._clock, action, object_name, **columns)

    def check_free(self, name: str) -> None:
        """Raise `ObjectExists` if an object in use has this name."""
        if self.named(name) is not None:
            raise ObjectExists(
                f"There is another object {name!r} in the catalog.",
                next_step=("Choose another name, or", Do.RENAME(name=name)),
            )

    def summaries(self, states: Sequence[ObjectLine]) -> list[ObjectSummary]:
        """Return summaries of the objects with these states. All lines are checked."""
        self.check()
        return self._summaries(states, self.statuses.values())

    def summary(self, known: ObjectLine) -> ObjectSummary:
        """Return the summary of one object. The lines about it are checked."""
        statuses = self._statuses_of(known.object_id)
        log.check_complete(self.transaction)
        check_lines(self.transaction, [known, *statuses])
        ids = [line.enrollment_id for line in statuses]
        return self._summaries([known], statuses, ids)[0]

    def _summaries(
        self,
        states: Sequence[ObjectLine],
        statuses: Iterable[StatusLine],
        enrollment_ids: Collection[int] | None = None,
    ) -> list[ObjectSummary]:
        # Two statements for all objects together, and not one for each object.
        counts = select(View.enrollment_id, func.count()).group_by(View.enrollment_id)
        lengths = select(Enrollment.id, func.json_array_length(Enrollment.planned_azimuth_deg))
        if enrollment_ids is not None:
            counts = counts.where(View.enrollment_id.in_(enrollment_ids))
            lengths = lengths.where(Enrollment.id.in_(enrollment_ids))
        taken: dict[int | None, int] = dict(self.transaction.execute(counts).all())
        planned: dict[int | None, int] = dict(self.transaction.execute(lengths).all())
        current: dict[Any, StatusLine] = {(line.object_id, line.status): line for line in statuses}
        found = []
        for one in states:
            done = current.get((one.object_id, EnrollmentStatus.COMPLETE))
            begun = current.get((one.object_id, EnrollmentStatus.IN_PROGRESS))
            views = taken.get(done.enrollment_id, 0) if done is not None else 0
            # A complete enrollment whose views are gone was changed from outside.
            if done is not None and views != planned.get(done.enrollment_id):
                raise changed([str(one.object_name)])
            is_unfinished = begun is not None and begun.enrollment_id in planned  # or it was discarded
            found.append(
                ObjectSummary(
                    name=str(one.object_name),
                    label=one.label or "",
                    note=one.note or "",
                    created_utc=one.created_utc or one.time_utc,
                    enrolled_utc=None if done is None else done.finished_utc,
                    views=views,
                    unfinished_views=taken.get(begun.enrollment_id, 0) if begun and is_unfinished else None,
                    deleted_utc=one.time_utc if one.deleted else None,
                )
            )
        return found

    # Enrollments

    def used(self, *, checked: bool = False) -> list[Used]:
        """Return the enrollments that searches use, in the order in which their objects were added.

        Raises `CatalogDamaged`: they are ``checked``, and the name or the seal of an object is not as it was written.
        """
        if checked:
            self.check()
        present = set(self.transaction.scalars(select(Enrollment.id)))
        names = {line.object_id: line.object_name for line in self.in_use()}
        rows = [
            (names[line.object_id], line.object_id, line.enrollment_id, line.seal)
            for line in self.statuses.values()
            if line.status is EnrollmentStatus.COMPLETE and line.object_id in names
        ]
        owners = Counter(row[1] for row in rows)
        # An enrollment is missing, or no program wrote this.
        if wrong := [str(row[0]) for row in rows if None in row or row[2] not in present or owners[row[1]] > 1]:
            raise changed(wrong)
        found: list[Any] = rows
        return sorted((Used(*row) for row in found), key=lambda one: one.object_id)

    def version(self) -> str:
        """Return a digest of what searches compare with: the names of objects and the seals of their enrollments."""
        return sha256(ascii([(one.name, one.seal) for one in self.used()]).encode()).hexdigest()

    def first_views(self, *columns: Any) -> list[Any]:
        """Return these columns of the first view of each enrollment that searches use."""
        ids = sorted(one.enrollment_id for one in self.used())
        wanted = select(*columns).where(View.index == 0).order_by(View.enrollment_id)
        return [
            row
            for part in portions(ids, 500)
            for row in self.transaction.execute(wanted.where(View.enrollment_id.in_(part)))
        ]

    def enrollments(self, condition: ColumnElement[bool]) -> list[EnrollmentState]:
        """Return enrollments with their sessions and views, newest first, all as they were written."""
        wanted = (
            select(Enrollment)
            .where(condition)
            .options(selectinload(Enrollment.sessions), selectinload(Enrollment.views))
            .order_by(Enrollment.id.desc())
            .execution_options(populate_existing=True)
        )
        rows = self.transaction.scalars(wanted).all()
        known = self._last_statuses(Entry.enrollment_id.in_([one.id for one in rows]))
        endings = [known.get(one.id) for one in rows]
        check_lines(self.transaction, filter(None, endings))
        wrong = self.damaged_enrollments([one.id for one in rows]) if rows else {}
        found = []
        for enrollment, ended in zip(rows, endings, strict=True):
            if ended is None or ended.status is None or enrollment.id in wrong or not is_possible(enrollment, ended):
                raise changed([str(self.by_id(enrollment.object_id).object_name)])
            found.append(EnrollmentState(enrollment, ended.status, ended.finished_utc, ended.seal))
        self.transaction.expunge_all()
        return found

    def enrollments_of(self, object_id: int | None) -> list[EnrollmentState]:
        """Return the enrollments of an object: by their own rows, and by the log."""
        logged = [line.enrollment_id for line in self._statuses_of(object_id)]
        return self.enrollments(or_(Enrollment.object_id == object_id, Enrollment.id.in_(logged)))

    def of_status(self, known: ObjectLine, status: EnrollmentStatus) -> EnrollmentState | None:
        """Return the enrollment of an object that is complete or in progress; None if there is none."""
        own = [line.enrollment_id for line in self._statuses_of(known.object_id) if line.status is status]
        return next(iter(self.enrollments(Enrollment.id.in_(own))), None) if own else None

    def _last_statuses(self, *conditions: ColumnElement[bool]) -> dict[int, StatusLine]:
        wanted = _last_lines(StatusLine, Entry.status, Entry.enrollment_id, *conditions)
        return {row.enrollment_id: StatusLine(*row) for row in self.transaction.execute(wanted)}

    def _statuses_of(self, object_id: int | None) -> list[StatusLine]:
        """Return the lines that give the enrollments of an object their present status."""
        ids = select(Entry.enrollment_id).where(Entry.object_id == object_id, Entry.status.is_not(None))
        found = self._last_statuses(Entry.enrollment_id.in_(ids)).values()
        return [line for line in found if line.object_id == object_id]

    def unfinished(self, known: ObjectLine) -> EnrollmentState:
        """Return the unfinished enrollment of an object; a `CatalogError` if there is none."""
        found = self.of_status(known, EnrollmentStatus.IN_PROGRESS)
        if found is None:
            raise CatalogError(
                f"{known.object_name!r} has no unfinished enrollment.", next_step=Do.ENROLL(name=str(known.object_name))
            )
        return found

    def check_not_enrolled(self, known: ObjectLine) -> None:
        """Raise an error if an object is enrolled, or its enrollment has begun."""
        name = str(known.object_name)
        if (begun := self.of_status(known, EnrollmentStatus.IN_PROGRESS)) is not None:
            raise CatalogError(
                f"The enrollment of {name!r} is unfinished, with {len(begun.enrollment.views)} of "
                f"{len(begun.enrollment.planned_azimuth_deg)} views.",
                next_step=(Do.CONTINUE_ENROLLMENT(name=name), "Or", Do.ENROLL_AGAIN(name=name)),
            )
        if (done := self.of_status(known, EnrollmentStatus.COMPLETE)) is not None:
            raise ObjectExists(
                f"{name!r} is enrolled already, with {len(done.enrollment.views)} views.",
                next_step=(
                    "Choose another name, or",
                    Do.ENROLL_AGAIN(name=name),
                    "The old views stay in use until the new ones are complete.",
                ),
            )

    def end_current(self, known: ObjectLine, status: EnrollmentStatus) -> None:
        """End the enrollment of an object that is complete or in progress, if there is one: another replaces it."""
        before = self.of_status(known, status)
        if before is not None:
            ended, action = CURRENT[status]
            one = replace(before, status=ended, finished_utc=before.finished_utc or self._clock.utc())
            self.append(action, known.object_name, **ending(one))

    # Damage

    def damaged_enrollments(self, ids: Collection[int] | None = None) -> dict[int, str | None]:
        """Return which enrollments, of these or of all, are not as they were written, with the names of their objects.

        Lines of the log are not checked.
        """
        owners = select(Enrollment.id, Enrollment.object_id).order_by(Enrollment.id)
        rows = dict(self.transaction.execute(owners if ids is None else owners.where(Enrollment.id.in_(ids))).all())
        known = self.statuses if ids is None else self._last_statuses(Entry.enrollment_id.in_(rows))
        endings = {number: known.get(number) for number in rows}
        seals = {number: None if line is None else line.seal for number, line in endings.items()}
        wrong = set(digests.damaged_enrollments(self.transaction, seals))
        wrong |= {number for number, line in endings.items() if line is None or line.object_id != rows[number]}
        names = {number: line.object_name for number, line in self.objects.items()} if wrong else {}
        return {number: names.get(owner) for number, owner in rows.items() if number in wrong}

    def missing_enrollments(self, object_id: int | None = None) -> dict[int, str | None]:
        """Return the enrollments, of one object or of all, that are in the log only, but that no program removed.

        By their ids, with the names of their objects. Lines of the log are not checked.
        """
        lines = self.statuses.values() if object_id is None else self._statuses_of(object_id)
        names = {line.enrollment_id: line.object_name for line in lines if line.enrollment_id is not None}
        ids = select(Enrollment.id)
        present = set(self.transaction.scalars(ids if object_id is None else ids.where(Enrollment.id.in_(names))))
        if names.keys() <= present:
            return {}
        removals = select(Entry).where(Entry.action.in_((Action.ENROLLMENT_DISCARDED, Action.GARBAGE_COLLECTED)))
        for line in self.transaction.scalars(removals):
            collected = (line.record or {}).get(COLLECTED)
            present |= {one for one in collected if isinstance(one, int)} if isinstance(collected, list) else set()
            present |= {line.enrollment_id or 0}
        return {number: names[number] for number in sorted(names.keys() - present)}

    def check_present(self, object_id: int | None) -> None:
        """Raise `CatalogDamaged` if an enrollment of an object is missing."""
        if names := self.missing_enrollments(object_id).values():
            raise changed([str(name) for name in dict.fromkeys(names)])

    def check_everything(self) -> None:
        """Raise `CatalogDamaged` if objects or enrollments are not as they were written."""
        self.check()
        if wrong := self.damaged_enrollments():
            raise changed([str(name) for name in wrong.values()])
        self.used()


def check_lines(transaction: Transaction, lines: Iterable[ObjectLine | StatusLine | Entry]) -> None:
    """Raise `CatalogDamaged` if one of these lines of the log is not as it was written."""
    if wrong := digests.wrong_lines(transaction, {line.id for line in lines}):
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


# Lines of the log


def new_columns(created_utc: datetime, texts: Mapping[str, str]) -> dict[str, Any]:
    """Return the columns of the line of the log that adds an object."""
    return {"label": "", "note": "", "deleted": False, "created_utc": created_utc, **texts}


def columns(known: ObjectLine, texts: Mapping[str, str] | None = None, *, deleted: bool = False) -> dict[str, Any]:
    """Return the columns of a line of the log that gives a known object this state; other texts stay as they are."""
    own = {"label": known.label or "", "note": known.note or "", "created_utc": known.created_utc}
    return {**own, "object_id": known.object_id, "deleted": deleted, **(texts or {})}


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


# Rows


def is_possible(enrollment: Enrollment, ended: StatusLine) -> bool:
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
