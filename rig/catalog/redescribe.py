"""Describe the stored images again after a descriptor, its version or its settings have changed."""

from collections.abc import Generator
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import Any, NamedTuple

from sqlalchemy import and_, bindparam, delete, insert, select, update

from rig.catalog.audit import Action
from rig.catalog.catalog import Catalog
from rig.catalog.describing import EmptyTable, known_descriptor, pack, region_of, settings_of, stored_describer
from rig.catalog.image_store import ImageStore
from rig.catalog.jobs import JobProgress, portions, processes
from rig.catalog.records import EnrollmentStatus, JsonObject, PackedDescriptor, Region
from rig.catalog.schema import descriptors, enrollments, objects, sessions, views
from rig.catalog.seal import changing_enrollments
from rig.core.errors import CatalogError, UsageError
from rig.core.processes import Jobs, map_in_processes
from rig.views.description import PAPER_DESCRIPTOR


class Stored(Enum):
    """Marks that each view keeps the region that it is described within."""

    REGION = "stored"


@dataclass(frozen=True, slots=True)
class Redescribed:
    """Numbers of views that were described now and before, and the images that failed, with the reasons."""

    descriptor: str
    version: int
    described: int
    unchanged: int
    failed: tuple[tuple[str, str], ...]


class _Item(NamedTuple):
    view_id: int
    image: str
    sha256: str
    region: Region | None
    empty_table: EmptyTable | None


class _Described(NamedTuple):
    """The packed levels of a view, or the reason why it cannot be described."""

    packed: PackedDescriptor | None
    segmentation: dict[str, Any] | None = None
    reason: str = ""


def redescribe(
    catalog: Catalog,
    descriptor: str = PAPER_DESCRIPTOR,
    *,
    region: Region | Stored | None = Stored.REGION,
    again: bool = False,
    jobs: Jobs | None = None,
) -> Generator[JobProgress, None, Redescribed]:
    """Describe the views of all objects in use that are not described by the present version of a descriptor.

    Results are committed in portions: after an interruption the next call continues there. A descriptor of the object
    alone uses the empty-table image of the session, if there is one, and its segmentation is stored with the view.

    Parameters
    ----------
    descriptor
        Its name (`hbr.descriptors`). Other descriptors of a view stay.
    region
        Part of the images to describe; None for the whole image. Imported images keep their regions.
    again
        Also describe views that are described already.
    jobs
        Number of processes, or a cluster; None for one process per core.

    Raises
    ------
    UsageError
        There is no such descriptor.
    CatalogError, CatalogBusy
        The catalog cannot be written.
    """
    kind = known_descriptor(descriptor)
    items, unchanged = _items(catalog, kind.name, kind.version, region, again)
    failed: list[tuple[str, str]] = []
    done = 0
    yield JobProgress(0, len(items))
    work = partial(_describe, catalog.database.images, kind.name)
    for portion, found in map_in_processes(work, portions(items), processes(jobs, len(items))):
        rows, segmentations = [], []
        for item, one in zip(portion, found, strict=True):
            if one.packed is None:
                failed.append((item.image, one.reason))
                continue
            rows.append({"view_id": item.view_id, **one.packed._asdict()})
            if one.segmentation is not None:
                segmentations.append({"of_view": item.view_id, "new": one.segmentation})
        with catalog.database.write() as connection:
            ids = [row["view_id"] for row in rows]
            alive = set(connection.scalars(select(views.c.id).where(views.c.id.in_(ids))))
            owners = connection.scalars(select(views.c.enrollment_id).where(views.c.id.in_(ids)).distinct())
            with changing_enrollments(connection, owners):
                connection.execute(
                    delete(descriptors).where(
                        and_(
                            descriptors.c.view_id.in_(ids),
                            descriptors.c.name == kind.name,
                            descriptors.c.version == kind.version,
                        )
                    )
                )
                if alive:
                    connection.execute(insert(descriptors), [row for row in rows if row["view_id"] in alive])
                if segmentations:
                    connection.execute(
                        update(views).where(views.c.id == bindparam("of_view")).values(segmentation=bindparam("new")),
                        segmentations,
                    )
        done += len(portion)
        yield JobProgress(done, len(items))
    if items:
        described = done - len(failed)
        catalog.note(
            Action.DESCRIBED_AGAIN, descriptor=kind.name, version=kind.version, views=described, failed=len(failed)
        )
    return Redescribed(kind.name, kind.version, done - len(failed), unchanged, tuple(failed))


def _items(
    catalog: Catalog, name: str, version: int, region: Region | Stored | None, again: bool
) -> tuple[list[_Item], int]:
    with catalog.database.read() as connection:
        wanted = connection.execute(
            select(
                views.c.id,
                views.c.image,
                views.c.image_sha256,
                views.c.encoder_deg,
                sessions.c.conditions,
                sessions.c.empty_table_image,
                sessions.c.empty_table_image_sha256,
            )
            .join(enrollments, views.c.enrollment_id == enrollments.c.id)
            .join(objects)
            .join(sessions, views.c.session_id == sessions.c.id)
            .where(
                objects.c.deleted_utc.is_(None),
                enrollments.c.status.in_([EnrollmentStatus.COMPLETE, EnrollmentStatus.IN_PROGRESS]),
            )
            .order_by(views.c.id)
        ).all()
        known: dict[int, dict[str, Any]] = {}
        present: dict[int, dict[str, Any]] = {}
        for view_id, other, its_version, settings in connection.execute(
            select(descriptors.c.view_id, descriptors.c.name, descriptors.c.version, descriptors.c.settings)
        ):
            # of several regions, that of the descriptor itself or of the paper's counts
            if view_id not in known or other in (PAPER_DESCRIPTOR, name):
                known[view_id] = settings
            if (other, its_version) == (name, version):
                present[view_id] = settings
    items, unchanged = [], 0
    for row in wanted:
        if isinstance(region, Stored) or row.encoder_deg is None:
            settings = known.get(row.id)
            part = region_of(settings) if settings is not None else _configured_region(row.conditions)
        else:
            part = region
        if not again and present.get(row.id) == settings_of(part):
            unchanged += 1
        else:
            table = row.empty_table_image
            empty_table = None if table is None else (table, row.empty_table_image_sha256)
            items.append(_Item(row.id, row.image, row.image_sha256, part, empty_table))
    return items, unchanged


def _configured_region(conditions: JsonObject) -> Region | None:
    """The region in the configuration of a session, for views without descriptors."""
    view = conditions.get("view")
    roi = view.get("roi") if isinstance(view, dict) else None
    return None if roi is None else region_of({"region": roi})


def _describe(store: ImageStore, name: str, portion: tuple[_Item, ...]) -> list[_Described]:
    kind = known_descriptor(name)
    found = []
    for item in portion:
        try:
            image = store.pixels(item.image, item.sha256)
            described = stored_describer(store, (kind.name,), item.region, item.empty_table)(image)
            (packed,) = pack(described.levels, item.region)
            found.append(_Described(packed, described.segmentation))
        except (CatalogError, UsageError) as error:
            found.append(_Described(None, reason=error.what))
        except (OSError, ValueError) as error:  # ValueError: the descriptor cannot describe this image
            found.append(_Described(None, reason=str(error)))
    return found
