"""The one transaction that takes staged objects into a catalog."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, insert, select, update

from rig.catalog import audit
from rig.catalog.catalog import Catalog
from rig.catalog.database import insert_row
from rig.catalog.describing import known_descriptor, settings_of
from rig.catalog.exchange.package import Enrollment, Object
from rig.catalog.exchange.plan import Plan, make_plan, names_in_use
from rig.catalog.exchange.stage import Staged
from rig.catalog.records import EnrollmentStatus, Region
from rig.catalog.schema import descriptors, enrollments, objects, sittings, views
from rig.catalog.upkeep import LOST
from rig.core.files import make_folder, sync_folder
from rig.views import image_files as images


def admit(
    catalog: Catalog, plan: Plan, wanted: Sequence[Object], staged: dict[str, Staged], folder: Path, label: str | None
) -> None:
    """Insert what is ``wanted`` of a plan and move its images from ``folder`` to their places; all of it or nothing.

    Raises
    ------
    ObjectExists
        Another process brought one of the objects in meanwhile.
    CatalogError, CatalogBusy
        The catalog cannot be written.
    """
    moved: list[tuple[Path, Path]] = []
    try:
        with catalog.database.write() as connection:
            # another process may have been faster
            make_plan(plan.package, plan.conflict, names_in_use(connection) - set(plan.skipped))
            for item in wanted:
                _insert(catalog, connection, item, plan, staged, folder, label, moved)
            for above in {target.parent for _, target in moved}:
                sync_folder(above)
            audit.append(
                connection,
                catalog.clock,
                "imported",
                origin=plan.package.origin,
                objects=[item.name for item in wanted],
                views=sum(len(enrollment.views) for item in wanted for enrollment in item.enrollments),
                replaced=list(plan.replaced),
            )
    except BaseException:
        for source, target in moved:
            target.rename(source)
        raise


def _insert(
    catalog: Catalog,
    connection: Connection,
    item: Object,
    plan: Plan,
    staged: dict[str, Staged],
    folder: Path,
    label: str | None,
    moved: list[tuple[Path, Path]],
) -> None:
    object_id = connection.scalar(
        select(objects.c.id).where(objects.c.name == item.name, objects.c.deleted_utc.is_(None))
    )
    if object_id is None:
        object_id = insert_row(
            connection,
            objects,
            name=item.name,
            label=item.label or label or "",
            note=item.note,
            created_utc=item.created_utc,
        )
    else:
        _make_way(catalog, connection, object_id, {enrollment.status for enrollment in item.enrollments})
    for enrollment in item.enrollments:
        enrollment_id = insert_row(
            connection,
            enrollments,
            object_id=object_id,
            status=enrollment.status,
            started_utc=enrollment.started_utc,
            finished_utc=enrollment.finished_utc,
            planned_azimuth_deg=enrollment.planned_azimuth_deg,
        )
        target = images.folder(object_id, item.name, enrollment_id)
        names = [view.image for view in enrollment.views]
        names += [sitting.reference_image for sitting in enrollment.sittings if sitting.reference_image]
        if names:
            _move(catalog.path, folder / Path(staged[names[0]].file).parent, target, moved)
        _insert_views(connection, enrollment_id, enrollment, staged, target, plan.package.regions)


def _make_way(catalog: Catalog, connection: Connection, object_id: int, statuses: set[EnrollmentStatus]) -> None:
    """Have the enrollments that are in use superseded or abandoned where others come."""
    for before, after in (
        (EnrollmentStatus.COMPLETE, EnrollmentStatus.SUPERSEDED),
        (EnrollmentStatus.IN_PROGRESS, EnrollmentStatus.ABANDONED),
    ):
        if before in statuses:
            values: dict[str, Any] = {"status": after}
            if before == EnrollmentStatus.IN_PROGRESS:
                values["finished_utc"] = catalog.clock.utc()
            connection.execute(
                update(enrollments)
                .where(enrollments.c.object_id == object_id, enrollments.c.status == before)
                .values(values)
            )


def _move(root: Path, source: Path, target: Path, moved: list[tuple[Path, Path]]) -> None:
    make_folder((root / target).parent, within=root)
    if (root / target).exists():  # of an import that was killed in its last moment; no row knows it
        aside = root / LOST / target
        make_folder(aside.parent, within=root)
        shutil.rmtree(aside, ignore_errors=True)
        (root / target).rename(aside)
    source.rename(root / target)
    moved.append((source, root / target))


def _insert_views(
    connection: Connection,
    enrollment_id: int,
    enrollment: Enrollment,
    staged: dict[str, Staged],
    target: Path,
    regions: dict[str, Region],
) -> None:
    sitting_ids = []
    for sitting in enrollment.sittings:
        values: dict[str, Any] = {}
        if sitting.reference_image is not None:
            one = staged[sitting.reference_image]
            values = {
                "reference_image": (target / Path(one.file).name).as_posix(),
                "reference_image_sha256": one.sha256,
                "reference_image_bytes": one.size,
            }
        sitting_ids.append(
            insert_row(
                connection,
                sittings,
                enrollment_id=enrollment_id,
                started_utc=sitting.started_utc,
                bench=sitting.bench,
                software=sitting.software,
                devices=sitting.devices,
                conditions=sitting.conditions,
                **values,
            )
        )
    rows = []
    for view in enrollment.views:
        one = staged[view.image]
        row = view.model_dump(exclude={"index", "sitting", "image", "image_sha256", "image_bytes", "descriptors"})
        rows.append(
            {
                **row,
                "segmentation": row["segmentation"] if one.segmentation is None else one.segmentation,
                "enrollment_id": enrollment_id,
                "view_index": view.index,
                "sitting_id": sitting_ids[view.sitting],
                "image": (target / Path(one.file).name).as_posix(),
                "image_sha256": one.sha256,
                "image_bytes": one.size,
            }
        )
    if not rows:
        return
    connection.execute(insert(views), rows)
    ids = {
        index: view_id
        for view_id, index in connection.execute(
            select(views.c.id, views.c.view_index).where(views.c.enrollment_id == enrollment_id)
        )
    }
    described = []
    for view in enrollment.views:
        levels = [(d.name, d.version, d.settings, bytes.fromhex(d.packed)) for d in view.descriptors]
        levels += [
            (name, known_descriptor(name).version, settings_of(regions.get(view.image)), packed)
            for name, packed in staged[view.image].packed
        ]
        described += [
            {"view_id": ids[view.index], "name": name, "version": version, "settings": settings, "packed": said}
            for name, version, settings, said in levels
        ]
    connection.execute(insert(descriptors), described)
