"""The SQLite file of a catalog: how it is opened, its transactions, and what goes wrong in words."""

import errno
import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from sqlalchemy import Connection, NullPool, QueuePool, Table, create_engine, event, insert
from sqlalchemy.exc import DBAPIError

from rig.catalog import images
from rig.catalog.schema import APPLICATION_ID, METADATA, SCHEMA_VERSION
from rig.errors import CatalogBusy, CatalogError, RigError
from rig.files import sync_folder

DATABASE_NAME: Final = "catalog.sqlite"


class Database:
    """The database of the catalog in the folder ``root``.

    A commit is durable (WAL, synchronous FULL). Writers take the write lock when they begin, so that a transaction
    either waits its turn at the start or goes through; readers never wait.

    Parameters
    ----------
    root
        Folder of the catalog.
    create
        Make the catalog where there is none.
    read_only
        Write nothing.
    busy_timeout_s
        How long a writer waits for another one.

    Raises
    ------
    CatalogError
        There is no catalog, it is damaged or of a newer version, or the system denies access.
    CatalogBusy
        Another process holds the catalog for longer than the timeout.
    """

    def __init__(self, root: Path, *, create: bool, read_only: bool, busy_timeout_s: float) -> None:
        self.root = root
        self._file = root / DATABASE_NAME
        self._read_only = read_only
        self._busy_timeout_s = busy_timeout_s
        self._engine = create_engine("sqlite://", creator=self._connect, poolclass=QueuePool)
        event.listen(self._engine, "begin", _begin)
        self._writing = self._engine.execution_options(begin="BEGIN IMMEDIATE")
        try:
            with self.in_words():
                self._open(create=create and not read_only)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._engine.dispose()

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that sees the catalog as it is at its first query."""
        with self.in_words(), self._engine.begin() as connection:
            yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """A transaction that is alone in writing; an exception takes it back."""
        if self._read_only:
            raise CatalogError(
                f"the catalog {self.root} is open for reading only", next_step="open it for writing to enroll"
            )
        with self.in_words(), self._writing.begin() as connection:
            yield connection

    @contextmanager
    def in_words(self) -> Iterator[None]:
        """Turn the errors of SQLite and of the file system into the catalog's."""
        try:
            yield
        except (DBAPIError, sqlite3.Error) as error:
            told = self._of_sqlite(error.orig if isinstance(error, DBAPIError) else error)
            if told is None:
                raise
            raise told from error
        except OSError as error:
            raise self._of_system(error) from error

    def _open(self, *, create: bool) -> None:
        if self.root.exists() and not self.root.is_dir():
            raise CatalogError(
                f"{self.root} is a file, not the folder of a catalog", next_step="give the folder of the catalog"
            )
        absent = CatalogError(
            f"there is no catalog in {self.root}", next_step="check the path, or enroll an object to create it"
        )
        if not self._file.exists() or not self._file.stat().st_size:
            if not create:
                raise absent
            images.make_folder(self.root, within=next(above for above in self.root.parents if above.exists()))
            self._create()
        with self.read() as connection:
            self._check_identity(connection)

    def _connect(self) -> sqlite3.Connection:
        mode = "rw"
        if self._read_only:
            mode = "ro" if self._is_shareable() else "ro&immutable=1"
        connection = sqlite3.connect(
            f"{self._file.as_uri()}?mode={mode}",
            uri=True,
            timeout=self._busy_timeout_s,
            isolation_level=None,
            check_same_thread=False,
        )
        try:
            connection.execute("PRAGMA foreign_keys = ON")
            connection.execute("PRAGMA synchronous = FULL")
        except BaseException:
            connection.close()
            raise
        return connection

    def _is_shareable(self) -> bool:
        # Readers of a WAL database share an index file beside it. Where they may not create it and no writer has,
        # the catalog rests (an archive, a read-only disk) and SQLite must be told that nobody will write.
        return os.access(self.root, os.W_OK) or self._file.with_name(f"{DATABASE_NAME}-wal").exists()

    def _create(self) -> None:
        """Make the database aside and give it its name when it is whole: nobody ever opens one that is half made.

        Changing the journal mode of a file that others open already would fail now and then, whatever the timeout.
        """
        with TemporaryDirectory(prefix=".new-", dir=self.root) as aside:
            made = Path(aside, DATABASE_NAME)
            engine = create_engine("sqlite://", creator=partial(sqlite3.connect, made), poolclass=NullPool)
            with engine.connect() as connection:
                connection.exec_driver_sql("PRAGMA journal_mode = WAL")
                METADATA.create_all(connection)
                connection.exec_driver_sql(f"PRAGMA application_id = {APPLICATION_ID}")
                connection.exec_driver_sql(f"PRAGMA user_version = {SCHEMA_VERSION}")
                connection.commit()
            try:
                self._file.hardlink_to(made)
            except FileExistsError:  # somebody was faster, or a program was cut off when it had made an empty file
                self._replace_empty(made)
        sync_folder(self.root)

    def _replace_empty(self, made: Path) -> None:
        with closing(self._connect()) as lock:
            lock.execute("BEGIN EXCLUSIVE")  # of those who find the same empty file one goes first
            if not self._file.stat().st_size:
                made.replace(self._file)

    def _check_identity(self, connection: Connection) -> None:
        application_id, version = _identity(connection)
        if application_id != APPLICATION_ID:
            raise CatalogError(
                f"{self._file} is the database of another program", next_step="give the folder of a catalog"
            )
        if version > SCHEMA_VERSION:
            raise CatalogError(
                f"the catalog {self.root} was written by a newer program: its schema has version {version}, "
                f"this program knows {SCHEMA_VERSION}",
                next_step="update hbr-rig on this computer",
                evidence={"found": version, "known": SCHEMA_VERSION},
            )

    def _of_sqlite(self, error: BaseException | None) -> RigError | None:
        evidence = {"sqlite": str(error)}
        match getattr(error, "sqlite_errorcode", 0) & 0xFF:
            case sqlite3.SQLITE_BUSY | sqlite3.SQLITE_LOCKED | sqlite3.SQLITE_PROTOCOL:
                return CatalogBusy(
                    f"another process is writing to the catalog {self.root} "
                    f"and was not done after {self._busy_timeout_s:g} s; nothing was changed",
                    next_step="wait until it is done and try again",
                    evidence=evidence,
                )
            case sqlite3.SQLITE_NOTADB:
                return CatalogError(
                    f"{self._file} is not a catalog", next_step="give the folder of a catalog", evidence=evidence
                )
            case sqlite3.SQLITE_CORRUPT:
                return CatalogError(
                    f"the catalog {self._file} is damaged",
                    next_step="copy the folder as it is, then restore the database from a backup",
                    evidence=evidence,
                )
            case sqlite3.SQLITE_FULL:
                return self._of_system(OSError(errno.ENOSPC, str(error)))
            case sqlite3.SQLITE_CANTOPEN | sqlite3.SQLITE_READONLY | sqlite3.SQLITE_PERM:
                return self._of_system(OSError(errno.EACCES, str(error)))
            case sqlite3.SQLITE_IOERR:
                return self._of_system(OSError(errno.EIO, str(error)))
        return None

    def _of_system(self, error: OSError) -> CatalogError:
        evidence = {"errno": errno.errorcode.get(error.errno or 0, "unknown"), "system": str(error)}
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return CatalogError(
                f"the disk of the catalog {self.root} is full; this change was not stored, all earlier ones are safe",
                next_step="free some space, then go on with the enrollment",
                evidence=evidence,
            )
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            return CatalogError(
                f"no permission to use the catalog {self.root}",
                next_step="have the folder and its files made writable for this user, or give another folder",
                evidence=evidence,
            )
        return CatalogError(
            f"the catalog {self.root} cannot be used: {error}",
            next_step="check the folder and its disk; a catalog belongs on a local disk",
            evidence=evidence,
        )


def insert_row(connection: Connection, table: Table, **values: object) -> int:
    """Insert a row and return its id."""
    row_id: int = connection.execute(insert(table).values(values).returning(table.c.id)).scalar_one()
    return row_id


def _begin(connection: Connection) -> None:
    connection.exec_driver_sql(connection.get_execution_options().get("begin", "BEGIN"))


def _identity(connection: Connection) -> tuple[int, int]:
    application_id: int = connection.exec_driver_sql("PRAGMA application_id").scalar_one()
    version: int = connection.exec_driver_sql("PRAGMA user_version").scalar_one()
    return application_id, version
