"""Read objects from a catalog, one after the other, with everything that is stored of them."""

from collections.abc import Collection, Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pydantic import ValidationError
from sqlalchemy import Connection, select

from rig.catalog.catalog import Catalog
from rig.catalog.columns import FIX
from rig.catalog.exchange.batch import (
    BundledDescriptor,
    Enrollment,
    ExportedObject,
    ImageSource,
    ImportBatch,
    Object,
    Session,
    View,
)
from rig.catalog.image_store import ImageStore
from rig.catalog.queries import find, packed_descriptors
from rig.catalog.rows import measured
from rig.catalog.schema import enrollments, objects, sessions, views
from rig.catalog.seal import check_loaded
from rig.core.errors import CatalogDamaged
from rig.views import image_files as images


def read_objects(catalog: Catalog, names: Collection[str] = ()) -> Generator[ExportedObject, None, None]:
    """Yield objects in use in their order, each with the files of its images by their paths in the export.

    The paths number the objects and enrollments from 1. They do not depend on what else was in the catalog.

    Parameters
    ----------
    names
        Names of the objects; empty for all objects.

    Raises
    ------
    ObjectNotFound
        There is no object of one of these names.
    """
    store = catalog.database.images
    with catalog.database.read() as connection:
        wanted = [objects.c.deleted_utc.is_(None)]
        if names:
            wanted.append(objects.c.id.in_([find(connection, name)[0] for name in names]))
        enrollment_numbers = iter(range(1, 1 << 62))
        rows = connection.execute(select(objects).where(*wanted).order_by(objects.c.id)).all()
        for number, row in enumerate(rows, start=1):
            theirs = select(enrollments.c.id).where(enrollments.c.object_id == row.id)
            check_loaded(connection, [row.id], list(connection.scalars(theirs)))
            files: dict[str, Path] = {}
            found = []
            for enrollment in connection.execute(
                select(enrollments).where(enrollments.c.object_id == row.id).order_by(enrollments.c.id)
            ).all():
                folder = images.folder(number, row.name, next(enrollment_numbers))
                by_id = _sessions(connection, enrollment.id, folder, store, files)
                own = tuple(_views(connection, enrollment.id, list(by_id), folder, store, files))
                with _checked(f"the enrollment {folder}"):
                    found.append(
                        Enrollment(
                            status=enrollment.status,
                            started_utc=enrollment.started_utc,
                            finished_utc=enrollment.finished_utc,
                            planned_azimuth_deg=tuple(enrollment.planned_azimuth_deg),
                            sessions=tuple(by_id.values()),
                            views=own,
                        )
                    )
            texts = {"name": row.name, "label": row.label, "note": row.note}
            with _checked(f"the object {row.name!r}"):
                item = Object(**texts, created_utc=row.created_utc, enrollments=tuple(found))
            yield item, files


def read_catalog(catalog: Catalog) -> ImportBatch:
    """Return the objects of a catalog, to be imported into another one."""
    found, sources = [], {}
    for item, files in read_objects(catalog):
        found.append(item)
        sources.update({name: ImageSource(str(path)) for name, path in files.items()})
    return ImportBatch(str(catalog.place), tuple(found), sources, strict=True)


def _sessions(
    connection: Connection, enrollment_id: int, folder: Path, store: ImageStore, files: dict[str, Path]
) -> dict[int, Session]:
    found = {}
    rows = connection.execute(
        select(sessions).where(sessions.c.enrollment_id == enrollment_id).order_by(sessions.c.id)
    ).all()
    for number, row in enumerate(rows):
        exported = None
        if row.empty_table_image is not None:
            exported = (folder / f"empty-{number:03d}{Path(row.empty_table_image).suffix}").as_posix()
            files[exported] = store.file(row.empty_table_image)
        columns = {name: getattr(row, name) for name in Session.model_fields}
        with _checked(f"session {number} of {folder}"):
            found[row.id] = Session(**(columns | {"empty_table_image": exported}))
    return found


def _views(
    connection: Connection,
    enrollment_id: int,
    session_ids: Sequence[int],
    folder: Path,
    store: ImageStore,
    files: dict[str, Path],
) -> Iterator[View]:
    of_enrollment = views.c.enrollment_id == enrollment_id
    packed = packed_descriptors(connection, of_enrollment)
    for row in connection.execute(select(views).where(of_enrollment).order_by(views.c.view_index)).all():
        exported = (folder / f"{row.view_index:03d}{Path(row.image).suffix}").as_posix()
        files[exported] = store.file(row.image)
        with _checked(f"the view {exported}"):
            view = View(
                index=row.view_index,
                session=session_ids.index(row.session_id),
                captured_utc=row.captured_utc,
                image=exported,
                image_sha256=row.image_sha256,
                image_bytes=row.image_bytes,
                descriptors=tuple(
                    BundledDescriptor(
                        name=one.name, version=one.version, settings=one.settings, packed=one.packed.hex()
                    )
                    for one in packed[row.id]
                ),
                **measured(row),
            )
        yield view


@contextmanager
def _checked(what: str) -> Iterator[None]:
    """Raise `CatalogDamaged` for values that no program stored and that an import would not accept."""
    try:
        yield
    except ValueError as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise CatalogDamaged(
            f"The catalog is damaged: {what} has impossible values.", next_step=FIX, evidence={"reason": reason}
        ) from error
