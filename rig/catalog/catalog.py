"""The catalog: objects, their enrollments and views."""

from collections.abc import Sequence
from datetime import datetime
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import ColumnElement, Connection, and_, select, update

import hbr
from rig.catalog import audit
from rig.catalog.audit import AuditEntry
from rig.catalog.database import Database, insert_row
from rig.catalog.describing import known_descriptor
from rig.catalog.enrollment import Enrollment
from rig.catalog.queries import (
    EnrolledBefore,
    check_free,
    enrolled_before,
    enrollment_summaries,
    find,
    in_use,
    model_set,
    object_summaries,
    regions,
    stored_views,
)
from rig.catalog.records import (
    EnrollmentStatus,
    EnrollmentSummary,
    ObjectDetails,
    ObjectSummary,
    Provenance,
    Region,
    Sitting,
    StoredView,
    check_azimuth,
    check_text,
    clean_name,
)
from rig.catalog.schema import DESCRIPTOR, descriptors, enrollments, objects, sittings, views
from rig.core.clock import Clock
from rig.core.errors import CatalogError, ObjectExists, UsageError
from rig.core.files import make_folder
from rig.views import image_files as images


class ModelSet(NamedTuple):
    """The views that objects are retrieved by, and the id of each, int64 (n,), for `Catalog.view`."""

    views: hbr.Views
    view_ids: NDArray[np.int64]


