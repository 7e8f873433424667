"""The SQLite file of a catalog, and its transactions.

Decision: docs/decisions/0009.
"""

import os
import re
import sqlite3
import stat
import sys
from contextlib import closing, suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from sqlalchemy import DDL, Connection, Dialect, Engine, NullPool, QueuePool, StaticPool, create_engine, event, make_url
from sqlalchemy.orm import Session as Transaction

from rig.catalog.columns import FIX
from rig.catalog.database import APPLICATION, Database, check_properties, first_properties, properties
from rig.catalog.facts import FACTS, SCHEMA_VERSION, Entry, Row, json_text
from rig.catalog.failures import absent
from rig.catalog.images import leads_out
from rig.config.catalog_place import DATABASE_NAME, CatalogPlace
from rig.core.errors import CatalogDamaged, CatalogError
from rig.core.files import json_values, make_folder, sync_folder
from rig.views.image_files import IMAGE_FOLDER

APPLICATION_ID: Final = 0x48425247
"""``HBRG``: marks the SQLite file as a catalog (`PRAGMA application_id`)."""

_URL: Final = make_url("sqlite://")
#: Compiled statements of all catalogs.
_COMPILED: Final = dict[Any, Any]()

for _fact in FACTS:  # a program that changes a fact in place fails
    _changes = ("UPDATE", "DELETE") if _fact is Entry else ("UPDATE",)
    for _change in _changes:
        _statement = (
            f"CREATE TRIGGER {_fact.__tablename__}_no_{_change.lower()} BEFORE {_change} ON {_fact.__tablename__} "
            "BEGIN SELECT RAISE(ABORT, 'a fact is written once'); END"
        )
        event.listen(_fact.__table__, "after_create", DDL(_statement).execute_if(dialect="sqlite"))  # type: ignore[no-untyped-call]


class SqliteDatabase(Database):
    """The SQLite file of the catalog in a folder.

    A commit is durable (WAL, synchronous FULL). A writer takes the write lock at the start of its transaction: it waits
    there, or the transaction succeeds. Readers never wait.
    """

    def _engines(self) -> tuple[Engine, Engine]:
        pool = QueuePool(self._connect, dialect=_dialect())  # type: ignore[arg-type] # typeshed: no DBAPIConnection
        engine = Engine(pool, _dialect(), _URL, execution_options={"compiled_cache": _COMPILED})
        return engine, engine.execution_options(begin="BEGIN IMMEDIATE")

    def _begin(self, connection: Connection) -> None:
        connection.exec_driver_sql(connection.get_execution_options().get("begin", "BEGIN"))

    def _open(self, *, create: bool) -> None:
        if not self.place.database_file.exists():
            if not create or (self.root.exists() and not self.root.is_dir()):
                raise absent(self.root)
            check_folder(self.root)
            parent = next(parent for parent in self.root.parents if parent.exists())
            make_folder(self.root, within=parent, mode=0o700)
            self._create()
        with self._reads.begin() as connection:
            _check_kind(connection, self.root)
            _check_schema(connection, self.root)
            check_properties(properties(connection), self.place)
            journal = connection.exec_driver_sql("PRAGMA journal_mode").scalar()
        if journal != "wal" and not self.read_only:
            # Another program has changed the mode, for example for a backup. A kill would leave a rollback journal, and
            # `check_folder` rejects any.
            with closing(self._connect()) as changing:
                changing.execute("PRAGMA journal_mode = WAL")

    def damage(self, transaction: Transaction) -> list[str]:
        connection = transaction.connection()
        messages = connection.exec_driver_sql("PRAGMA integrity_check(20)").scalars().all()
        found = [] if messages == ["ok"] else [str(one) for one in messages]
        orphans = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
        found += [
            f"row {row_id} of {table} refers to a missing row of {parent}" for table, row_id, parent, _ in orphans
        ]
        return found

    def _connect(self) -> sqlite3.Connection:
        mode = "rw"
        if self.read_only:
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
        return os.access(self.root, os.W_OK) or self.place.database_file.with_name(f"{DATABASE_NAME}-wal").exists()

    def _create(self) -> None:
        """Create the database under another name and rename it when it is complete.

        Changing the journal mode of a file that other processes have open sometimes fails, with any timeout.
        """
        with TemporaryDirectory(prefix=".new-", dir=self.root) as folder:
            made = Path(folder, DATABASE_NAME)
            made.touch(0o600)  # private; to share a catalog, users change the permissions of its database
            with closing(sqlite3.connect(made, isolation_level=None)) as connection:
                connection.execute("PRAGMA journal_mode = WAL")
                connection.execute("BEGIN")
                for definition in _definitions():
                    connection.execute(definition)
                connection.executemany("INSERT INTO properties (key, value) VALUES (:key, :value)", first_properties())
                connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
                connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
                connection.execute("COMMIT")
            with suppress(FileExistsError):  # another process was faster
                self.place.database_file.hardlink_to(made)
        sync_folder(self.root)


