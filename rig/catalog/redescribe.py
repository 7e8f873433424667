"""Describe the stored images again after a descriptor, its version or its settings have changed."""

import json
from collections import defaultdict
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from functools import partial
from itertools import groupby
from typing import Any, Final, NamedTuple

from sqlalchemy import Connection, select

from hbr.descriptors import Descriptor
from hbr.descriptors import descriptor as descriptor_named
from rig.catalog.audit import Action
from rig.catalog.catalog import Catalog
from rig.catalog.describing import is_current, known_descriptor, pack, region_of, settings_of, stored_describer
from rig.catalog.image_store import ImageStore
from rig.catalog.jobs import JobProgress, portions_of_groups, processes
from rig.catalog.records import EnrollmentStatus, JsonObject, Region
from rig.catalog.schema import descriptors, enrollments, objects, sessions, views
from rig.catalog.seal import changing_enrollments
from rig.catalog.together import (
    Described,
    HeldImages,
    StoredImage,
    describe_together,
    needs_segmentation,
    write_described,
)
from rig.catalog.unfinished import UnfinishedJob
from rig.core.errors import CatalogError, UsageError
from rig.core.processes import Jobs, map_in_processes
from rig.views.description import PAPER_DESCRIPTOR

_READ_AT_ONCE: Final = 1024
"""Rows that are read from the catalog at once."""


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
    """A view to be described.

    ``together`` is whether the views of its enrollment are segmented again; ``names`` are the descriptors to compute.
    """

    view: StoredImage
    enrollment_id: int
    together: bool
    names: tuple[str, ...]


def redescribe(
    catalog: Catalog,
    descriptor: str = PAPER_DESCRIPTOR,
    *,
    region: Region | Stored | None = Stored.REGION,
    again: bool = False,
    jobs: Jobs | None = None,
    unfinished: UnfinishedJob | None = None,
) -> Generator[JobProgress, None, Redescribed]:
    """Describe the views of all objects in use that are not described by the present version of a descriptor.

    Results are committed in portions: after an interruption the next call continues there. For a descriptor of the
    object alone, views that were segmented by a guess, or not at all, are segmented together with the other views of
    their enrollment, as at its end (`rig.catalog.together`), and all descriptors of the object follow. Other views keep
    their segmentation.

    Parameters
    ----------
    descriptor
        Its name (`hbr.descriptors`). Other descriptors of a view stay.
    region
        Part of the images to describe; None for the whole image. Imported images keep their regions.
    again
        Also describe views that are described already, and segment them again.
    jobs
        Number of processes, or a cluster; None for one process per core.
    unfinished
        Stores which views were described ``again``. Those that it knows are left out.

    Raises
    ------
    UsageError
        There is no such descriptor.
    CatalogError, CatalogBusy
        The catalog cannot be written.
    """
    kind = known_descriptor(descriptor)
    items, unchanged = _items(catalog, kind, region, again)
    if unfinished is not None:
        items = [item for item in items if str(item.view.view_id) not in unfinished.found]
    failed: list[tuple[str, str]] = []
    done = 0
    yield JobProgress(0, len(items))
    work = partial(_describe, catalog.database.images)
    portions = _with_evidence(catalog, portions_of_groups(items, _group))
    for portion, found in map_in_processes(work, portions, processes(jobs, len(items))):
        failed += [(item.view.image, one.reason) for (item, _), one in zip(portion, found, strict=True) if one.reason]
        with catalog.database.write() as connection:
            ids = [item.view.view_id for item, _ in portion]
            owners = connection.scalars(select(views.c.enrollment_id).where(views.c.id.in_(ids)).distinct())
            with changing_enrollments(connection, owners):
                write_described(connection, found)
        if unfinished is not None:
            unfinished.store({str(item.view.view_id): None for item, _ in portion})
        done += len(portion)
        yield JobProgress(done, len(items))
    if items:
        described = done - len(failed)
        catalog.note(
            Action.DESCRIBED_AGAIN, descriptor=kind.name, version=kind.version, views=described, failed=len(failed)
        )
    return Redescribed(kind.name, kind.version, done - len(failed), unchanged, tuple(failed))


class _KnownDescriptors(NamedTuple):
    """By the id of each view: settings of its descriptors, those of the wanted one, and the current descriptors."""

    settings: dict[int, JsonObject]
    present: dict[int, JsonObject]
    current: dict[int, set[str]]


