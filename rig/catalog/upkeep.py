"""Statistics of a catalog, and the final removal of deleted data.

Decision: docs/decisions/0016.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sqlalchemy import Connection, and_, case, delete, func, or_, select

from hbr.descriptors import descriptor, names
from rig.catalog import audit, staging
from rig.catalog.catalog import Catalog
from rig.catalog.places import files_within
from rig.catalog.records import EnrollmentStatus
from rig.catalog.schema import SCHEMA_VERSION, descriptors, enrollments, objects, results, sessions, views
from rig.catalog.seal import changing_enrollments

_OLD: Final = (EnrollmentStatus.SUPERSEDED, EnrollmentStatus.ABANDONED)


@dataclass(frozen=True, slots=True)
class DescriptorStatistics:
    """Number of views with a version of a descriptor. `current`: this program can compare it."""

    name: str
    version: int
    views: int
    current: bool


@dataclass(frozen=True, slots=True)
class Statistics:
    """Numbers and sizes in bytes; `free_disk_bytes` is None for an object store.

    `collect_garbage` frees `deleted_image_bytes`, and with ``old`` `old_image_bytes`.
    """

    schema_version: int
    objects: int
    deleted_objects: int
    enrollments: dict[str, int]
    views: int
    image_bytes: int
    database_bytes: int
    free_disk_bytes: int | None
    labels: dict[str, int]
    benches: dict[str, int]
    descriptors: tuple[DescriptorStatistics, ...]
    log_entries: int
    results: int
    result_image_bytes: int
    deleted_image_bytes: int
    old_image_bytes: int


@dataclass(frozen=True, slots=True)
class GarbageReport:
    """What `collect_garbage` removed."""

    objects: tuple[str, ...]
    enrollments: int
    views: int
    files: int
    bytes: int


def statistics(catalog: Catalog) -> Statistics:
    """Return the statistics of a catalog."""
    known = {name: descriptor(name).version for name in names()}
    with catalog.database.read() as connection:
        # Count objects, enrollments and views.
        total, in_use = connection.execute(
            select(func.count(), func.count(case((objects.c.deleted_utc.is_(None), 1)))).select_from(objects)
        ).one()
        sizes = {
            (status, deleted): (count, view_count, size or 0)
            for status, deleted, count, view_count, size in connection.execute(
                select(
                    enrollments.c.status,
                    objects.c.deleted_utc.is_not(None).label("deleted"),
                    func.count(enrollments.c.id.distinct()),
                    func.count(views.c.id),
                    func.sum(views.c.image_bytes),
                )
                .join(objects)
                .outerjoin(views, views.c.enrollment_id == enrollments.c.id)
                .group_by(enrollments.c.status, "deleted")
            )
        }
        # Group objects by label, and views by bench and by descriptor.
        labels = connection.execute(
            select(objects.c.label, func.count())
            .where(objects.c.deleted_utc.is_(None))
            .group_by(objects.c.label)
            .order_by(objects.c.label)
        ).all()
        benches = connection.execute(
            select(sessions.c.bench, func.count(views.c.id))
            .join(views, views.c.session_id == sessions.c.id)
            .group_by(sessions.c.bench)
            .order_by(sessions.c.bench)
        ).all()
        described = connection.execute(
            select(descriptors.c.name, descriptors.c.version, func.count())
            .group_by(descriptors.c.name, descriptors.c.version)
            .order_by(descriptors.c.name, descriptors.c.version)
        ).all()
        # Count log entries and results.
        entries = len(audit.entries(connection))
        database_bytes = catalog.database.size_bytes(connection)
        stored = select(func.count(), func.sum(results.c.image_bytes)).select_from(results)
        recorded, recorded_bytes = connection.execute(stored).one()
    counts: dict[str, int] = {}
    for (status, _), (count, _, _) in sizes.items():
        counts[status] = counts.get(status, 0) + count
    return Statistics(
        schema_version=SCHEMA_VERSION,
        objects=in_use,
        deleted_objects=total - in_use,
        enrollments=counts,
        views=sum(view_count for _, view_count, _ in sizes.values()),
        image_bytes=sum(size for _, _, size in sizes.values()),
        database_bytes=database_bytes,
        free_disk_bytes=catalog.database.images.free_bytes(),
        labels=dict(labels),
        benches=dict(benches),
        descriptors=tuple(
            DescriptorStatistics(name, version, count, known.get(name) == version) for name, version, count in described
        ),
        log_entries=entries,
        results=recorded,
        result_image_bytes=recorded_bytes or 0,
        deleted_image_bytes=sum(size for (_, deleted), (_, _, size) in sizes.items() if deleted),
        old_image_bytes=sum(
            size for (status, deleted), (_, _, size) in sizes.items() if not deleted and status in _OLD
        ),
    )


def collect_garbage(catalog: Catalog, *, old: bool = False, dry_run: bool = False) -> GarbageReport:
    """Remove deleted objects, files that `verify` moved away, and files of interrupted imports.

    The rows are removed first, in one transaction. A crash after that leaves files without rows, which `verify` finds.
    Levels by earlier versions of a descriptor are removed if the view has the present version.

    Parameters
    ----------
    old
        Also remove the superseded and abandoned enrollments of objects in use.
    dry_run
        Change nothing; only return what would be removed.

    Raises
    ------
    CatalogError, CatalogBusy
        The catalog cannot be written.
    """
    transaction = catalog.database.read if dry_run else catalog.database.write
    with transaction() as connection:
        unused = connection.execute(
            select(enrollments.c.id, objects.c.name, objects.c.deleted_utc)
            .join(objects)
            .where(or_(objects.c.deleted_utc.is_not(None), enrollments.c.status.in_(_OLD if old else ())))
        ).all()
        ids = [row.id for row in unused]
        files = _files_of(connection, ids)
        for name in files:
            catalog.database.images.check(name)
        view_count = connection.scalar(select(func.count()).where(views.c.enrollment_id.in_(ids))) or 0
        deleted = tuple(
            connection.scalars(select(objects.c.name).where(objects.c.deleted_utc.is_not(None)).order_by(objects.c.id))
        )
        if not dry_run:
            _delete_rows(connection, ids)
    store = catalog.database.images
    with catalog.database.catalog_errors():
        files += sorted(store.lost())
        staged = [path for folder in staging.abandoned(catalog.path) for path in files_within(folder)]
        size = sum(map(store.size, files)) + sum(path.lstat().st_size for path in staged)
    count = len(files) + len(staged)
    collected = GarbageReport(deleted, len(ids), view_count, count, size)
    if not dry_run:
        with catalog.database.catalog_errors():
            store.remove(files)
            _remove(catalog.path, staged)
        if ids or deleted or count:
            catalog.note(
                audit.Action.GARBAGE_COLLECTED,
                objects=list(deleted),
                enrollments=len(ids),
                views=view_count,
                freed_bytes=size,
            )
    return collected


def _files_of(connection: Connection, ids: Sequence[int]) -> list[str]:
    return [
        *connection.scalars(select(views.c.image).where(views.c.enrollment_id.in_(ids))),
        *connection.scalars(
            select(sessions.c.empty_table_image).where(
                sessions.c.enrollment_id.in_(ids), sessions.c.empty_table_image.is_not(None)
            )
        ),
    ]


def _delete_rows(connection: Connection, ids: Sequence[int]) -> None:
    their_views = select(views.c.id).where(views.c.enrollment_id.in_(ids))
    connection.execute(delete(descriptors).where(descriptors.c.view_id.in_(their_views)))
    connection.execute(delete(views).where(views.c.enrollment_id.in_(ids)))
    connection.execute(delete(sessions).where(sessions.c.enrollment_id.in_(ids)))
    connection.execute(delete(enrollments).where(enrollments.c.id.in_(ids)))
    connection.execute(delete(objects).where(objects.c.deleted_utc.is_not(None)))
    later = descriptors.alias()
    for name in names():
        version = descriptor(name).version
        replaced = and_(
            descriptors.c.name == name,
            descriptors.c.version < version,
            select(later.c.view_id)
            .where(and_(later.c.view_id == descriptors.c.view_id, later.c.name == name, later.c.version == version))
            .exists(),
        )
        owners = connection.scalars(select(views.c.enrollment_id).join(descriptors).where(replaced).distinct())
        with changing_enrollments(connection, owners):
            connection.execute(delete(descriptors).where(replaced))


def _remove(root: Path, paths: Sequence[Path]) -> None:
    folders: set[Path] = set()
    for path in paths:
        path.unlink(missing_ok=True)
        folders.update(parent for parent in path.parents if parent != root and parent.is_relative_to(root))
    for folder in sorted(folders, key=lambda path: len(path.parts), reverse=True):
        with suppress(OSError):  # it is not empty
            folder.rmdir()
