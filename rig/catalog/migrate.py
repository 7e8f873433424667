"""Migrate a catalog of an earlier version, with a backup."""

import sqlite3
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path

from sqlalchemy import Connection, NullPool, create_engine

from rig.catalog import audit, migrations
from rig.catalog.columns import FIX
from rig.catalog.failures import absent, catalog_errors
from rig.catalog.places import file_mode, image_file
from rig.catalog.schema import SCHEMA_VERSION
from rig.catalog.sqlite_database import check_schema, connect, database_exists, version_of
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock
from rig.core.errors import CatalogDamaged
from rig.core.files import open_new, sync_file, sync_folder


@dataclass(frozen=True, slots=True)
class Migration:
    """The versions before and after; `backup` is the old database, None if nothing had to be done."""

    before: int
    after: int
    backup: Path | None


def migrate(path: str | PathLike[str] | CatalogPlace, *, clock: Clock, busy_timeout_s: float = 5.0) -> Migration:
    """Migrate the catalog in the folder, or at the place, ``path`` to the version of this program, in one transaction.

    The old database stays beside it, for example as ``catalog-v1-20260131T120000Z.sqlite``. Images are not changed.
    A database on a server has no copy: it is migrated completely or not at all, while others read the old version.

    Raises
    ------
    CatalogError
        There is no catalog, it is of a newer version, or the disk is full or fails.
    CatalogDamaged
        Some rows refer to missing rows. Nothing was changed.
    CatalogBusy
        Another process locks the catalog for longer than the timeout.
    """
    place = CatalogPlace.of(path)
    if place.url is not None:
        from rig.catalog.postgres import migrate_server

        return Migration(*migrate_server(place, clock, _run_steps, busy_timeout_s), None)
    root = place.path
    with catalog_errors(root, busy_timeout_s):
        if not database_exists(root):
            raise absent(root)
        engine = create_engine("sqlite://", creator=partial(connect, root, "rw", busy_timeout_s), poolclass=NullPool)
        with engine.connect() as connection:
            connection.exec_driver_sql("PRAGMA foreign_keys = OFF")  # the steps replace tables that others refer to
            connection.exec_driver_sql("BEGIN IMMEDIATE")
            try:
                done = _migrate(connection, root, clock)
            except BaseException:
                connection.exec_driver_sql("ROLLBACK")
                raise
            connection.exec_driver_sql("COMMIT")
    return done


def _migrate(connection: Connection, root: Path, clock: Clock) -> Migration:
    before = version_of(connection, root)
    check_schema(connection, root, before)
    if before == SCHEMA_VERSION:
        return Migration(before, before, None)
    for name in connection.exec_driver_sql("SELECT image FROM views").scalars():
        image_file(root, name)
    backup = root / f"catalog-v{before}-{clock.utc():%Y%m%dT%H%M%SZ}.sqlite"
    _back_up(root, backup)
    try:
        _run_steps(connection, before)
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        raise CatalogDamaged(
            f"The catalog {root} has a value that no program stored; nothing was changed.",
            next_step=FIX,
            evidence={"error": str(error)},
        ) from error
    if broken := connection.exec_driver_sql("PRAGMA foreign_key_check").all():
        raise CatalogDamaged(
            f"{len(broken)} rows of the catalog {root} refer to missing rows; nothing was changed.",
            next_step="Restore the catalog from a backup, or ask for help with a copy of it.",
            evidence={"tables": sorted({row[0] for row in broken})},
        )
    connection.exec_driver_sql(f"PRAGMA user_version = {SCHEMA_VERSION}")
    audit.append(connection, clock, audit.Action.MIGRATED, before=before, after=SCHEMA_VERSION, backup=backup.name)
    return Migration(before, SCHEMA_VERSION, backup)


def _back_up(root: Path, backup: Path) -> None:
    part = backup.with_suffix(".part")
    open_new(part, mode=file_mode(root)).close()
    with closing(connect(root, "ro", busy_timeout_s=5)) as source, closing(sqlite3.connect(part)) as target:
        source.backup(target)
    sync_file(part)
    part.replace(backup)
    sync_folder(backup.parent)


def _run_steps(connection: Connection, before: int) -> None:
    # imported here because alembic is needed only for a migration
    from alembic.migration import MigrationContext
    from alembic.operations import Operations
    from alembic.script import ScriptDirectory

    folder = str(Path(migrations.__file__).parent)
    steps = ScriptDirectory(folder, version_locations=[folder])
    with Operations.context(MigrationContext.configure(connection)):
        for step in reversed(list(steps.iterate_revisions(str(SCHEMA_VERSION), str(before)))):
            step.module.upgrade()