def _items(catalog: Catalog, kind: Descriptor, region: Region | Stored | None, again: bool) -> tuple[list[_Item], int]:
    items, unchanged = [], 0
    with catalog.database.read() as connection:
        known = _known(connection, kind)
        wanted = connection.execute(
            select(
                views.c.id,
                views.c.image,
                views.c.image_sha256,
                views.c.encoder_deg,
                views.c.segmentation,
                views.c.enrollment_id,
                views.c.session_id,
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
            .order_by(views.c.enrollment_id, views.c.id),
            execution_options={"yield_per": _READ_AT_ONCE},
        )
        for enrollment_id, group in groupby(wanted, lambda row: row.enrollment_id):
            own = list(group)
            regions = {row.id: _region(row, known.settings.get(row.id), region) for row in own}
            described = {
                row.id for row in own if not again and known.present.get(row.id) == settings_of(regions[row.id])
            }
            together = not kind.whole_image and (again or any(needs_segmentation(row.segmentation) for row in own))
            names = {kind.name}.union(*(known.current[row.id] for row in own)) if together else {kind.name}
            in_order = tuple(sorted(names))
            for row in own:
                if row.id in described and not together:
                    unchanged += 1
                    continue
                table = row.empty_table_image
                empty_table = None if table is None else (table, row.empty_table_image_sha256)
                image = StoredImage(row.id, row.image, row.image_sha256, row.session_id, regions[row.id], empty_table)
                items.append(_Item(image, enrollment_id, together, in_order))
    return items, unchanged


def _known(connection: Connection, kind: Descriptor) -> _KnownDescriptors:
    known = _KnownDescriptors({}, {}, defaultdict(set))
    distinct: dict[str, JsonObject] = {}  # many views share a few distinct ones
    for view_id, name, version, settings in connection.execute(
        select(descriptors.c.view_id, descriptors.c.name, descriptors.c.version, descriptors.c.settings),
        execution_options={"yield_per": _READ_AT_ONCE},
    ):
        settings = distinct.setdefault(repr(settings), settings)
        # if there are several regions, that of the descriptor or of the paper's descriptor counts
        if view_id not in known.settings or name in (PAPER_DESCRIPTOR, kind.name):
            known.settings[view_id] = settings
        if (name, version) == (kind.name, kind.version):
            known.present[view_id] = settings
        if is_current(name, version) and not descriptor_named(name).whole_image:
            known.current[view_id].add(name)
    return known


def _with_evidence(catalog: Catalog, portions: Iterable[tuple[_Item, ...]]) -> Iterator[tuple[tuple[_Item, str], ...]]:
    """Yield portions with the evidence of each view's segmentation, as JSON text; that of all views needs gigabytes."""
    for portion in portions:
        ids = [item.view.view_id for item in portion if not item.together]
        is_one = views.c.id.in_(ids)
        with catalog.database.read() as connection:
            found = connection.execute(select(views.c.id, views.c.segmentation).where(is_one)).all() if ids else ()
        evidence = {view_id: json.dumps(segmentation) for view_id, segmentation in found}
        yield tuple((item, evidence.get(item.view.view_id, "null")) for item in portion)


def _region(row: Any, settings: JsonObject | None, region: Region | Stored | None) -> Region | None:
    """The region to describe of a view; imported images, which have no angle of an encoder, keep theirs."""
    if not isinstance(region, Stored) and row.encoder_deg is not None:
        return region
    return region_of(settings) if settings is not None else _configured_region(row.conditions)


def _configured_region(conditions: JsonObject) -> Region | None:
    """The region in the configuration of a session, for views without descriptors."""
    view = conditions.get("view")
    roi = view.get("roi") if isinstance(view, dict) else None
    return None if roi is None else region_of({"region": roi})


def _group(item: _Item) -> tuple[bool, int]:
    """Return the key of the views that are segmented together: an enrollment, or one view."""
    return item.together, item.enrollment_id if item.together else item.view.view_id


def _describe(store: ImageStore, portion: tuple[tuple[_Item, str], ...]) -> list[Described]:
    found: list[Described] = []
    for (together, _), group in groupby(portion, lambda pair: _group(pair[0])):
        own = list(group)
        if together:
            found += describe_together(HeldImages(store), own[0][0].names, [item.view for item, _ in own])
        else:
            found += [_describe_one(store, item, evidence) for item, evidence in own]
    return found


def _describe_one(store: ImageStore, item: _Item, evidence: str) -> Described:
    """Describe a view by its stored segmentation."""
    view = item.view
    try:
        image = store.pixels(view.image, view.sha256)
        describe = stored_describer(store, item.names, view.region, view.empty_table)
        levels = describe(image, json.loads(evidence)).levels
        return Described(view.view_id, tuple(pack(levels, view.region)))
    except (CatalogError, UsageError) as error:
        return Described(view.view_id, reason=error.what.rstrip("."))
    except ValueError as error:
        return Described(view.view_id, reason=str(error))
