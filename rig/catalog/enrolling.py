"""An enrollment in progress: add views, then finish or abandon it."""

from concurrent.futures import Future
from dataclasses import dataclass, field
from datetime import timedelta
from math import isfinite

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import delete, select
from sqlalchemy.orm import Session as Transaction

from rig.catalog import log, state
from rig.catalog.database import Database
from rig.catalog.describing import MOST_HELD_BYTES, describe_new
from rig.catalog.facts import Action, Enrollment, Session, View, digest_of
from rig.catalog.records import EnrollmentStatus, as_json, check_azimuth, is_region
from rig.core.clock import Clock
from rig.core.errors import CatalogError, UsageError
from rig.core.next_steps import Do
from rig.views import image_files as images


@dataclass(eq=False)
class OpenEnrollment:
    """An enrollment in progress, as `Catalog.begin` or `Catalog.resume` returns it.

    An exception or a power cut loses nothing: the enrollment stays in progress and can be resumed.

    Attributes
    ----------
    enrollment
        The plan.
    object_name
        The object.
    session
        The present session.
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

        Raises
        ------
        UsageError
            The view is not in the plan, a value of it is not possible, or the image has the wrong type or shape.
        CatalogError
            The view is stored already, the enrollment is no longer in progress, or the disk is full or fails.
        CatalogBusy
            Another process is writing for longer than the timeout.
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

        Raises
        ------
        CatalogError
            Planned views are missing, an image cannot be read, or the enrollment is no longer in progress.
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
        seal = describe_new(database, enrollment, self._held, self.object_name)
        with database.write() as transaction:
            self._check_in_progress(transaction)
            known = state.by_id(transaction, enrollment.object_id)
            before = state.of_status(transaction, known, EnrollmentStatus.COMPLETE)
            if before is not None:
                self._end(transaction, Action.ENROLLMENT_SUPERSEDED, EnrollmentStatus.SUPERSEDED, before)
            log.append(
                transaction,
                clock,
                Action.ENROLLED,
                known.object_name,
                object_id=enrollment.object_id,
                enrollment_id=self.id,
                status=EnrollmentStatus.COMPLETE,
                finished_utc=clock.utc(),
                seal=seal,
                details={"enrollment_id": self.id, "views": len(self.planned_azimuth_deg)},
            )

    def abandon(self) -> None:
        """Abandon the enrollment. Its images stay, and the complete enrollment before it stays in use."""
        with self._database.write() as transaction:
            self._check_in_progress(transaction)
            self._end(transaction, Action.ENROLLMENT_ABANDONED, EnrollmentStatus.ABANDONED)

    def discard(self) -> None:
        """Remove an enrollment without views; an object that has no other enrollment goes with it.

        Raises
        ------
        CatalogError
            The enrollment has views or is no longer in progress.
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

    def _end(
        self,
        transaction: Transaction,
        action: Action,
        status: EnrollmentStatus,
        ended: state.EnrollmentState | None = None,
    ) -> None:
        """End an enrollment, this one or the ``ended`` one; the object may have another name now."""
        enrollment = self.enrollment if ended is None else ended.enrollment
        finished_utc = self._clock.utc() if ended is None else ended.finished_utc
        log.append(
            transaction,
            self._clock,
            action,
            state.by_id(transaction, enrollment.object_id).object_name,
            object_id=enrollment.object_id,
            enrollment_id=enrollment.id,
            status=status,
            finished_utc=finished_utc,
            seal=None if ended is None else ended.seal,
            details={"enrollment_id": enrollment.id},
        )

    def _missing(self, transaction: Transaction) -> tuple[int, ...]:
        present = set(transaction.scalars(select(View.index).where(View.enrollment_id == self.id)))
        return tuple(index for index in range(len(self.planned_azimuth_deg)) if index not in present)

    def _check_in_progress(self, transaction: Transaction) -> None:
        if state.by_id(transaction, self.enrollment.object_id).deleted:
            raise CatalogError(
                f"{self.object_name!r} was deleted during its enrollment.",
                next_step=(Do.UNDELETE(name=self.object_name), Do.CONTINUE_ENROLLMENT(name=self.object_name)),
            )
        status = transaction.scalar(
            select(state.Ended.status).where(state.IS_STATUS, state.Ended.enrollment_id == self.id)
        )
        if transaction.scalar(select(Enrollment.id).where(Enrollment.id == self.id)) is None:
            status = None
        if status != EnrollmentStatus.IN_PROGRESS:
            raise CatalogError(
                f"The enrollment of {self.object_name!r} is {status or 'gone'}, not in progress.",
                next_step="Start a new one.",
            )


def check_view(view: View) -> None:
    """Check the values of a view that is not stored yet.

    Raises
    ------
    UsageError
        A number is out of range or not finite, or the evidence is not JSON.
    """
    view.index = int(view.index)
    if view.captured_ns is not None:
        view.captured_ns = int(view.captured_ns)
    if view.index < 0:
        raise UsageError(f"View index {view.index} is negative.", next_step="Number the views of a plan from 0.")
    for name in ("commanded_deg", "encoder_deg", "azimuth_deg", "imu_deg", "imu_sigma_deg"):
        value = getattr(view, name)
        if value is not None:
            setattr(view, name, float(value) + 0.0)
        if not isfinite(value or 0.0):
            raise UsageError(f"View {view.index} has {name} = {value}.", next_step="Store measured angles.")
    check_azimuth(view.azimuth_deg)
    if (view.imu_deg is None) != (view.imu_sigma_deg is None) or (view.imu_sigma_deg or 0.0) < 0:
        raise UsageError(
            f"View {view.index} has an IMU angle of {view.imu_deg} with an uncertainty of {view.imu_sigma_deg}.",
            next_step="Give both, with an uncertainty of 0 or more, or None for both.",
        )
    view.evidence = as_json(view.evidence, f"The evidence of view {view.index}")
    if view.region is not None and not is_region(view.region):
        raise UsageError(
            f"View {view.index} has the region {view.region}.", next_step="Give x, y, width, height in pixels."
        )
