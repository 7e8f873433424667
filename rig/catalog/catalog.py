"""The catalog: objects with their enrollments and views. An enrollment in progress gets views until it is finished."""

import secrets
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from os import PathLike
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import delete, select
from sqlalchemy.orm import Session as Transaction

from rig.catalog import log, state
from rig.catalog.database import Database
from rig.catalog.describing import described, hold
from rig.catalog.facts import Action, Enrollment, Entry, Session, View, digest_of
from rig.catalog.records import MAX_VIEWS, EnrollmentStatus, Provenance, as_json, checked_texts, clean_name, is_plan
from rig.catalog.state import EnrollmentState, ObjectDetails, ObjectLine, ObjectSummary, State
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock
from rig.core.errors import CatalogDamaged, CatalogError, UsageError
from rig.core.next_steps import Do
from rig.views import image_files as images


class Catalog(AbstractContextManager["Catalog"]):
    """Objects with their enrollments and views.

    They are in one folder (``catalog.sqlite`` and ``images/``), or on a server for several benches (`CatalogPlace`).
    Open it with `Catalog.open`. Several processes may read and write at once. For answers, checks, imports and exports
    use the functions of `rig.catalog.results`, `.derived`, `.verify`, `.upkeep`, `.transfer` and `.exchange`.

    Whatever reads or writes a catalog raises `CatalogDamaged` for what is not as it was stored, `CatalogBusy` if
    another process writes for longer than the timeout, `CatalogUnavailable` if the server does not answer, and
    `CatalogError` if the system denies access or the disk is full. The methods name other errors only.

    ``database`` is only for the other modules of this package. ``clock`` gives the civil time of what is stored.
    """

    copied_utc: datetime | None = None
    """When this local copy of a catalog on a server was made; None for the catalog itself."""

    copy_of: CatalogPlace | None = None
    """Where the catalog is whose local copy this is; None for the catalog itself."""

    def __init__(self, database: Database, clock: Clock) -> None:
        self.database = database
        self.clock = clock

    @classmethod
    def open(
        cls,
        path: str | PathLike[str] | CatalogPlace,
        *,
        clock: Clock,
        create: bool = True,
        read_only: bool = False,
        busy_timeout_s: float = 5.0,
    ) -> Self:
        """Open the catalog in the folder, or at the place, ``path``: a place may name a database server and a store.

        With ``create`` a missing catalog is created, unless it is opened ``read_only``. ``busy_timeout_s`` is how long
        to wait while another process writes.

        Raises `CatalogError`: there is no catalog, it is damaged or of another version of the program, or the system
        denies access. `CatalogUnavailable`: the server of the catalog does not answer.
        """
        place = CatalogPlace.of(path)
        if place.url is None:
            from rig.catalog.sqlite_database import SqliteDatabase

            kind: type[Database] = SqliteDatabase
        else:
            from rig.catalog.postgres import PostgresDatabase

            kind = PostgresDatabase
        return cls(kind(place, create=create, read_only=read_only, busy_timeout_s=busy_timeout_s), clock)

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.database.close()

    @property
    def path(self) -> Path:
        """The catalog's folder on this computer."""
        return self.database.root

    @property
    def place(self) -> CatalogPlace:
        """Where the catalog is."""
        return self.database.place

    @contextmanager
    def reading(self) -> Iterator[State]:
        """Yield the state of the catalog; for the other modules of this package, as ``database``."""
        with self.database.read() as transaction:
            yield State(transaction, self.clock)

    @contextmanager
    def writing(self) -> Iterator[State]:
        """Yield the state of the catalog before a change. An exception undoes the change."""
        with self.database.write() as transaction:
            yield State(transaction, self.clock)

    # What is enrolled

    def objects(self, *, deleted: bool = False) -> list[ObjectSummary]:
        """Return the objects in use in the order in which they were added, or the deleted ones that can be restored."""
        with self.reading() as found:
            return found.summaries(found.deleted() if deleted else found.in_use())

    def summary(self, name: str) -> ObjectSummary:
        """Return an object without its enrollments and views; errors as for `object`."""
        with self.reading() as found:
            return found.summary(found.find(name))

    def object(self, name: str) -> ObjectDetails:
        """Return an object with its enrollments and views.

        Raises `ObjectNotFound`: there is no object of that name. `CatalogDamaged`: an enrollment of it is missing.
        """
        with self.reading() as found:
            known = found.find(name)
            found.check_present(known.object_id)
            return ObjectDetails(found.summary(known), tuple(found.enrollments_of(known.object_id)))

    def first_views(self) -> dict[str, int]:
        """Return the id of one view of each object in use, to show the object by."""
        with self.reading() as found:
            names = {one.enrollment_id: one.name for one in found.used()}
            rows = found.first_views(View.enrollment_id, View.id)
            return {names[enrollment_id]: view_id for enrollment_id, view_id in rows}

    def version(self) -> str:
        """Return a digest of what searches compare with, SHA-256: another one after every change of the objects."""
        with self.reading() as found:
            return found.version()

    def damage(self) -> CatalogDamaged | None:
        """Return the error that an object is not as it was stored; None if all are.

        Compares digests of rows, not of images. `rig.catalog.verify` compares everything.
        """
        try:
            with self.reading() as found:
                found.check_everything()
        except CatalogDamaged as error:
            return error
        return None

    def view(self, view_id: int) -> View:
        """Return one view.

        Raises `CatalogError`: there is no view with that id, or it is not as it was stored.
        """
        with self.database.read() as transaction:
            return state.view(transaction, int(view_id))

    def image_path(self, image: str) -> Path:
        """Return a file with an image; an image of an object store is fetched.

        A `CatalogDamaged` if a link leads out of the catalog.
        """
        return self.database.images.file(image)

    def read_image(self, image: str) -> NDArray[np.uint8]:
        """Return the pixels that were stored, uint8 (H, W, 3) BGR, such as those of `View.image`.

        Raises `CatalogError`: the file is missing, is not the stored one, or the system denies access.
        """
        with self.database.catalog_errors():
            return self.database.images.pixels(image)

    # Enroll

    def check_enrollable(
        self,
        name: str,
        *,
        label: str | None = None,
        note: str | None = None,
        resume: bool = False,
        replace: bool = False,
    ) -> None:
        """Raise what `begin`, or with ``resume`` `resume`, would raise for this object now; change nothing."""
        name = clean_name(name)
        checked_texts(label, note)
        with self.reading() as found:
            if resume:
                found.unfinished(found.find(name))
            elif not replace and (known := found.named(name)) is not None:
                found.check_not_enrolled(known)

    def known_objects(self) -> list[ObjectSummary]:
        """Return the objects that need not be enrolled: those in use. `rig.catalog.journal` adds those of a server."""
        return self.objects()

    def begin(
        self,
        name: str,
        *,
        planned_azimuth_deg: Sequence[float],
        provenance: Provenance,
        label: str | None = None,
        note: str | None = None,
        replace: bool = False,
        empty_table: NDArray[np.uint8] | None = None,
    ) -> "OpenEnrollment":
        """Start to enroll an object of this name (`clean_name`).

        ``planned_azimuth_deg`` are those of view 0, 1, ..., each in [0, 360). A label or note that is None leaves that
        of a known object unchanged. With ``replace`` a known object is enrolled again: its complete enrollment stays in
        use until the new one is complete, and an unfinished one is abandoned. ``empty_table`` is the sheet of the
        bench's empty-table images (`rig.views.table_sheet`), uint8 (H, W, 3).

        Raises `UsageError`: the name or the plan is not valid. `ObjectExists`: the object is enrolled already and
        ``replace`` is False. `CatalogError`: the object has an unfinished enrollment and ``replace`` is False, or
        storing fails.
        """
        name = clean_name(name)
        plan = tuple(float(azimuth_deg) for azimuth_deg in planned_azimuth_deg)
        if not is_plan(plan):
            raise UsageError(
                f"An enrollment needs 1 to {MAX_VIEWS} planned views, with azimuths in [0°, 360°).",
                next_step="Plan other views.",
            )
        texts = checked_texts(label, note)
        now = self.clock.utc()
        with self.writing() as found:
            known = found.named(name)
            if known is not None:
                if not replace:
                    found.check_not_enrolled(known)
                found.end_current(known, EnrollmentStatus.IN_PROGRESS)
            object_id = found.id_of(known)
            # The enrollment, its digest, and the line of the log are one fact: all are written, or none.
            enrollment = Enrollment(
                key=secrets.token_hex(32), object_id=object_id, started_utc=now, planned_azimuth_deg=plan
            )
            enrollment.digest = digest_of(enrollment, enrollment.key)
            found.transaction.add(enrollment)
            found.transaction.flush()
            changed = state.new_columns(now, texts) if known is None else state.columns(known, texts) if texts else {}
            found.append(
                Action.ENROLLMENT_STARTED,
                name,
                **{**changed, "object_id": object_id},
                enrollment_id=enrollment.id,
                status=EnrollmentStatus.IN_PROGRESS,
                details={"enrollment_id": enrollment.id, "views": len(plan), "replace": replace},
            )
            return self._start_session(found.transaction, enrollment, name, provenance, empty_table)

    def resumable(self, name: str) -> EnrollmentState | None:
        """Return the unfinished enrollment of an object, or None.

        Raises `ObjectNotFound`: there is no object of that name.
        """
        with self.reading() as found:
            return found.of_status(found.find(name), EnrollmentStatus.IN_PROGRESS)

    def resume(
        self, name: str, *, provenance: Provenance, empty_table: NDArray[np.uint8] | None = None
    ) -> "OpenEnrollment":
        """Continue the unfinished enrollment of an object, on the same bench or on another one.

        Raises `ObjectNotFound`: there is no object of that name. `CatalogError`: it has no unfinished enrollment, or
        storing fails.
        """
        with self.writing() as found:
            known = found.find(name)
            enrollment, name = found.unfinished(known).enrollment, str(known.object_name)
            found.append(Action.ENROLLMENT_RESUMED, name, details={"enrollment_id": enrollment.id})
            return self._start_session(found.transaction, enrollment, name, provenance, empty_table)

    # Change objects

    def rename(self, name: str, new_name: str) -> None:
        """Give an object another name.

        Raises `UsageError`: the new name is not valid. `ObjectNotFound`: there is no object of that name.
        `ObjectExists`: another object has the new name.
        """
        new_name = clean_name(new_name)
        with self.writing() as found:
            known = found.find(name)
            if new_name == known.object_name:
                return
            found.check_free(new_name)
            before = {"before": known.object_name}
            found.append(Action.RENAMED, new_name, **state.columns(known), details=before)

    def set_texts(self, name: str, *, label: str | None = None, note: str | None = None) -> None:
        """Change the label and the note of an object. None leaves them unchanged.

        Raises `UsageError`: they are not valid text. `ObjectNotFound`: there is no object of that name.
        """
        texts = checked_texts(label, note)
        with self.writing() as found:
            known = found.find(name)
            if texts:
                columns = state.columns(known, texts)
                found.append(Action.LABELLED, known.object_name, **columns, details=texts)

    def delete(self, *names: str) -> None:
        """Delete objects, all or none. `undelete` restores them until `collect_garbage` removes them.

        Raises `ObjectNotFound`: there is no object of one of these names.
        """
        with self.writing() as found:
            for known in map(found.find, dict.fromkeys(names)):
                found.append(Action.DELETED, known.object_name, **state.columns(known, deleted=True))

    def undelete(self, name: str) -> None:
        """Restore the object that was deleted last under this name.

        Raises `ObjectNotFound`: there is no deleted object of that name. `ObjectExists`: an object in use has this
        name.
        """
        with self.writing() as found:
            known = found.find(name, deleted=True)
            found.check_free(str(known.object_name))
            found.append(Action.UNDELETED, known.object_name, **state.columns(known))

    # The log

    def note(self, action: Action, object_name: str | None = None, **details: Any) -> None:
        """Add an action to the log; details are JSON values."""
        with self.database.write() as transaction:
            log.append(transaction, self.clock, action, object_name, details=details)

    def log(self, *, since: datetime | None = None) -> list[Entry]:
        """Return the log: who did what and when, oldest first."""
        with self.database.read() as transaction:
            return log.entries(transaction, since)

    def _start_session(
        self,
        transaction: Transaction,
        enrollment: Enrollment,
        name: str,
        provenance: Provenance,
        empty_table: NDArray[np.uint8] | None,
    ) -> "OpenEnrollment":
        # While this process may write, no other one removes the image as garbage before its row is there.
        session = new_session(self, len(enrollment.sessions), provenance, empty_table)
        session.enrollment_id = enrollment.id
        session.digest = digest_of(session, enrollment.key)
        transaction.add(session)
        transaction.flush()
        return OpenEnrollment(self, enrollment, name, session)