class Catalog:
    """Objects with their enrollments and views in one folder: ``catalog.sqlite`` and ``images/``.

    Several processes may read and write at once. Times are the injected clock's. Open it with `Catalog.open`.
    """

    def __init__(self, database: Database, clock: Clock) -> None:
        self._database = database
        self._clock = clock

    @classmethod
    def open(
        cls,
        path: str | PathLike[str],
        *,
        clock: Clock,
        create: bool = True,
        read_only: bool = False,
        busy_timeout_s: float = 5.0,
    ) -> Self:
        """Open the catalog in the folder ``path``.

        Parameters
        ----------
        path
            Folder of the catalog.
        clock
            Gives the civil time of what is stored.
        create
            Make the catalog where there is none, unless it is opened read-only.
        read_only
            Write nothing.
        busy_timeout_s
            How long to wait while another process writes.

        Raises
        ------
        CatalogError
            There is no catalog, it is damaged or of a newer version, or the system denies access.
        CatalogBusy
            Another process kept the catalog for longer than the timeout.
        """
        root = Path(path).expanduser().absolute()
        return cls(Database(root, create=create, read_only=read_only, busy_timeout_s=busy_timeout_s), clock)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self._database.close()

    @property
    def database(self) -> Database:
        """For the other rooms of this package: everybody else asks the catalog."""
        return self._database

    @property
    def clock(self) -> Clock:
        """Gives the civil time of what is stored."""
        return self._clock

    @property
    def path(self) -> Path:
        """The catalog's folder."""
        return self._database.root

    def begin(
        self,
        name: str,
        *,
        planned_azimuth_deg: Sequence[float],
        provenance: Provenance,
        label: str | None = None,
        note: str | None = None,
        replace: bool = False,
    ) -> Enrollment:
        """Begin to enroll an object.

        Parameters
        ----------
        name
            Name of the object; see `clean_name`.
        planned_azimuth_deg
            Azimuth planned for view 0, 1, ..., each in [0, 360).
        provenance
            What the views are taken with.
        label, note
            Of the object; None leaves those of an object that is known already.
        replace
            Enroll a known object anew: its complete enrollment stays in use until the new one is complete, an
            unfinished one is abandoned.

        Raises
        ------
        UsageError
            The name or the plan cannot be used.
        ObjectExists
            The object is enrolled already and is not to be replaced.
        CatalogError
            It has an unfinished enrollment that is not to be replaced, or storing fails.
        CatalogBusy
            Another process is writing for longer than the timeout.
        """
        name = clean_name(name)
        plan = tuple(float(azimuth_deg) for azimuth_deg in planned_azimuth_deg)
        if not plan:
            raise UsageError("an enrollment with no views is planned", next_step="plan at least one view")
        for azimuth_deg in plan:
            check_azimuth(azimuth_deg)
        given = _texts(label, note)
        now = self._clock.utc()
        with self._database.write() as connection:
            object_id = connection.scalar(select(objects.c.id).where(in_use(name)))
            if object_id is None:
                texts = {"label": "", "note": ""} | given
                object_id = insert_row(connection, objects, name=name, created_utc=now, **texts)
            else:
                if not replace:
                    _check_not_enrolled(connection, object_id, name)
                connection.execute(
                    update(enrollments)
                    .where(_current(object_id, EnrollmentStatus.IN_PROGRESS))
                    .values(status=EnrollmentStatus.ABANDONED, finished_utc=now)
                )
                if given:
                    connection.execute(update(objects).where(objects.c.id == object_id).values(given))
            enrollment_id = insert_row(
                connection,
                enrollments,
                object_id=object_id,
                status=EnrollmentStatus.IN_PROGRESS,
                started_utc=now,
                planned_azimuth_deg=plan,
            )
            audit.append(
                connection,
                self._clock,
                "began to enroll",
                name,
                enrollment_id=enrollment_id,
                views=len(plan),
                replace=replace,
            )
            return self._sit_down(connection, enrollment_id, object_id, name, plan, provenance)

    def resumable(self, name: str) -> EnrollmentSummary | None:
        """Return the unfinished enrollment of an object, with the views it has, or None.

        Raises
        ------
        ObjectNotFound
            No object of that name is in the catalog.
        """
        with self._database.read() as connection:
            object_id, _ = find(connection, name)
            return next(iter(enrollment_summaries(connection, _current(object_id, EnrollmentStatus.IN_PROGRESS))), None)

    def resume(self, name: str, *, provenance: Provenance) -> Enrollment:
        """Go on with the unfinished enrollment of an object, perhaps on another bench.

        Raises
        ------
        ObjectNotFound
            No object of that name is in the catalog.
        CatalogError
            It has no unfinished enrollment, or storing fails.
        CatalogBusy
            Another process is writing for longer than the timeout.
        """
        with self._database.write() as connection:
            object_id, name = find(connection, name)
            unfinished = connection.execute(
                select(enrollments).where(_current(object_id, EnrollmentStatus.IN_PROGRESS))
            ).first()
            if unfinished is None:
                raise CatalogError(f"{name!r} has no unfinished enrollment", next_step="enroll it without --resume")
            plan = tuple(unfinished.planned_azimuth_deg)
            audit.append(connection, self._clock, "resumed", name, enrollment_id=unfinished.id)
            return self._sit_down(connection, unfinished.id, object_id, name, plan, provenance)

    def objects(self) -> list[ObjectSummary]:
        """Return all objects, in the order in which they came into the catalog; those deleted are left out."""
        with self._database.read() as connection:
            return object_summaries(connection, objects.c.deleted_utc.is_(None))

    def deleted(self) -> list[ObjectSummary]:
        """Return the objects that were deleted and can be taken back."""
        with self._database.read() as connection:
            return object_summaries(connection, objects.c.deleted_utc.is_not(None))

    def object(self, name: str) -> ObjectDetails:
        """Return an object with its enrollments and views.

        Raises
        ------
        ObjectNotFound
            No object of that name is in the catalog.
        """
        with self._database.read() as connection:
            object_id, _ = find(connection, name)
            (summary,) = object_summaries(connection, objects.c.id == object_id)
            return ObjectDetails(
                summary=summary,
                enrollments=tuple(enrollment_summaries(connection, enrollments.c.object_id == object_id)),
                views=tuple(stored_views(connection, _current(object_id, EnrollmentStatus.COMPLETE))),
            )

    def views(self, descriptor: str = DESCRIPTOR) -> ModelSet:
        """Return the views of every object's complete enrollment, by object and index, as a descriptor has them.

        Raises
        ------
        UsageError
            There is no such descriptor.
        DescriptorOutdated
            Some are not described by this version of it and cannot be compared.
        """
        kind = known_descriptor(descriptor)
        with self._database.read() as connection:
            return ModelSet(*model_set(connection, kind))

    def describes(self, descriptor: str) -> bool:
        """Whether any view is described by a descriptor; `views` tells whether all of those in use are."""
        with self._database.read() as connection:
            named = descriptors.c.name == descriptor
            return connection.scalar(select(descriptors.c.view_id).where(named).limit(1)) is not None

    def empty_tables(self) -> EnrolledBefore:
        """Return which objects were enrolled before a photographed empty table, and the newest of its pictures."""
        with self._database.read() as connection:
            return enrolled_before(connection)

    def read_empty_table(self, picture: tuple[str, str]) -> NDArray[np.uint8]:
        """Return a picture of the empty table, uint8 (H, W, 3), by its place and its digest.

        Raises
        ------
        CatalogError
            The file is missing, is not the one that was stored, or the system denies access.
        """
        image, sha256 = picture
        with self._database.in_words():
            return images.read(self.path / image, sha256)

    def regions(self, bench: str) -> set[tuple[Region | None, tuple[str, ...]]]:
        """Return the parts of its images that a bench's views are described within; None is all of an image.

        Each comes with the ids of the calibrations in force when its views were taken.
        """
        with self._database.read() as connection:
            return regions(connection, bench)

    def rename(self, name: str, new_name: str) -> None:
        """Give an object another name; its images stay where they are.

        Raises
        ------
        UsageError
            The new name cannot be used.
        ObjectNotFound
            No object of that name is in the catalog.
        ObjectExists
            Another object has the new name.
        """
        new_name = clean_name(new_name)
        with self._database.write() as connection:
            object_id, name = find(connection, name)
            if new_name == name:
                return
            check_free(connection, new_name)
            connection.execute(update(objects).where(objects.c.id == object_id).values(name=new_name))
            audit.append(connection, self._clock, "renamed", new_name, before=name)

    def describe(self, name: str, *, label: str | None = None, note: str | None = None) -> None:
        """Change the label or the note of an object; None leaves them.

        Raises
        ------
        UsageError
            They are no text.
        ObjectNotFound
            No object of that name is in the catalog.
        """
        given = _texts(label, note)
        with self._database.write() as connection:
            object_id, name = find(connection, name)
            if given:
                connection.execute(update(objects).where(objects.c.id == object_id).values(given))
                audit.append(connection, self._clock, "labelled", name, **given)

    def delete(self, *names: str) -> None:
        """Take objects out of use, all or none; they can be taken back (`undelete`) until `collect_garbage`.

        Raises
        ------
        ObjectNotFound
            No object of one of these names is in the catalog.
        """
        with self._database.write() as connection:
            for object_id, name in [find(connection, name) for name in dict.fromkeys(names)]:
                connection.execute(
                    update(objects).where(objects.c.id == object_id).values(deleted_utc=self._clock.utc())
                )
                audit.append(connection, self._clock, "deleted", name)

    def undelete(self, name: str) -> None:
        """Take an object back into use, the last one that was deleted under this name.

        Raises
        ------
        ObjectNotFound
            No such object can be taken back.
        ObjectExists
            An object of this name is in use.
        """
        with self._database.write() as connection:
            object_id, name = find(connection, name, deleted=True)
            check_free(connection, name)
            connection.execute(update(objects).where(objects.c.id == object_id).values(deleted_utc=None))
            audit.append(connection, self._clock, "undeleted", name)

    def note(self, action: str, object_name: str | None = None, **details: Any) -> None:
        """Write into the audit log what was done with the bench, such as "moved"; details are JSON values."""
        with self._database.write() as connection:
            audit.append(connection, self._clock, action, object_name, **details)

    def log(self, *, since: datetime | None = None, object_name: str | None = None) -> list[AuditEntry]:
        """Return what was done with this catalog, by whom and when, oldest first."""
        with self._database.read() as connection:
            return audit.entries(connection, since, object_name)

    def view(self, view_id: int) -> StoredView:
        """Return one view.

        Raises
        ------
        CatalogError
            There is no view with that id.
        """
        with self._database.read() as connection:
            found = stored_views(connection, views.c.id == int(view_id))
        if not found:
            raise CatalogError(
                f"there is no view {view_id} in the catalog {self.path}", next_step="load the views of the catalog anew"
            )
        return found[0]

    def image_path(self, view: StoredView) -> Path:
        """Return where the image of a view is."""
        return self.path / view.image

    def read_image(self, view: StoredView) -> NDArray[np.uint8]:
        """Return the pixels that were stored, uint8 (H, W, 3) BGR.

        Raises
        ------
        CatalogError
            The file is missing, is not the one that was stored, or the system denies access.
        """
        with self._database.in_words():
            return images.read(self.image_path(view), view.image_sha256)

    def _sit_down(
        self,
        connection: Connection,
        enrollment_id: int,
        object_id: int,
        object_name: str,
        plan: tuple[float, ...],
        provenance: Provenance,
    ) -> Enrollment:
        now = self._clock.utc()
        sitting_id = insert_row(
            connection,
            sittings,
            enrollment_id=enrollment_id,
            started_utc=now,
            bench=provenance.bench,
            software=provenance.software,
            devices=provenance.devices,
            conditions=provenance.conditions,
        )
        enrollment = Enrollment(
            self._database,
            self._clock,
            id=enrollment_id,
            object_id=object_id,
            object_name=object_name,
            sitting=Sitting(sitting_id, now, provenance),
            planned_azimuth_deg=plan,
        )
        make_folder(self.path / enrollment.folder, within=self.path)
        return enrollment


def _current(object_id: int, status: EnrollmentStatus) -> ColumnElement[bool]:
    return and_(enrollments.c.object_id == object_id, enrollments.c.status == status)


def _texts(label: str | None, note: str | None) -> dict[str, str]:
    given = {key: text for key, text in (("label", label), ("note", note)) if text is not None}
    for key, text in given.items():
        check_text(text, key)
    return given


def _check_not_enrolled(connection: Connection, object_id: int, name: str) -> None:
    for enrollment in enrollment_summaries(connection, enrollments.c.object_id == object_id):
        if enrollment.status == EnrollmentStatus.IN_PROGRESS:
            raise CatalogError(
                f"the enrollment of {name!r} is unfinished, with {len(enrollment.present)} of "
                f"{len(enrollment.planned_azimuth_deg)} views",
                next_step="go on with it (--resume), or begin anew (--replace)",
            )
        if enrollment.status == EnrollmentStatus.COMPLETE:
            raise ObjectExists(
                f"{name!r} is enrolled already, with {len(enrollment.present)} views",
                next_step="choose another name, or enroll it anew (--replace); "
                "the old views stay in use until the new ones are complete",
            )
