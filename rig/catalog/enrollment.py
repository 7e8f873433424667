"""The writing side of an enrollment."""

from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, and_, delete, insert, select, update

from rig.catalog import audit
from rig.catalog.database import Database, insert_row
from rig.catalog.describing import packed_rows
from rig.catalog.records import EnrollmentStatus, Sitting, StoredView, ViewRecord
from rig.catalog.schema import DESCRIPTOR, descriptors, enrollments, objects, sittings, views
from rig.core.clock import Clock
from rig.core.errors import CatalogError, UsageError
from rig.core.files import write
from rig.views import image_files as images


class Enrollment:
    """An enrollment in progress, as `Catalog.begin` or `Catalog.resume` returns it.

    Leaving it, by an exception or a power cut, loses nothing: it stays in progress and can be resumed.

    Attributes
    ----------
    id, object_id, object_name
        The enrollment and its object.
    sitting
        What its views are taken with now.
    planned_azimuth_deg
        Azimuth planned for view 0, 1, ....
    """

    def __init__(
        self,
        database: Database,
        clock: Clock,
        *,
        id: int,
        object_id: int,
        object_name: str,
        sitting: Sitting,
        planned_azimuth_deg: tuple[float, ...],
    ) -> None:
        self._database = database
        self._clock = clock
        self.id = id
        self.object_id = object_id
        self.object_name = object_name
        self.sitting = sitting
        self.planned_azimuth_deg = planned_azimuth_deg

    @property
    def folder(self) -> Path:
        """Where its images are, relative to the catalog."""
        return images.folder(self.object_id, self.object_name, self.id)

    def missing(self) -> tuple[int, ...]:
        """Return the indices of the planned views that are not stored yet, ascending."""
        with self._database.read() as connection:
            return self._missing(connection)

    def add(self, record: ViewRecord, image_bgr: NDArray[np.uint8]) -> StoredView:
        """Store a view and its image, uint8 (H, W, 3) BGR; both are durable when this returns.

        The image is whole under its name before its row is committed: a crash in between leaves an image without a
        row, which is harmless, and never a row without its image.

        Raises
        ------
        UsageError
            The view is not in the plan, or the image is none.
        TypeError, ValueError
            A descriptor is none (`hbr.pack`).
        CatalogError
            The view is stored already, the enrollment is no longer in progress, or the disk is full or fails.
        CatalogBusy
            Another process is writing for longer than the timeout.
        """
        index = record.index
        if index >= len(self.planned_azimuth_deg):
            raise UsageError(
                f"view {index} is not one of the {len(self.planned_azimuth_deg)} planned views of {self.object_name!r}",
                next_step="begin a new enrollment with the larger plan",
            )
        if record.descriptor is None:
            raise UsageError(f"view {index} is not described", next_step="describe it: hbr.describe")
        packed = list(packed_rows(record.descriptor, record.further, DESCRIPTOR, record.region))
        png = images.encode(image_bgr)
        image = self.folder / f"{index:03d}.png"
        sha256 = images.digest(png)
        captured_utc = None
        if record.captured_ns is not None:
            age_ns = self._clock.now_ns() - record.captured_ns
            captured_utc = self._clock.utc() - timedelta(microseconds=age_ns // 1000)
        # The image is written under the write lock: two processes at one enrollment cannot change each other's images.
        with self._database.write() as connection:
            self._check_in_progress(connection)
            if index not in self._missing(connection):
                raise CatalogError(
                    f"view {index} of {self.object_name!r} is stored already",
                    next_step="go on with the missing views; check that no other process enrolls this object",
                )
            write(self._database.root / image, png)
            view_id = insert_row(
                connection,
                views,
                enrollment_id=self.id,
                view_index=index,
                sitting_id=self.sitting.id,
                commanded_deg=record.commanded_deg,
                encoder_deg=record.encoder_deg,
                imu_deg=record.imu_deg,
                imu_sigma_deg=record.imu_sigma_deg,
                azimuth_deg=record.azimuth_deg,
                captured_utc=captured_utc,
                captured_ns=record.captured_ns,
                image=image.as_posix(),
                image_sha256=sha256,
                image_bytes=len(png),
                evidence=record.evidence,
                segmentation=record.segmentation,
            )
            connection.execute(insert(descriptors), [{"view_id": view_id, **row} for row in packed])
        return StoredView(
            id=view_id,
            object_name=self.object_name,
            enrollment_id=self.id,
            sitting=self.sitting,
            record=record,
            captured_utc=captured_utc,
            image=image.as_posix(),
            image_sha256=sha256,
            image_bytes=len(png),
        )

    def finish(self) -> None:
        """Make this the enrollment that the object is retrieved through; the one before it is superseded.

        Raises
        ------
        CatalogError
            Planned views are missing, or the enrollment is no longer in progress.
        """
        with self._database.write() as connection:
            self._check_in_progress(connection)
            if missing := self._missing(connection):
                raise CatalogError(
                    f"{len(missing)} of the {len(self.planned_azimuth_deg)} planned views of {self.object_name!r} "
                    "are missing",
                    next_step="resume the enrollment (--resume), or abandon it",
                    evidence={"missing_views": list(missing)},
                )
            connection.execute(
                update(enrollments)
                .where(
                    and_(enrollments.c.object_id == self.object_id, enrollments.c.status == EnrollmentStatus.COMPLETE)
                )
                .values(status=EnrollmentStatus.SUPERSEDED)
            )
            self._close(connection, EnrollmentStatus.COMPLETE)
            audit.append(
                connection,
                self._clock,
                "enrolled",
                self.object_name,
                enrollment_id=self.id,
                views=len(self.planned_azimuth_deg),
            )

    def abandon(self) -> None:
        """Give the enrollment up; its images stay, and the complete enrollment before it stays in use."""
        with self._database.write() as connection:
            self._check_in_progress(connection)
            self._close(connection, EnrollmentStatus.ABANDONED)
            audit.append(connection, self._clock, "abandoned", self.object_name, enrollment_id=self.id)

    def discard(self) -> None:
        """Take back an enrollment that holds no view yet, and its object if it has no other enrollment.

        Raises
        ------
        CatalogError
            It holds views, which nobody throws away like that, or is no longer in progress.
        """
        with self._database.write() as connection:
            self._check_in_progress(connection)
            if len(self._missing(connection)) < len(self.planned_azimuth_deg):
                raise CatalogError(
                    f"the enrollment of {self.object_name!r} holds views",
                    next_step="abandon it, which keeps them",
                )
            connection.execute(delete(sittings).where(sittings.c.enrollment_id == self.id))
            connection.execute(delete(enrollments).where(enrollments.c.id == self.id))
            others = select(enrollments.c.id).where(enrollments.c.object_id == self.object_id)
            if connection.scalar(others) is None:
                connection.execute(delete(objects).where(objects.c.id == self.object_id))
            audit.append(connection, self._clock, "discarded", self.object_name, enrollment_id=self.id)

    def _close(self, connection: Connection, status: EnrollmentStatus) -> None:
        connection.execute(
            update(enrollments).where(enrollments.c.id == self.id).values(status=status, finished_utc=self._clock.utc())
        )

    def _missing(self, connection: Connection) -> tuple[int, ...]:
        present = set(connection.scalars(select(views.c.view_index).where(views.c.enrollment_id == self.id)))
        return tuple(index for index in range(len(self.planned_azimuth_deg)) if index not in present)

    def set_reference_image(self, image_bgr: NDArray[np.uint8]) -> None:
        """Keep what this sitting's camera saw of the empty table, uint8 (H, W, 3) BGR; durable when this returns.

        Raises
        ------
        UsageError, CatalogError, CatalogBusy
            As for `add`.
        """
        png = images.encode(image_bgr)
        image = self.folder / f"empty-{self.sitting.id:06d}.png"
        with self._database.write() as connection:
            self._check_in_progress(connection)
            write(self._database.root / image, png)
            connection.execute(
                update(sittings)
                .where(sittings.c.id == self.sitting.id)
                .values(
                    reference_image=image.as_posix(),
                    reference_image_sha256=images.digest(png),
                    reference_image_bytes=len(png),
                )
            )
        self.sitting = replace(self.sitting, reference_image=image.as_posix())

    def _check_in_progress(self, connection: Connection) -> None:
        status, deleted_utc = connection.execute(
            select(enrollments.c.status, objects.c.deleted_utc).join(objects).where(enrollments.c.id == self.id)
        ).first() or ("gone", None)
        if deleted_utc is not None:
            raise CatalogError(
                f"{self.object_name!r} was deleted while it was being enrolled",
                next_step=f"take the deletion back and go on: rig catalog undelete {self.object_name}",
            )
        if status != EnrollmentStatus.IN_PROGRESS:
            raise CatalogError(
                f"the enrollment of {self.object_name!r} is {status}, not in progress", next_step="begin a new one"
            )