@dataclass(eq=False)
class OpenEnrollment:
    """An enrollment in progress, as `Catalog.begin` or `Catalog.resume` returns it.

    An exception or a power cut loses nothing: the enrollment stays in progress and can be resumed.
    """

    catalog: Catalog
    enrollment: Enrollment
    object_name: str
    session: Session
    _held: dict[str, NDArray[np.uint8]] = field(default_factory=dict)

    @property
    def id(self) -> int:
        return self.enrollment.id

    @property
    def planned_azimuth_deg(self) -> tuple[float, ...]:
        """Azimuth planned for view 0, 1, ...."""
        return self.enrollment.planned_azimuth_deg

    def missing(self) -> tuple[int, ...]:
        """Return the indices of the planned views that are not stored yet, ascending."""
        with self.catalog.database.read() as transaction:
            return self._missing(transaction)

    def add(self, view: View, image_bgr: NDArray[np.uint8], encoded: Future[bytes] | None = None) -> View:
        """Store a view and its image, uint8 (H, W, 3) BGR. Both are durable when this returns.

        ``encoded`` is the image as PNG, if another thread began with it before.

        The image is complete under its name before its row is committed. A crash in between leaves an image without a
        row, which is harmless, and never a row without its image.

        Raises `UsageError`: the view is not in the plan, a value of it is not possible, or the image has the wrong type
        or shape. `CatalogError`: the view is stored already, the enrollment is no longer in progress, or the disk is
        full or fails.
        """
        if view.index >= len(self.planned_azimuth_deg):
            raise UsageError(
                f"View {view.index} is not among the {len(self.planned_azimuth_deg)} planned views of "
                f"{self.object_name!r}.",
                next_step="Start a new enrollment with a larger plan.",
            )
        png, database = store_image(self.catalog, view, image_bgr, encoded), self.catalog.database
        with self.catalog.writing() as found:
            self._check_in_progress(found)
            if view.index not in self._missing(found.transaction):
                raise CatalogError(
                    f"View {view.index} of {self.object_name!r} is stored already.",
                    next_step="Continue with the missing views; check that no other process enrolls this object.",
                )
            if database.images.size(view.image) != len(png):  # `collect_garbage` removed it: an older view had it, too
                database.images.put(png)
            view.enrollment_id, view.session = self.id, self.session.number
            view.digest = digest_of(view, self.enrollment.key)
            found.transaction.add(view)
            found.transaction.flush()
        hold(self._held, view.image, image_bgr)
        return view

    def finish(self) -> None:
        """Segment and describe all views together, and make this the enrollment that searches use.

        The previous one is superseded. After an interruption, resume the enrollment and call this again.

        Raises `CatalogError`: planned views are missing, an image cannot be read, or the enrollment is no longer in
        progress.
        """
        database, clock = self.catalog.database, self.catalog.clock
        with self.catalog.reading() as found:
            self._check_in_progress(found)
            enrollment = found.enrollments(Enrollment.id == self.id)[0].enrollment
        if missing := enrollment.missing:
            raise CatalogError(
                f"{len(missing)} of the {len(self.planned_azimuth_deg)} planned views of {self.object_name!r} "
                "are missing.",
                next_step=(Do.CONTINUE_ENROLLMENT(name=self.object_name), "Or abandon it."),
                evidence={"missing_views": list(missing)},
            )
        described(database, enrollment, self.object_name, held=self._held)
        with self.catalog.writing() as found:
            known = self._check_in_progress(found)
            found.end_current(known, EnrollmentStatus.COMPLETE)
            done = EnrollmentState(enrollment, EnrollmentStatus.COMPLETE, clock.utc())
            found.append(Action.ENROLLED, known.object_name, **state.ending(done))

    def abandon(self) -> None:
        """Abandon the enrollment. Its images stay, and the complete enrollment before it stays in use."""
        with self.catalog.writing() as found:
            found.end_current(self._check_in_progress(found), EnrollmentStatus.IN_PROGRESS)

    def discard(self) -> None:
        """Remove an enrollment without views; an object that has no other enrollment goes with it.

        Raises `CatalogError`: the enrollment has views or is no longer in progress.
        """
        with self.catalog.writing() as found:
            known, transaction = self._check_in_progress(found), found.transaction
            if len(self._missing(transaction)) < len(self.planned_azimuth_deg):
                raise CatalogError(
                    f"The enrollment of {self.object_name!r} has views.",
                    next_step="Abandon the enrollment: its views stay in the catalog.",
                )
            transaction.execute(delete(Session).where(Session.enrollment_id == self.id))
            transaction.execute(delete(Enrollment).where(Enrollment.id == self.id))
            others = transaction.scalar(select(Enrollment.id).where(Enrollment.object_id == known.object_id).limit(1))
            gone = state.columns(known, deleted=True) if others is None else {}
            own = {"enrollment_id": self.id}
            found.append(Action.ENROLLMENT_DISCARDED, known.object_name, **gone, **own, details=own)

    def _missing(self, transaction: Transaction) -> tuple[int, ...]:
        present = set(transaction.scalars(select(View.index).where(View.enrollment_id == self.id)))
        return tuple(index for index in range(len(self.planned_azimuth_deg)) if index not in present)

    def _check_in_progress(self, found: State) -> ObjectLine:
        """Return the state of the object."""
        known = found.by_id(self.enrollment.object_id)
        if known.deleted:
            raise CatalogError(
                f"{self.object_name!r} was deleted during its enrollment.",
                next_step=(Do.UNDELETE(name=self.object_name), Do.CONTINUE_ENROLLMENT(name=self.object_name)),
            )
        is_there = found.transaction.scalar(select(Enrollment.id).where(Enrollment.id == self.id)) is not None
        status = found.status_of(self.id) if is_there else None
        if status != EnrollmentStatus.IN_PROGRESS:
            raise CatalogError(
                f"The enrollment of {self.object_name!r} is {status or 'gone'}, not in progress.",
                next_step="Start a new one.",
            )
        return known


