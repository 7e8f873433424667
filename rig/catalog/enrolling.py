"""An enrollment in progress: add views, then finish or abandon it."""

from concurrent.futures import Future
from dataclasses import dataclass, field
from datetime import timedelta

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import bindparam, delete, select
from sqlalchemy.orm import Session as Transaction

from rig.catalog import log, state
from rig.catalog.database import Database
from rig.catalog.describing import MOST_HELD_BYTES, described
from rig.catalog.facts import Action, Enrollment, Session, View, digest_of
from rig.catalog.records import EnrollmentStatus, as_json
from rig.core.clock import Clock
from rig.core.errors import CatalogError, UsageError
from rig.core.next_steps import Do
from rig.views import image_files as images

# Each view asks these. To build a statement takes longer than to execute it.
_STATUS = (
    select(state.Ended.status)
    .join(Enrollment, Enrollment.id == state.Ended.enrollment_id)
    .where(state.IS_STATUS, Enrollment.id == bindparam("id"))
)
_PRESENT = select(View.index).where(View.enrollment_id == bindparam("id"))


@dataclass(eq=False)
class OpenEnrollment:
    """An enrollment in progress, as `Catalog.begin` or `Catalog.resume` returns it.

    An exception or a power cut loses nothing: the enrollment stays in progress and can be resumed.
    """

    _database: Database
    _clock: Clock
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
        with self._database.read() as transaction:
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
        check_view(view)
        clock, database = self._clock, self._database
        png = images.encode(image_bgr) if encoded is None else encoded.result()
        if view.captured_ns is not None:
            age_ns = clock.now_ns() - view.captured_ns
            view.captured_utc = clock.utc() - timedelta(microseconds=age_ns // 1000)
        with database.catalog_errors():
            view.image, view.image_bytes = database.images.put(png), len(png)
        with database.write() as transaction:
            self._check_in_progress(transaction)
            if view.index not in self._missing(transaction):
                raise CatalogError(
                    f"View {view.index} of {self.object_name!r} is stored already.",
                    next_step="Continue with the missing views; check that no other process enrolls this object.",
                )
            if database.images.size(view.image) != len(png):  # `collect_garbage` removed it: an older view had it, too
                database.images.put(png)
            view.enrollment_id, view.session = self.id, self.session.number
            view.digest = digest_of(view, self.enrollment.key)
            transaction.add(view)
            transaction.flush()
        if sum(one.nbytes for one in self._held.values()) + image_bgr.nbytes <= MOST_HELD_BYTES:
            self._held[view.image] = image_bgr
        return view

    def finish(self) -> None:
        """Segment and describe all views together, and make this the enrollment that searches use.

        The previous one is superseded. After an interruption, resume the enrollment and call this again.

        Raises `CatalogError`: planned views are missing, an image cannot be read, or the enrollment is no longer in
        progress.
        """
        database, clock = self._database, self._clock
        with database.read() as transaction:
            self._check_in_progress(transaction)
            (found,) = state.enrollments(transaction, Enrollment.id == self.id)
        enrollment = found.enrollment
        if missing := enrollment.missing:
            raise CatalogError(
                f"{len(missing)} of the {len(self.planned_azimuth_deg)} planned views of {self.object_name!r} "
                "are missing.",
                next_step=(Do.CONTINUE_ENROLLMENT(name=self.object_name), "Or abandon it."),
                evidence={"missing_views": list(missing)},
            )
        described(database, enrollment, self.object_name, held=self._held)
        with database.write() as transaction:
            self._check_in_progress(transaction)
            known = state.by_id(transaction, enrollment.object_id)
            state.end_current(transaction, clock, known, EnrollmentStatus.COMPLETE)
            done = state.EnrollmentState(enrollment, EnrollmentStatus.COMPLETE, clock.utc())
            log.append(transaction, clock, Action.ENROLLED, known.object_name, **state.ending(done))

    def abandon(self) -> None:
        """Abandon the enrollment. Its images stay, and the complete enrollment before it stays in use."""
        with self._database.write() as transaction:
            self._check_in_progress(transaction)
            known = state.by_id(transaction, self.enrollment.object_id)
            state.end_current(transaction, self._clock, known, EnrollmentStatus.IN_PROGRESS)

    def discard(self) -> None:
        """Remove an enrollment without views; an object that has no other enrollment goes with it.

        Raises `CatalogError`: the enrollment has views or is no longer in progress.
        """
        with self._database.write() as transaction:
            self._check_in_progress(transaction)
            if len(self._missing(transaction)) < len(self.planned_azimuth_deg):
                raise CatalogError(
                    f"The enrollment of {self.object_name!r} has views.",
                    next_step="Abandon the enrollment: its views stay in the catalog.",
                )
            transaction.execute(delete(Session).where(Session.enrollment_id == self.id))
            transaction.execute(delete(Enrollment).where(Enrollment.id == self.id))
            object_id = self.enrollment.object_id
            others = transaction.scalar(select(Enrollment.id).where(Enrollment.object_id == object_id).limit(1))
            known = state.by_id(transaction, object_id)
            gone = state.columns(known, self.session.started_utc, deleted=True)
            log.append(
                transaction,
                self._clock,
                Action.ENROLLMENT_DISCARDED,
                known.object_name,
                **(gone if others is None else {}),
                enrollment_id=self.id,
                details={"enrollment_id": self.id},
            )

    def _missing(self, transaction: Transaction) -> tuple[int, ...]:
        present = set(transaction.scalars(_PRESENT, {"id": self.id}))
        return tuple(index for index in range(len(self.planned_azimuth_deg)) if index not in present)

    def _check_in_progress(self, transaction: Transaction) -> None:
        if state.by_id(transaction, self.enrollment.object_id).deleted:
            raise CatalogError(
                f"{self.object_name!r} was deleted during its enrollment.",
                next_step=(Do.UNDELETE(name=self.object_name), Do.CONTINUE_ENROLLMENT(name=self.object_name)),
            )
        status = transaction.scalar(_STATUS, {"id": self.id})
        if status != EnrollmentStatus.IN_PROGRESS:
            raise CatalogError(
                f"The enrollment of {self.object_name!r} is {status or 'gone'}, not in progress.",
                next_step="Start a new one.",
            )


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
