"""An enrollment in progress: add views, then finish or abandon it."""

from concurrent.futures import Future
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, delete, select, update

from hbr.core.cores import THREADS
from rig.catalog import audit
from rig.catalog.database import Database
from rig.catalog.describing import EmptyTable, pack
from rig.catalog.records import EnrollmentStatus, ImageFile, Session, StoredView, ViewRecord
from rig.catalog.rows import NewView, empty_table_columns, insert_views, measured, supersede, unfinished_and_complete
from rig.catalog.schema import enrollments, objects, sessions, views
from rig.catalog.seal import changing_enrollments
from rig.catalog.together import (
    DescribedMeanwhile,
    HeldImages,
    describe_together,
    object_descriptors,
    objects_alone,
    stored_images,
    write_described,
)
from rig.core.clock import Clock
from rig.core.errors import CatalogError, UsageError
from rig.core.next_steps import Do
from rig.views import image_files as images
from rig.views.description import PAPER_DESCRIPTOR, Segmented


@dataclass(eq=False)
class Enrollment:
    """An enrollment in progress, as `Catalog.begin` or `Catalog.resume` returns it.

    An exception or a power cut loses nothing: the enrollment stays in progress and can be resumed.

    Attributes
    ----------
    id, object_id, object_name
        The enrollment and its object.
    session
        The present session.
    planned_azimuth_deg
        Azimuth planned for view 0, 1, ....
    """

    _database: Database
    _clock: Clock
    id: int
    object_id: int
    object_name: str
    session: Session
    planned_azimuth_deg: tuple[float, ...]

    def __post_init__(self) -> None:
        self._held = HeldImages(self._database.images)  # of this session: `revise` does not decode them again
        self._meanwhile = DescribedMeanwhile()
        self._empty_table: EmptyTable | None = None

    @property
    def folder(self) -> Path:
        """Folder of the images, relative to the catalog."""
        return images.folder(self.object_id, self.object_name, self.id)

    def missing(self) -> tuple[int, ...]:
        """Return the indices of the planned views that are not stored yet, ascending."""
        with self._database.read() as connection:
            return self._missing(connection)

    def add(
        self,
        record: ViewRecord,
        image_bgr: NDArray[np.uint8],
        encoded: Future[bytes] | None = None,
        segmented: Segmented | None = None,
    ) -> StoredView:
        """Store a view and its image, uint8 (H, W, 3) BGR. Both are durable when this returns.

        ``encoded`` is the image as PNG, if `rig.views.image_files.Encoder` began with it before, ``segmented``
        that of the `rig.views.description.DescribedView`.

        The image is complete under its name before its row is committed. A crash in between leaves an image without a
        row, which is harmless, and never a row without its image.

        Raises
        ------
        UsageError
            The view is not in the plan or not described, or the image has the wrong type or shape.
        TypeError, ValueError
            The levels do not fit their descriptor.
        CatalogError
            The view is stored already, the enrollment is no longer in progress, or the disk is full or fails.
        CatalogBusy
            Another process is writing for longer than the timeout.
        """
        index = record.index
        if index >= len(self.planned_azimuth_deg):
            raise UsageError(
                f"View {index} is not among the {len(self.planned_azimuth_deg)} planned views of {self.object_name!r}.",
                next_step="Start a new enrollment with a larger plan.",
            )
        if PAPER_DESCRIPTOR not in record.descriptors:
            raise UsageError(
                f"View {index} is not described by {PAPER_DESCRIPTOR}.", next_step="Describe it: hbr.describe."
            )
        packed = pack(record.descriptors, record.region)
        png = images.encode(image_bgr) if encoded is None else encoded.result()
        captured_utc = None
        if record.captured_ns is not None:
            age_ns = self._clock.now_ns() - record.captured_ns
            captured_utc = self._clock.utc() - timedelta(microseconds=age_ns // 1000)
        # The write lock is held while the image is written, so that two processes that continue the same enrollment
        # cannot overwrite each other's images.
        with self._database.write(self.id) as connection:
            self._check_in_progress(connection)
            if index not in self._missing(connection):
                raise CatalogError(
                    f"View {index} of {self.object_name!r} is stored already.",
                    next_step="Continue with the missing views; check that no other process enrolls this object.",
                )
            image = self._write_image(f"{index:03d}.png", png)
            new = NewView(index, measured(record), self.session.id, captured_utc, image, packed)
            with changing_enrollments(connection, [self.id]):
                (view_id,) = insert_views(connection, self.id, [new])
        self._held.hold(image.path, image_bgr)
        if self._empty_table is not None and segmented is not None:
            names = objects_alone(record.descriptors)
            self._meanwhile.begin(image.path, names, record.region, self._empty_table, segmented)
        return StoredView(
            id=view_id,
            object_name=self.object_name,
            enrollment_id=self.id,
            session=self.session,
            record=record,
            captured_utc=captured_utc,
            image=image.path,
            image_sha256=image.sha256,
            image_bytes=image.size,
        )

    def store_empty_table(self, image_bgr: NDArray[np.uint8]) -> None:
        """Store the empty-table image of this session, uint8 (H, W, 3) BGR. It is durable when this returns.

        Raises UsageError, CatalogError, CatalogBusy as for `add`.
        """
        png = images.encode(image_bgr)
        with self._database.write(self.id) as connection:
            self._check_in_progress(connection)
            image = self._write_image(f"empty-{self.session.id:06d}.png", png)
            with changing_enrollments(connection, [self.id]):
                connection.execute(
                    update(sessions).where(sessions.c.id == self.session.id).values(empty_table_columns(image))
                )
        self._held.hold(image.path, image_bgr)
        self._empty_table = image.path, image.sha256
        self.session = replace(self.session, empty_table_image=image.path)

    def revise(self) -> int:
        """Segment all stored views together, as a search does, and describe them again; return their number.

        Descriptors of the whole image stay, and so do views that were described by those alone. All or none of the
        views change; after an interruption call it again.

        Raises
        ------
        CatalogError
            An image cannot be read, or the enrollment is no longer in progress.
        CatalogBusy
            Another process is writing for longer than the timeout.
        """
        with self._database.read() as connection:
            names = object_descriptors(connection, self.id)
            images = stored_images(connection, self.id)
        if not names:
            return 0
        found = describe_together(self._held, names, images, threads=THREADS, meanwhile=self._meanwhile)
        for one in found:
            if one.reason:
                raise CatalogError(
                    f"A view of {self.object_name!r} cannot be segmented: {one.reason}.",
                    next_step=("Check the disk.", Do.CONTINUE_ENROLLMENT(name=self.object_name)),
                )
        with self._database.write(self.id) as connection:
            self._check_in_progress(connection)
            with changing_enrollments(connection, [self.id]):
                return write_described(connection, found)

    def finish(self) -> None:
        """Make this the enrollment that searches use. The previous one is superseded.

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
                    "are missing.",
                    next_step=(Do.CONTINUE_ENROLLMENT(name=self.object_name), "Or abandon it."),
                    evidence={"missing_views": list(missing)},
                )
            with changing_enrollments(connection, unfinished_and_complete(connection, self.object_id)):
                supersede(connection, self.object_id)
                self._close(connection, EnrollmentStatus.COMPLETE)
            details = {"enrollment_id": self.id, "views": len(self.planned_azimuth_deg)}
            audit.append(connection, self._clock, audit.Action.ENROLLED, self.object_name, **details)

    def abandon(self) -> None:
        """Abandon the enrollment. Its images stay, and the complete enrollment before it stays in use."""
        with self._database.write() as connection:
            self._check_in_progress(connection)
            with changing_enrollments(connection, [self.id]):
                self._close(connection, EnrollmentStatus.ABANDONED)
            audit.append(
                connection, self._clock, audit.Action.ENROLLMENT_ABANDONED, self.object_name, enrollment_id=self.id
            )

    def discard(self) -> None:
        """Delete an enrollment without views, and its object if it has no other enrollment.

        Raises
        ------
        CatalogError
            The enrollment has views or is no longer in progress.
        """
        with self._database.write() as connection:
            self._check_in_progress(connection)
            if len(self._missing(connection)) < len(self.planned_azimuth_deg):
                raise CatalogError(
                    f"The enrollment of {self.object_name!r} has views.",
                    next_step="Abandon the enrollment: its views stay in the catalog.",
                )
            connection.execute(delete(sessions).where(sessions.c.enrollment_id == self.id))
            connection.execute(delete(enrollments).where(enrollments.c.id == self.id))
            others = select(enrollments.c.id).where(enrollments.c.object_id == self.object_id)
            if connection.scalar(others) is None:
                connection.execute(delete(objects).where(objects.c.id == self.object_id))
            audit.append(
                connection, self._clock, audit.Action.ENROLLMENT_DISCARDED, self.object_name, enrollment_id=self.id
            )
        empty_table = self.session.empty_table_image
        left = (self.folder / "000.png").as_posix()  # there is none, but its folders are empty
        self._database.images.remove([left] if empty_table is None else [empty_table])

    def _write_image(self, name: str, png: bytes) -> ImageFile:
        path = (self.folder / name).as_posix()
        self._database.images.write(path, png)
        return ImageFile(path, images.digest(png), len(png))

    def _close(self, connection: Connection, status: EnrollmentStatus) -> None:
        connection.execute(
            update(enrollments).where(enrollments.c.id == self.id).values(status=status, finished_utc=self._clock.utc())
        )

    def _missing(self, connection: Connection) -> tuple[int, ...]:
        present = set(connection.scalars(select(views.c.view_index).where(views.c.enrollment_id == self.id)))
        return tuple(index for index in range(len(self.planned_azimuth_deg)) if index not in present)

    def _check_in_progress(self, connection: Connection) -> None:
        status, deleted_utc = connection.execute(
            select(enrollments.c.status, objects.c.deleted_utc).join(objects).where(enrollments.c.id == self.id)
        ).first() or ("gone", None)
        if deleted_utc is not None:
            raise CatalogError(
                f"{self.object_name!r} was deleted during its enrollment.",
                next_step=(Do.UNDELETE(name=self.object_name), Do.CONTINUE_ENROLLMENT(name=self.object_name)),
            )
        if status != EnrollmentStatus.IN_PROGRESS:
            raise CatalogError(
                f"The enrollment of {self.object_name!r} is {status}, not in progress.", next_step="Start a new one."
            )
