"""Descriptors anew from the stored images: when the descriptor, its version or its settings have changed."""

from collections.abc import Generator
from dataclasses import dataclass
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from sqlalchemy import and_, bindparam, delete, insert, select, update

from rig.catalog.catalog import Catalog
from rig.catalog.describing import Reference, known_descriptor, region_of, settings_of, stored_describer
from rig.catalog.jobs import Progressed, portions, processes
from rig.catalog.records import EnrollmentStatus, JsonObject, Region
from rig.catalog.schema import DESCRIPTOR, descriptors, enrollments, objects, sittings, views
from rig.core.errors import CatalogError, UsageError
from rig.core.processes import map_in_processes
from rig.views import image_files as images


class Stored(Enum):
    """The region that a view has been described within so far."""

    REGION = "stored"


@dataclass(frozen=True, slots=True)
class Redescribed:
    """How many views were described, how many were already, and which images could not be: path and reason."""

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
    reference: Reference | None


class _Found(NamedTuple):
    """What a descriptor says of a view, or the reason why it says nothing."""

    packed: bytes | None
    segmentation: dict[str, Any] | None = None
    reason: str = ""


def redescribe(
    catalog: Catalog,
    descriptor: str = DESCRIPTOR,
    *,
    region: Region | Stored | None = Stored.REGION,
    again: bool = False,
    jobs: int | None = None,
) -> Generator[Progressed, None, Redescribed]:
    """Describe the views of all objects in use that are not described by this descriptor, in its present version.

    Portions are committed as they are done: whatever ends the call, the next one goes on there. A descriptor that looks
    for the object does so by the sitting's picture of the empty table, where there is one, and what it found is stored
    with the view.

    Parameters
    ----------
    descriptor
        Its name (`hbr.descriptors`); what other descriptors say of a view stays beside it.
    region
        The part of the images that a bench has taken to describe; None for all of them. Images from elsewhere keep
        theirs.
    again
        Describe also what is described already.
    jobs
        Processes; one for each core otherwise.

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
    yield Progressed(0, len(items))
    work = partial(_describe, catalog.path, kind.name)
    for portion, found in map_in_processes(work, portions(items), processes(jobs, len(items))):
        rows, sightings = [], []
        for item, one in zip(portion, found, strict=True):
            if one.packed is None:
                failed.append((item.image, one.reason))
                continue
            settings = settings_of(item.region)
            rows.append(
                {"view_id": item.view_id, "name": kind.name, "version": kind.version, "settings": settings}
                | {"packed": one.packed}
            )
            if one.segmentation is not None:
                sightings.append({"seen_id": item.view_id, "seen": one.segmentation})
        with catalog.database.write() as connection:
            ids = [row["view_id"] for row in rows]
            alive = set(connection.scalars(select(views.c.id).where(views.c.id.in_(ids))))
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
            if sightings:
                connection.execute(
                    update(views).where(views.c.id == bindparam("seen_id")).values(segmentation=bindparam("seen")),
                    sightings,
                )
        done += len(portion)
        yield Progressed(done, len(items))
    if items:
        catalog.note(
            "described anew", descriptor=kind.name, version=kind.version, views=done - len(failed), failed=len(failed)
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
                sittings.c.conditions,
                sittings.c.reference_image,
                sittings.c.reference_image_sha256,
            )
            .join(enrollments, views.c.enrollment_id == enrollments.c.id)
            .join(objects)
            .join(sittings, views.c.sitting_id == sittings.c.id)
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
            # of several, what the views are retrieved by tells their region
            if view_id not in known or other in (DESCRIPTOR, name):
                known[view_id] = settings
            if (other, its_version) == (name, version):
                present[view_id] = settings
    items, unchanged = [], 0
    for row in wanted:
        if isinstance(region, Stored) or row.encoder_deg is None:
            settings = known.get(row.id)
            where = region_of(settings) if settings is not None else _intended(row.conditions)
        else:
            where = region
        if not again and present.get(row.id) == settings_of(where):
            unchanged += 1
        else:
            reference = Reference.of(row.reference_image, row.reference_image_sha256)
            items.append(_Item(row.id, row.image, row.image_sha256, where, reference))
    return items, unchanged


def _intended(conditions: JsonObject) -> Region | None:
    """The region that the configuration of a sitting names; views that are not described have no other trace of it."""
    roi = conditions.get("view", {}).get("roi")
    return None if roi is None else region_of({"region": roi})


def _describe(root: Path, name: str, portion: tuple[_Item, ...]) -> list[_Found]:
    kind = known_descriptor(name)
    found = []
    for item in portion:
        try:
            image = images.read(root / item.image, item.sha256)
            described = stored_describer(root, (kind.name,), item.region, item.reference)(image)
            found.append(_Found(kind.pack(described.levels[kind.name]), described.segmentation))
        except (CatalogError, UsageError) as error:
            found.append(_Found(None, reason=error.what))
        except (OSError, ValueError) as error:  # ValueError: the descriptor cannot describe such an image
            found.append(_Found(None, reason=str(error)))
    return found