def new_session(
    catalog: Catalog, number: int, provenance: Provenance, empty_table: NDArray[np.uint8] | None
) -> Session:
    """Return the row of a session that begins now, and store its sheet of empty-table images."""
    png = None if empty_table is None else images.encode(empty_table)
    with catalog.database.catalog_errors():
        return Session(
            number=number,
            started_utc=catalog.clock.utc(),
            provenance=provenance,
            empty_table=None if png is None else catalog.database.images.put(png),
            empty_table_bytes=None if png is None else len(png),
        )


def store_image(
    catalog: Catalog, view: View, image_bgr: NDArray[np.uint8], encoded: Future[bytes] | None = None
) -> bytes:
    """Check a view, and store its image; return it as PNG. Values and errors are those of `OpenEnrollment.add`."""
    check_view(view)
    clock, database = catalog.clock, catalog.database
    png = images.encode(image_bgr) if encoded is None else encoded.result()
    if view.captured_ns is not None:
        age_ns = clock.now_ns() - view.captured_ns
        view.captured_utc = clock.utc() - timedelta(microseconds=age_ns // 1000)
    with database.catalog_errors():
        view.image, view.image_bytes = database.images.put(png), len(png)
    return png


def check_view(view: View) -> None:
    """Check the values of a view that is not stored yet, and make them plain numbers and JSON; a `UsageError`."""
    view.index = int(view.index)
    if view.captured_ns is not None:
        view.captured_ns = int(view.captured_ns)
    for name in ("commanded_deg", "encoder_deg", "azimuth_deg", "imu_deg", "imu_sigma_deg"):
        if (value := getattr(view, name)) is not None:
            setattr(view, name, float(value) + 0.0)
    if problem := view.problem:
        raise UsageError(
            f"View {view.index} cannot be stored: {problem}.",
            next_step="Store measured values, and None for what was not measured.",
        )
    view.evidence = as_json(view.evidence, f"The evidence of view {view.index}")
