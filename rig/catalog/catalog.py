"""The catalog: objects with their enrollments and views."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from datetime import datetime
from os import PathLike
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, func, select, update

from rig.catalog import audit
from rig.catalog.audit import AuditEntry
from rig.catalog.database import Database, insert_row
from rig.catalog.describing import known_descriptor
from rig.catalog.enrollment import Enrollment
from rig.catalog.opening import open_database
from rig.catalog.queries import (
    ModelSet,
    check_not_enrolled,
    enrollment_summaries,
    find,
    in_use,
    model_set,
    object_summaries,
    of_views,
    retrieved,
    searched_version,
    stored_views,
    unfinished,
)
from rig.catalog.records import (
    EnrollmentStatus,
    EnrollmentSummary,
    ObjectDetails,
    ObjectSummary,
    Provenance,
    Session,
    StoredView,
    check_azimuth,
    checked_texts,
    clean_name,
)
from rig.catalog.rows import abandon_unfinished, insert_session, of_status, unfinished_and_complete
from rig.catalog.schema import enrollments, objects, views
from rig.catalog.seal import changing_enrollments, changing_object, damage_of, seal_enrollments, seal_objects
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock
from rig.core.errors import CatalogDamaged, CatalogError, UsageError
from rig.views.description import PAPER_DESCRIPTOR


class Catalog(AbstractContextManager["Catalog"]):
    """Objects with their enrollments and views.

    They are in one folder (``catalog.sqlite`` and ``images/``), or on a server for several benches (`CatalogPlace`).
    Open it with `Catalog.open`. Several processes may read and write at once. To edit, check, clean up, import and
    export it, use the functions of `rig.catalog.edit`, `.verify`, `.redescribe`, `.upkeep` and `.exchange`.

    Attributes
    ----------
    database
        The database; only for the other modules of this package.
    clock
        Gives the civil time of what is stored.
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
        """Open the catalog in the folder, or at the place, ``path``.

        Parameters
        ----------
        path
            Folder of the catalog; or its place, which may name a database server and a store of images.
        clock
            Gives the civil time of what is stored.
        create
            Create the catalog if there is none and ``read_only`` is False.
        read_only
            Write nothing.
        busy_timeout_s
            How long to wait while another process writes.

        Raises
        ------
        CatalogError
            There is no catalog, it is damaged or of another version of the program, or the system denies access.
        CatalogBusy
            Another process locks the catalog for longer than the timeout.
        CatalogUnavailable
            The server of the catalog does not answer.
        """
        place = CatalogPlace.of(path)
        return cls(open_database(place, create=create, read_only=read_only, busy_timeout_s=busy_timeout_s), clock)

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
        self._check_here(name, label, note, resume=resume, replace=replace)
        if not resume:
            self._check_elsewhere(clean_name(name), replace=replace)

    def _check_here(self, name: str, label: str | None, note: str | None, *, resume: bool, replace: bool) -> None:
        name = clean_name(name)
        checked_texts(label, note)
        with self.database.read() as connection:
            if resume:
                unfinished(connection, *find(connection, name))
            elif not replace and (object_id := connection.scalar(select(objects.c.id).where(in_use(name)))) is not None:
                check_not_enrolled(connection, object_id, name)

    def _check_elsewhere(self, name: str, *, replace: bool) -> None:
        """Check nothing: only the names of a journal are also those of another catalog."""

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
        """Start to enroll an object.

        Parameters
        ----------
        name
            Name of the object; see `clean_name`.
        planned_azimuth_deg
            Azimuth planned for view 0, 1, ..., each in [0, 360).
        provenance
            The bench, devices and settings that take the views.
        label, note
            Texts of the object; None leaves those of a known object unchanged.
        replace
            Enroll a known object again. Its complete enrollment stays in use until the new one is complete. An
            unfinished one is abandoned.

        Raises
        ------
        UsageError
            The name or the plan is not valid.
        ObjectExists
            The object is enrolled already and ``replace`` is False.
        CatalogError
            The object has an unfinished enrollment and ``replace`` is False, or storing fails.
        CatalogBusy
            Another process is writing for longer than the timeout.
        """
        name = clean_name(name)
        plan = tuple(float(azimuth_deg) for azimuth_deg in planned_azimuth_deg)
        if not plan:
            raise UsageError("The enrollment has no planned views.", next_step="Plan at least one view.")
        for azimuth_deg in plan:
            check_azimuth(azimuth_deg)
        texts = checked_texts(label, note)
        now = self.clock.utc()
        with self.database.write() as connection:
            object_id = connection.scalar(select(objects.c.id).where(in_use(name)))
            if object_id is None:
                object_id = insert_row(
                    connection, objects, name=name, created_utc=now, **({"label": "", "note": ""} | texts)
                )
                seal_objects(connection, [object_id])
            else:
                if not replace:
                    check_not_enrolled(connection, object_id, name)
                with changing_enrollments(connection, unfinished_and_complete(connection, object_id)):
                    abandon_unfinished(connection, object_id, now)
                if texts:
                    with changing_object(connection, object_id):
                        connection.execute(update(objects).where(objects.c.id == object_id).values(texts))
            enrollment_id = insert_row(
                connection,
                enrollments,
                object_id=object_id,
                status=EnrollmentStatus.IN_PROGRESS,
                started_utc=now,
                planned_azimuth_deg=plan,
            )
            seal_enrollments(connection, [enrollment_id])
            details = {"enrollment_id": enrollment_id, "views": len(plan), "replace": replace}
            audit.append(connection, self.clock, audit.Action.ENROLLMENT_STARTED, name, **details)
            return self._start_session(connection, enrollment_id, object_id, name, plan, provenance)

    def resumable(self, name: str) -> EnrollmentSummary | None:
        """Return the unfinished enrollment of an object, or None.

        Raises
        ------
        ObjectNotFound
            There is no object of that name.
        """
        with self.database.read() as connection:
            object_id, _ = find(connection, name)
            in_progress = of_status(object_id, EnrollmentStatus.IN_PROGRESS)
            return next(iter(enrollment_summaries(connection, in_progress)), None)

    def resume(self, name: str, *, provenance: Provenance) -> Enrollment:
        """Continue the unfinished enrollment of an object, on the same bench or on another one.

        Raises
        ------
        ObjectNotFound
            There is no object of that name.
        CatalogError
            It has no unfinished enrollment, or storing fails.
        CatalogBusy
            Another process is writing for longer than the timeout.
        """
        with self.database.write() as connection:
            object_id, name = find(connection, name)
            found = unfinished(connection, object_id, name)
            plan = tuple(found.planned_azimuth_deg)
            audit.append(connection, self.clock, audit.Action.ENROLLMENT_RESUMED, name, enrollment_id=found.id)
            return self._start_session(connection, found.id, object_id, name, plan, provenance)

    def objects(self) -> list[ObjectSummary]:
        """Return the objects in use, in the order in which they were added."""
        with self.database.read() as connection:
            return object_summaries(connection, objects.c.deleted_utc.is_(None))

    def known_objects(self) -> list[ObjectSummary]:
        """Return the objects that need not be enrolled: those in use. A journal adds those of its server."""
        return self.objects()

    def first_views(self) -> dict[str, int]:
        """Return the id of one view of each object in use, to show the object by."""
        with self.database.read() as connection:
            rows = connection.execute(
                of_views(objects.c.name, func.min(views.c.id).label("id")).where(retrieved()).group_by(objects.c.name)
            )
            return {row.name: row.id for row in rows}

    def summary(self, name: str) -> ObjectSummary:
        """Return an object without its enrollments and views, in any state; errors as for `object`."""
        with self.database.read() as connection:
            object_id, _ = find(connection, name)
            (summary,) = object_summaries(connection, objects.c.id == object_id)
            return summary

    def version(self) -> str:
        """Return a digest of what searches compare with, SHA-256: another one after every change of the objects."""
        with self.database.read() as connection:
            return searched_version(connection)

    def object(self, name: str) -> ObjectDetails:
        """Return an object with its enrollments and views.

        Raises
        ------
        ObjectNotFound
            There is no object of that name.
        """
        with self.database.read() as connection:
            object_id, _ = find(connection, name)
            (summary,) = object_summaries(connection, objects.c.id == object_id)
            return ObjectDetails(
                summary=summary,
                enrollments=tuple(enrollment_summaries(connection, enrollments.c.object_id == object_id)),
                views=tuple(stored_views(connection, of_status(object_id, EnrollmentStatus.COMPLETE))),
            )

    def damage(self, name: str | None = None) -> CatalogDamaged | None:
        """Return the error that rows of an object, or of any object, are not as they were stored; None if they are.

        Compares digests of rows, not of images: 0.2 s for 7,000 views. `rig.catalog.verify` compares everything.
        """
        with self.database.read() as connection:
            if name is None:
                return damage_of(connection, None, None)
            object_id, _ = find(connection, name)
            own = connection.scalars(select(enrollments.c.id).where(enrollments.c.object_id == object_id)).all()
            return damage_of(connection, [object_id], own)

    def views(self, descriptor: str = PAPER_DESCRIPTOR) -> ModelSet:
        """Return the views of every complete enrollment as a descriptor describes them, by object and index.

        Raises
        ------
        UsageError
            There is no such descriptor.
        DescriptorOutdated
            Some views are not described by this version of it and cannot be compared.
        CatalogDamaged
            An object or a view is not as it was stored.
        """
        kind = known_descriptor(descriptor)
        with self.database.read() as connection:
            return model_set(connection, kind)

    def note(self, action: audit.Action, object_name: str | None = None, **details: Any) -> None:
        """Add an action to the audit log; details are JSON values."""
        with self.database.write() as connection:
            audit.append(connection, self.clock, action, object_name, **details)

    def log(self, *, since: datetime | None = None, object_name: str | None = None) -> list[AuditEntry]:
        """Return the audit log: who did what and when, oldest first."""
        with self.database.read() as connection:
            return audit.entries(connection, since, object_name)

    def view(self, view_id: int) -> StoredView:
        """Return one view.

        Raises
        ------
        CatalogError
            There is no view with that id.
        """
        with self.database.read() as connection:
            found = stored_views(connection, views.c.id == int(view_id))
        if not found:
            raise CatalogError(
                f"There is no view {view_id} in the catalog {self.place}.", next_step="Load the views again."
            )
        return found[0]

    def image_path(self, view: StoredView) -> Path:
        """Return a file with the image of a view; a `CatalogDamaged` if its path leads out of the catalog.

        An image of an object store is fetched.
        """
        return self.database.images.file(view.image)

    def read_image(self, view: StoredView) -> NDArray[np.uint8]:
        """Return the pixels that were stored, uint8 (H, W, 3) BGR.

        Raises
        ------
        CatalogError
            The file is missing, is not the stored one, or the system denies access.
        """
        with self.database.catalog_errors():
            return self.database.images.pixels(view.image, view.image_sha256)

    def _start_session(
        self,
        connection: Connection,
        enrollment_id: int,
        object_id: int,
        object_name: str,
        plan: tuple[float, ...],
        provenance: Provenance,
    ) -> Enrollment:
        now = self.clock.utc()
        with changing_enrollments(connection, [enrollment_id]):
            session = Session(insert_session(connection, enrollment_id, now, provenance), now, provenance)
        enrollment = Enrollment(self.database, self.clock, enrollment_id, object_id, object_name, session, plan)
        self.database.images.make_folder(enrollment.folder.as_posix())
        return enrollment
