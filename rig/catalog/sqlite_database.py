"""The SQLite file of a catalog, and its transactions.

Decision: docs/decisions/0014.
"""

import os
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from sqlalchemy import Connection, NullPool, QueuePool, create_engine, event

from rig.catalog.columns import FIX
from rig.catalog.database import Database, check_version
from rig.catalog.failures import absent, catalog_errors
from rig.catalog.image_store import open_store
from rig.catalog.places import check_folder
from rig.catalog.schema import (
    APPLICATION_ID,
    KNOWN_NAMES,
    METADATA,
    SCHEMA_VERSION,
    expected_schema,
    schema_digest,
)
from rig.config.catalog_place import DATABASE_NAME, CatalogPlace
from rig.core.errors import CatalogDamaged, CatalogError
from rig.core.files import make_folder, sync_folder


class SqliteDatabase(Database):
    """The SQLite file of the catalog in a folder.

    A commit is durable (WAL, synchronous FULL). A writer takes the write lock at the start of its transaction: it waits
    there, or the transaction succeeds. Readers never wait.

    Parameters and errors are those of `rig.catalog.Catalog.open`.
    """

    def __init__(self, place: CatalogPlace, *, create: bool, read_only: bool, busy_timeout_s: float) -> None:
        self.place = place
        self.images = open_store(place)
        self._file = place.database_file
        self._read_only = read_only
        self._busy_timeout_s = busy_timeout_s
        self._engine = create_engine("sqlite://", creator=self._connect, poolclass=QueuePool)
        event.listen(self._engine, "begin", _begin)
        self._writing = self._engine.execution_options(begin="BEGIN IMMEDIATE")
        try:
            with self.catalog_errors():
                self._open(create=create and not read_only)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._engine.dispose()

    @contextmanager
    def read(self) -> Iterator[Connection]:
        with self.catalog_errors(), self._engine.begin() as connection:
            yield connection

    @contextmanager
    def write(self, enrollment_id: int | None = None) -> Iterator[Connection]:  # noqa: ARG002 - one writer at a time
        if self._read_only:
            raise self.read_only_error()
        with self.catalog_errors(), self._writing.begin() as connection:
            yield connection

    def catalog_errors(self) -> AbstractContextManager[None]:
        return catalog_errors(self.root, self._busy_timeout_s)

    def _open(self, *, create: bool) -> None:
        if not database_exists(self.root):
            if not create:
                raise absent(self.root)
            check_folder(self.root)
            parent = next(parent for parent in self.root.parents if parent.exists())
            make_folder(self.root, within=parent, mode=0o700)
            self._create()
        with self.read() as connection:
            _check_kind(connection, self.root)
            _check_schema(connection, self.root)
            journal = connection.exec_driver_sql("PRAGMA journal_mode").scalar()
        if journal != "wal" and not self._read_only:
            # Another program has changed the mode, for example for a backup. A kill would leave a rollback journal, and
            # `check_folder` rejects any.
            with closing(self._connect()) as changing:
                changing.execute("PRAGMA journal_mode = WAL")

    def damage(self, connection: Connection) -> list[str]:
        messages = connection.exec_driver_sql("PRAGMA integrity_check(20)").scalars().all()
        return [] if messages == ["ok"] else [str(message) for message in messages]

    def orphans(self, connection: Connection) -> list[tuple[str, int | None, str]]:
        found = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
        return [(table, row_id, parent) for table, row_id, parent, _ in found]

    def last_ids(self, connection: Connection) -> dict[str, int]:
        given = connection.exec_driver_sql("SELECT name, CAST(seq AS INTEGER) FROM sqlite_sequence")
        return {row[0]: row[1] for row in given}

    def settings(self, connection: Connection) -> list[tuple[str, Any, Any]]:
        journal = connection.exec_driver_sql("PRAGMA journal_mode").scalar()
        wrong = journal not in ("wal", "off")  # off: opened without permission to write
        return [("journal", journal, "wal")] if wrong else []

    def size_bytes(self, connection: Connection) -> int:  # noqa: ARG002
        return sum(file.stat().st_size for file in self.root.glob(f"{DATABASE_NAME}*"))

    def _connect(self) -> sqlite3.Connection:
        mode = "rw"
        if self._read_only:
            mode = "ro" if self._is_shareable() else "ro&immutable=1"
        connection = connect(self.root, mode, self._busy_timeout_s)
        try:
            connection.execute("PRAGMA foreign_keys = ON")
        except BaseException:
            connection.close()
            raise
        return connection

    def _is_shareable(self) -> bool:
        # Readers of a WAL database share an index file beside it. If they may not create it and no writer has created
        # it, the catalog is an archive or on a read-only disk: SQLite must know that no process will write.
        return os.access(self.root, os.W_OK) or self._file.with_name(f"{DATABASE_NAME}-wal").exists()

    def _create(self) -> None:
        """Create the database under another name and rename it when it is complete.

        Changing the journal mode of a file that other processes have open sometimes fails, with any timeout.
        """
        with TemporaryDirectory(prefix=".new-", dir=self.root) as folder:
            made = Path(folder, DATABASE_NAME)
            made.touch(0o600)  # private; to share a catalog, users change the permissions of its database
            engine = create_engine("sqlite://", creator=partial(sqlite3.connect, made), poolclass=NullPool)
            with engine.connect() as connection:
                connection.exec_driver_sql("PRAGMA journal_mode = WAL")
                METADATA.create_all(connection)
                connection.exec_driver_sql(f"PRAGMA application_id = {APPLICATION_ID}")
                connection.exec_driver_sql(f"PRAGMA user_version = {SCHEMA_VERSION}")
                connection.commit()
            try:
                self._file.hardlink_to(made)
            except FileExistsError:  # another process was faster, or one was killed after it had created an empty file
                self._replace_empty(made)
        sync_folder(self.root)

    def _replace_empty(self, made: Path) -> None:
        with closing(self._connect()) as lock:
            lock.execute("BEGIN EXCLUSIVE")  # only one of the processes that find the same empty file continues
            if not self._file.stat().st_size:
                made.replace(self._file)


