"""Queries about the descriptions of the enrolled views: their descriptors, regions and empty-table images."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import ColumnElement, Text, and_, cast, func, select

from hbr.descriptors import descriptor
from rig.calibrations.store import CALIBRATIONS
from rig.catalog.catalog import Catalog
from rig.catalog.columns import parse_mapping
from rig.catalog.describing import EmptyTable, region_of
from rig.catalog.queries import described_by, in_use, of_views, retrieved
from rig.catalog.records import EnrollmentStatus, Region
from rig.catalog.schema import descriptors, enrollments, objects, sessions, views
from rig.catalog.together import needs_segmentation
from rig.views.description import PAPER_DESCRIPTOR


class EmptyTables(NamedTuple):
    """Names of the objects that were enrolled with an empty-table image and without, and the newest of these images."""

    with_image: tuple[str, ...]
    without_image: tuple[str, ...]
    newest: EmptyTable | None


def has_descriptor(catalog: Catalog, name: str) -> bool:
    """Return whether any view is described by a descriptor. `Catalog.views` checks that all views in use are."""
    with catalog.database.read() as connection:
        described = select(descriptors.c.view_id).where(descriptors.c.name == name).limit(1)
        return connection.scalar(described) is not None


def empty_tables(catalog: Catalog) -> EmptyTables:
    """Return which of the objects in use were enrolled with an empty-table image."""
    newest = None
    with_image: dict[str, bool] = {}
    with catalog.database.read() as connection:
        for name, image, sha256 in connection.execute(
            select(objects.c.name, sessions.c.empty_table_image, sessions.c.empty_table_image_sha256)
            .select_from(objects)
            .join(enrollments)
            .join(sessions, sessions.c.enrollment_id == enrollments.c.id)
            .where(retrieved())
            .order_by(sessions.c.started_utc)
        ):
            with_image[name] = with_image.get(name, False) or image is not None
            newest = newest if image is None else (image, sha256)
    return EmptyTables(
        tuple(name for name, has_image in with_image.items() if has_image),
        tuple(name for name, has_image in with_image.items() if not has_image),
        newest,
    )


def camera_settings(catalog: Catalog) -> list[dict[str, Any]]:
    """Return the camera's settings (`rig.devices.camera.CameraLocks`) of the objects in use, each combination once."""
    return _camera_settings(catalog, and_(retrieved(), views.c.view_index == 0))


def unfinished_camera_settings(catalog: Catalog, name: str) -> list[dict[str, Any]]:
    """Return the camera's settings of the views of an unfinished enrollment, each combination once."""
    unfinished = enrollments.c.status == EnrollmentStatus.IN_PROGRESS
    return _camera_settings(catalog, and_(in_use(name), unfinished))


def _camera_settings(catalog: Catalog, condition: ColumnElement[bool]) -> list[dict[str, Any]]:
    settings: list[dict[str, Any]] = []
    with catalog.database.read() as connection:
        for evidence in connection.scalars(of_views(views.c.evidence).where(condition)):
            locks = evidence.get("locks")
            if isinstance(locks, dict) and locks not in settings:
                settings.append(locks)
    return settings


def guessed_objects(catalog: Catalog) -> tuple[str, ...]:
    """Return the names of the objects in use whose first view was segmented by a guess from this view alone."""
    with catalog.database.read() as connection:
        rows = connection.execute(
            of_views(objects.c.name, views.c.segmentation)
            .where(retrieved(), views.c.view_index == 0, views.c.segmentation.is_not(None))
            .order_by(objects.c.name)
        )
        return tuple(name for name, segmentation in rows if needs_segmentation(segmentation))


def newest_view(catalog: Catalog) -> EmptyTable | None:
    """Return path and SHA-256 of the first view of the newest enrollment in use; None if there is none."""
    with catalog.database.read() as connection:
        row = connection.execute(
            of_views(views.c.image, views.c.image_sha256)
            .where(retrieved(), views.c.view_index == 0)
            .order_by(views.c.id.desc())
            .limit(1)
        ).first()
    return None if row is None else (str(row[0]), str(row[1]))


def read_image(catalog: Catalog, stored: EmptyTable) -> NDArray[np.uint8]:
    """Return the pixels of a stored image, uint8 (H, W, 3) BGR.

    Raises
    ------
    CatalogError
        The file is missing, is not the stored one, or the system denies access.
    """
    with catalog.database.catalog_errors():
        return catalog.database.images.pixels(*stored)


def described_regions(catalog: Catalog, bench: str) -> set[tuple[Region | None, tuple[str, ...]]]:
    """Return the regions that the views of a bench are described within; None is the whole image.

    Each region comes with the ids of the calibration results in force when its views were taken. The views of a session
    have one region: the first view of each is read.
    """
    first = select(func.min(views.c.id)).where(views.c.session_id == sessions.c.id).correlate(sessions)
    with catalog.database.read() as connection:
        rows = connection.execute(
            select(cast(descriptors.c.settings, Text), cast(sessions.c.conditions, Text))
            .select_from(objects)
            .join(enrollments)
            .join(sessions, sessions.c.enrollment_id == enrollments.c.id)
            .join(views, views.c.id == first.scalar_subquery())
            .join(descriptors, described_by(descriptor(PAPER_DESCRIPTOR)))
            .where(retrieved(), sessions.c.bench == bench)
            .distinct()
        )
        return {
            (region_of(parse_mapping(settings)), tuple(map(str, parse_mapping(conditions).get(CALIBRATIONS) or ())))
            for settings, conditions in rows
        }
