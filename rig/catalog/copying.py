"""Copy a whole catalog to another place, between SQLite and PostgreSQL, and check the copy by its digests.

Every row keeps its id and its digest. The rows are copied in one transaction, after the images.
"""

from collections.abc import Generator
from typing import Any, NamedTuple

from sqlalchemy import Connection, Table, func, select, text

from rig.catalog import audit
from rig.catalog.catalog import Catalog
from rig.catalog.jobs import JobProgress
from rig.catalog.postgres import LOST_READER_S, limit_idle, set_property
from rig.catalog.rows import copied_columns, insert_copies
from rig.catalog.schema import APPEND_ONLY, METADATA, objects, results, sessions, views
from rig.catalog.seal import appended_digests, damage_of, enrollment_digests, object_digests
from rig.core.errors import CatalogDamaged, CatalogError
from rig.core.next_steps import Do
from rig.views import image_files as images

_AT_ONCE = 500
"""Rows of an insertion."""

_TABLES = tuple(METADATA.sorted_tables)


class Copied(NamedTuple):
    """What was copied."""

    objects: int
    views: int
    results: int
    images: int
    image_bytes: int


def copy_catalog(source: Catalog, target: Catalog) -> Generator[JobProgress, None, Copied]:
    """Copy everything from a catalog into an empty one. The target stays empty if the call does not end.

    An interrupted copy can be repeated: an image that is there already, with the right bytes, is not copied again.

    Raises
    ------
    CatalogError, CatalogBusy
        The target is not empty, or one of them cannot be used.
    CatalogDamaged
        Something in the source is not as it was stored.
    """
    with source.database.read() as reading:
        damage = damage_of(reading, None, None)
        if damage is not None:
            raise damage
        for table in APPEND_ONLY:
            _check_appended(reading, table, source)
        with target.database.read() as connection:
            _check_empty(connection, target)
        wanted = _images(reading)
        size = 0
        for done, (name, sha256) in enumerate(wanted.items()):
            if done % 50 == 0:
                yield JobProgress(done, len(wanted))
            size += _copy_image(source, target, name, sha256)
        yield JobProgress(len(wanted), len(wanted))
        with target.database.write() as writing:
            _check_empty(writing, target)
            if writing.dialect.name == "postgresql":
                limit_idle(writing, LOST_READER_S)  # while the digests of the source are computed
            for table in _TABLES:
                _copy_rows(reading, writing, table)
            _give_ids(writing, source.database.last_ids(reading))
            _compare(reading, writing)
        counts = (_count(reading, objects), _count(reading, views), _count(reading, results))
        copied = Copied(*counts, len(wanted), size)
    with target.database.write() as connection:
        audit.append(connection, target.clock, audit.Action.COPIED, origin=str(source.place), **copied._asdict())
    return copied


def _check_empty(connection: Connection, target: Catalog) -> None:
    if any(_count(connection, table) for table in _TABLES):
        raise CatalogError(
            f"The catalog {target.place} is not empty.",
            next_step=("Give a new place, or", Do.MERGE()),
        )


def _count(connection: Connection, table: Table) -> int:
    return int(connection.scalar(select(func.count()).select_from(table)) or 0)


def _check_appended(connection: Connection, table: Table, source: Catalog) -> None:
    rows = appended_digests(connection, table)
    for expected, (row_id, sealed, found) in enumerate(rows, 1):
        if sealed != found or row_id != expected:
            raise CatalogDamaged(
                f"Row {expected} of {table.name} in the catalog {source.place} is not the one that was written.",
                next_step=Do.VERIFY_CATALOG(),
            )


def _images(connection: Connection) -> dict[str, str]:
    """Return the names of all images with their SHA-256."""
    wanted: dict[str, str] = {}
    for name, sha256 in (
        (views.c.image, views.c.image_sha256),
        (sessions.c.empty_table_image, sessions.c.empty_table_image_sha256),
        (results.c.image, results.c.image_sha256),
    ):
        wanted.update((row[0], row[1]) for row in connection.execute(select(name, sha256).where(name.is_not(None))))
    return wanted


def _copy_image(source: Catalog, target: Catalog, name: str, sha256: str) -> int:
    with target.database.catalog_errors():
        there = target.database.images.size(name)
        if there and images.digest(target.database.images.read(name)) == sha256:
            return there
    with source.database.catalog_errors():
        content = source.database.images.read(name)
    if images.digest(content) != sha256:
        raise CatalogDamaged(
            f"The image {source.database.images.where(name)} is not the one that was stored.",
            next_step=Do.REPAIR_CATALOG(),
        )
    with target.database.catalog_errors():
        target.database.images.write(name, content)
    return len(content)


def _copy_rows(reading: Connection, writing: Connection, table: Table) -> None:
    rows = reading.execution_options(yield_per=_AT_ONCE).execute(
        select(*copied_columns(reading, table)).order_by(*table.primary_key)
    )
    for part in rows.partitions(_AT_ONCE):
        insert_copies(writing, table, part)


def _give_ids(connection: Connection, given: dict[str, int]) -> None:
    """Set the last ids: an id that was given once must not be given again."""
    for name, last in given.items():
        if connection.dialect.name == "postgresql":
            if name in {table.name for table in APPEND_ONLY}:
                set_property(connection, name, str(last))
            elif last:
                connection.execute(text(f"SELECT setval('{name}_id_seq', :last)"), {"last": last})
        elif METADATA.tables[name].kwargs.get("sqlite_autoincrement") and last:
            values: dict[str, Any] = {"name": name, "last": last}
            if not connection.execute(
                text("UPDATE sqlite_sequence SET seq = :last WHERE name = :name"), values
            ).rowcount:
                connection.execute(text("INSERT INTO sqlite_sequence (name, seq) VALUES (:name, :last)"), values)
    if connection.dialect.name == "postgresql":  # an SQLite database does not count its sessions
        last = connection.scalar(select(func.max(sessions.c.id)))
        if last is not None:
            connection.execute(text("SELECT setval('sessions_id_seq', :last)"), {"last": last})


def _compare(reading: Connection, writing: Connection) -> None:
    """Compare the digests that are stored and those that the copied rows have."""
    before = [*object_digests(reading), *enrollment_digests(reading)]
    after = [*object_digests(writing), *enrollment_digests(writing)]
    for table in APPEND_ONLY:
        before += appended_digests(reading, table)
        after += appended_digests(writing, table)
    if before != after or any(sealed != found for _, sealed, found in after):
        raise CatalogError(
            "The copy is not equal to the catalog. Nothing was stored.",
            next_step=Do.REPORT_DEFECT(),
        )