def connect(root: Path, mode: str, busy_timeout_s: float) -> sqlite3.Connection:
    """Open the database in a folder that may come from an untrusted sender.

    The folder is checked first: SQLite plays a journal back before it reads the database. Nothing in its schema may
    call functions with side effects. Where Python can (from 3.12), SQLite's defensive mode also rejects statements that
    could damage the file.

    Parameters
    ----------
    mode
        ``rw`` or ``ro``, with further parameters of SQLite's URIs.

    Raises
    ------
    CatalogDamaged
        As for `check_folder`.
    """
    check_folder(root)
    connection = sqlite3.connect(
        f"{(root / DATABASE_NAME).as_uri()}?mode={mode}",
        uri=True,
        timeout=busy_timeout_s,
        isolation_level=None,
        check_same_thread=False,
    )
    try:
        if sys.version_info >= (3, 12):
            connection.setconfig(sqlite3.SQLITE_DBCONFIG_DEFENSIVE, True)
        for setting in ("trusted_schema = OFF", "cell_size_check = ON", "synchronous = FULL"):
            connection.execute(f"PRAGMA {setting}")
    except BaseException:
        connection.close()
        raise
    return connection


def database_exists(root: Path) -> bool:
    """Return whether a folder has a database. A program that was killed may have left an empty file."""
    if root.exists() and not root.is_dir():
        raise absent(root)
    file = root / DATABASE_NAME
    return file.exists() and file.stat().st_size > 0


def _check_kind(connection: Connection, root: Path) -> None:
    """Check that the database is a catalog, and of this version."""
    application_id = connection.exec_driver_sql("PRAGMA application_id").scalar_one()
    if application_id != APPLICATION_ID:
        raise CatalogError(
            f"{root / DATABASE_NAME} is the database of another program.", next_step="Give the folder of a catalog."
        )
    check_version(CatalogPlace(root), connection.exec_driver_sql("PRAGMA user_version").scalar_one())


def _check_schema(connection: Connection, root: Path) -> None:
    """Raise `CatalogDamaged` if a database has other tables, indexes, triggers or views than a new one."""
    database = connection.connection.driver_connection
    assert isinstance(database, sqlite3.Connection)
    if schema_digest(database) != expected_schema():
        names = sorted({str(name) for (name,) in database.execute("SELECT name FROM sqlite_master")} - KNOWN_NAMES)
        raise CatalogDamaged(
            f"The database of the catalog {root} has other tables, triggers or views than this program made; "
            "nothing was changed.",
            next_step=FIX,
            evidence={"version": SCHEMA_VERSION, "unknown": names[:20]},
        )


def _begin(connection: Connection) -> None:
    connection.exec_driver_sql(connection.get_execution_options().get("begin", "BEGIN"))