_OWN: Final = (DATABASE_NAME, IMAGE_FOLDER)
_BESIDE: Final = tuple(f"{DATABASE_NAME}-{suffix}" for suffix in ("wal", "shm", "journal"))
"""Files that SQLite itself writes beside the database."""


def check_folder(root: Path) -> None:
    """Check the folder of a catalog before SQLite opens a file in it.

    Raises `CatalogDamaged`: something of the catalog in the folder ``root`` is a link; a file that belongs to SQLite
    has a second name or is a pipe or a device; or there is a rollback journal, which this program does not use.
    """
    for name in _OWN:
        if (root / name).is_symlink():
            raise leads_out(root / name)
    for name in _BESIDE:
        with suppress(FileNotFoundError):
            found = (root / name).lstat()
            if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
                raise leads_out(root / name)
            # SQLite plays a rollback journal back before this program can look at anything. One with a super-journal
            # record names any other file, and SQLite then deletes that file. This program leaves no such journal after
            # a kill: it writes with a write-ahead log only. The log itself (-wal) and its index (-shm) name no file;
            # the pages of the log are checked like the database.
            if found.st_size and name.endswith("-journal"):
                raise CatalogDamaged(
                    f"{os.fspath(root / name)!r} is a journal of another program. SQLite would change the catalog by "
                    "it, and delete the file that it may name. Nothing was opened or changed.",
                    next_step=FIX,
                    evidence={"bytes": found.st_size},
                )


def connect(root: Path, mode: str, busy_timeout_s: float) -> sqlite3.Connection:
    """Open the database in a folder that may come from an untrusted sender.

    The folder is checked first: SQLite plays a journal back before it reads the database. Nothing in its schema may
    call functions with side effects. Where Python can (from 3.12), SQLite's defensive mode also rejects statements that
    could damage the file.

    ``mode`` is ``rw`` or ``ro``, with further parameters of SQLite's URIs.

    Raises `CatalogDamaged`: as for `check_folder`.
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


@cache
def _dialect() -> Dialect:
    """Return the dialect of all catalogs: with one, SQLAlchemy does not compile the statements for each again."""
    engine = create_engine(_URL, poolclass=NullPool, json_serializer=json_text, json_deserializer=json_values)
    with engine.connect():  # asks SQLite for its version
        return engine.dialect


def _check_kind(connection: Connection, root: Path) -> None:
    """Check that the database is a catalog."""
    if connection.exec_driver_sql("PRAGMA application_id").scalar_one() != APPLICATION_ID:
        raise CatalogError(
            f"{root / DATABASE_NAME} is the database of another program.", next_step="Give the folder of a catalog."
        )
    version = connection.exec_driver_sql("PRAGMA user_version").scalar_one()
    check_properties({"application": APPLICATION, "version": str(version)}, CatalogPlace(root))


def _check_schema(connection: Connection, root: Path) -> None:
    """Raise `CatalogDamaged` if a database has other tables, indexes, triggers or views than a new one."""
    database = connection.connection.driver_connection
    assert isinstance(database, sqlite3.Connection)
    found, expected = _schema(database), _expected_schema()
    if found != expected:
        raise CatalogDamaged(
            f"The database of the catalog {root} has other tables, triggers or views than this program made; "
            "nothing was changed.",
            next_step=FIX,
            evidence={"version": SCHEMA_VERSION, "unknown": sorted(found.keys() - expected.keys())[:20]},
        )


def _schema(database: sqlite3.Connection) -> dict[str, str]:
    """Return the definitions of all tables, indexes, triggers and views by their names, without their white space."""
    rows = database.execute("SELECT name, type, tbl_name, sql FROM sqlite_master")
    return {str(row[0]): ascii((*row[1:3], re.sub(r'[\s"]+', "", str(row[3])))) for row in rows}


@cache
def _expected_schema() -> dict[str, str]:
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        for definition in _definitions():
            connection.execute(definition)
        return _schema(connection)


@cache
def _definitions() -> tuple[str, ...]:
    """Return the statements that create the tables and triggers; SQLAlchemy would compile them for each catalog."""
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        Row.metadata.create_all(create_engine("sqlite://", creator=lambda: connection, poolclass=StaticPool))
        rows = connection.execute("SELECT sql FROM sqlite_master WHERE name NOT GLOB 'sqlite_*' ORDER BY rowid")
        return tuple(definition for (definition,) in rows)
