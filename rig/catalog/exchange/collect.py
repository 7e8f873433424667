"""Out of a catalog: its objects, one after the other, with everything that is stored of them."""

from collections.abc import Collection, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, select

from rig.catalog.catalog import Catalog
from rig.catalog.exchange.package import Enrollment, ImageSource, Levels, Object, Package, Sitting, View
from rig.catalog.queries import find
from rig.catalog.schema import descriptors, enrollments, objects, sittings, views
from rig.views import image_files as images


def collect(catalog: Catalog, names: Collection[str] = ()) -> Iterator[tuple[Object, dict[str, Path]]]:
    """Yield objects in use in their order, each with the files of its images by the names they have outside.

    Those names number the objects and enrollments from 1, so that they do not depend on what else was in the catalog.

    Parameters
    ----------
    names
        Of the objects; all where none is named.

    Raises
    ------
    ObjectNotFound
        There is no object of one of these names.
    """
    with catalog.database.read() as connection:
        wanted = [objects.c.deleted_utc.is_(None)]
        if names:
            wanted.append(objects.c.id.in_([find(connection, name)[0] for name in names]))
        numbers = iter(range(1, 1 << 62))
        for place, row in enumerate(
            connection.execute(select(objects).where(*wanted).order_by(objects.c.id)).all(), start=1
        ):
            files: dict[str, Path] = {}
            found = []
            for enrollment in connection.execute(
                select(enrollments).where(enrollments.c.object_id == row.id).order_by(enrollments.c.id)
            ).all():
                folder = images.folder(place, row.name, next(numbers))
                sat = _sittings(connection, enrollment.id, folder, catalog.path, files)
                found.append(
                    Enrollment(
                        status=enrollment.status,
                        started_utc=enrollment.started_utc,
                        finished_utc=enrollment.finished_utc,
                        planned_azimuth_deg=tuple(enrollment.planned_azimuth_deg),
                        sittings=tuple(sat.values()),
                        views=tuple(_views(connection, enrollment.id, list(sat), folder, catalog.path, files)),
                    )
                )
            yield (
                Object(
                    name=row.name,
                    label=row.label,
                    note=row.note,
                    created_utc=row.created_utc,
                    enrollments=tuple(found),
                ),
                files,
            )


def package_of(catalog: Catalog, names: Collection[str] = ()) -> Package:
    """Return objects as they are in a catalog, to be brought into another."""
    collected, sources = [], {}
    for item, files in collect(catalog, names):
        collected.append(item)
        sources.update({name: ImageSource(str(path)) for name, path in files.items()})
    return Package(str(catalog.path), tuple(collected), sources, strict=True)


def _sittings(
    connection: Connection, enrollment_id: int, folder: Path, root: Path, files: dict[str, Path]
) -> dict[int, Sitting]:
    found = {}
    rows = connection.execute(
        select(sittings).where(sittings.c.enrollment_id == enrollment_id).order_by(sittings.c.id)
    ).all()
    for number, row in enumerate(rows):
        outside = None
        if row.reference_image is not None:
            outside = (folder / f"empty-{number:03d}{Path(row.reference_image).suffix}").as_posix()
            files[outside] = root / row.reference_image
        found[row.id] = Sitting(
            started_utc=row.started_utc,
            bench=row.bench,
            software=row.software,
            devices=row.devices,
            conditions=row.conditions,
            reference_image=outside,
            reference_image_sha256=row.reference_image_sha256,
            reference_image_bytes=row.reference_image_bytes,
        )
    return found


def _views(
    connection: Connection, enrollment_id: int, sitting_ids: list[int], folder: Path, root: Path, files: dict[str, Path]
) -> Iterator[View]:
    rows = connection.execute(
        select(views).where(views.c.enrollment_id == enrollment_id).order_by(views.c.view_index)
    ).all()
    described = {
        view_id: tuple(
            Levels(name=row.name, version=row.version, settings=row.settings, packed=row.packed.hex()) for row in group
        )
        for view_id, group in groupby(
            connection.execute(
                select(descriptors)
                .join(views)
                .where(views.c.enrollment_id == enrollment_id)
                .order_by(descriptors.c.view_id, descriptors.c.name, descriptors.c.version)
            ),
            lambda row: row.view_id,
        )
    }
    for row in rows:
        outside = (folder / f"{row.view_index:03d}{Path(row.image).suffix}").as_posix()
        files[outside] = root / row.image
        values: dict[str, Any] = {
            key: getattr(row, key)
            for key in (
                "azimuth_deg",
                "commanded_deg",
                "encoder_deg",
                "imu_deg",
                "imu_sigma_deg",
                "captured_utc",
                "captured_ns",
                "image_sha256",
                "image_bytes",
                "evidence",
                "segmentation",
            )
        }
        yield View(
            index=row.view_index,
            sitting=sitting_ids.index(row.sitting_id),
            image=outside,
            descriptors=described.get(row.id, ()),
            **values,
        )
