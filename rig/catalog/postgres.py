"""A catalog in a PostgreSQL database, for several benches at once.

The tables are those of SQLite. A table ``catalog_properties`` holds what SQLite keeps outside of tables: the kind and
the version of the database, its id, and the last ids of the append-only tables.

Decision: docs/decisions/0050.
"""

import uuid
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Final

from sqlalchemy import Column, Connection, MetaData, QueuePool, Table, Text, create_engine, func, select, text
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError

from rig.catalog.columns import damaged
from rig.catalog.database import Database, check_version
from rig.catalog.failures import server_errors
from rig.catalog.image_store import open_store
from rig.catalog.schema import APPEND_ONLY, METADATA, SCHEMA_VERSION
from rig.config.catalog_place import CatalogPlace
from rig.core.errors import CatalogError, CatalogUnavailable, ConfigError, ExtraMissing
from rig.core.files import make_folder
from rig.core.next_steps import Do

CHANNEL: Final = "hbr_rig_catalog"
"""Channel of the notifications about changes; the payload is the id of the catalog."""

APPLICATION: Final = "hbr-rig catalog"

_PROPERTIES: Final = Table(
    "catalog_properties", MetaData(), Column("key", Text, primary_key=True), Column("value", Text, nullable=False)
)

LOST_BENCH_S: Final = 30
"""After this time the server ends a transaction that has locks, of a bench that lost its network or its power."""

LOST_READER_S: Final = 12 * 3600
"""The same for a transaction without locks: longer, because exports and copies read images and rows in turn."""

_SETTINGS: Final = {
    "lock_timeout": "{busy_ms}",
    "idle_in_transaction_session_timeout": str(1000 * LOST_READER_S),
    "tcp_keepalives_idle": "10",
    "tcp_keepalives_interval": "5",
    "tcp_keepalives_count": "3",
    "synchronous_commit": "on",
}

_ENROLLMENT_LOCKS: Final = 0x48425200


class PostgresDatabase(Database):
    """The database of a catalog on a PostgreSQL server.

    A commit is durable. Transactions that change one enrollment share a lock of the whole catalog and have a lock of
    the enrollment; all others have the lock of the catalog alone. Readers have a snapshot and do not wait.

    Parameters and errors are those of `rig.catalog.Catalog.open`.
    """

    def __init__(self, place: CatalogPlace, *, create: bool, read_only: bool, busy_timeout_s: float) -> None:
        self.place = place
        self.images = open_store(place)
        make_folder(place.path, within=next(one for one in place.path.parents if one.exists()), mode=0o700)
        self._read_only = read_only
        self._busy_timeout_s = busy_timeout_s
        engine = _engine(place, busy_timeout_s)
        self._reading = engine.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)
        self._writing = engine.execution_options(isolation_level="READ COMMITTED")
        self._dispose = engine.dispose
        self._listener: Any = None
        try:
            with self.catalog_errors():
                self._open(create=create and not read_only)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._dispose()
        if self._listener is not None:
            self._listener.close()

    @contextmanager
    def read(self) -> Iterator[Connection]:
        with self.catalog_errors(), self._reading.begin() as connection:
            _check_version(properties(connection), self.place)
            yield connection

    @contextmanager
    def write(self, enrollment_id: int | None = None) -> Iterator[Connection]:
        if self._read_only:
            raise self.read_only_error()
        with self.catalog_errors(), self._writing.begin() as connection:
            # The transaction sees what was committed before it got the lock: each query has a snapshot of its own.
            lock_catalog(connection, enrollment_id)
            _check_version(properties(connection), self.place)
            yield connection
            connection.execute(select(func.pg_notify(CHANNEL, self.id)))

    def catalog_errors(self) -> AbstractContextManager[None]:
        return server_errors(self.place, self._busy_timeout_s)

    def _open(self, *, create: bool) -> None:
        with self._writing.begin() as connection:
            exists = _has_tables(connection)
        if not exists:
            if not create:
                raise _absent(self.place)
            self._create()
        with self._writing.begin() as connection:
            found = properties(connection)
        if found.get("application") != APPLICATION:
            raise CatalogError(f"{self.place} is the database of another program.", next_step="Check catalog.url.")
        self.id = found["id"]
        _check_version(found, self.place)
        self._check_mark()

    def _check_mark(self) -> None:
        """Check that the images are those of this catalog: if each bench had its own folder, images would be lost."""
        mark = self.images.mark()
        if mark == self.id:
            return
        where = self.images.where("images")
        fix = "Set catalog.images to the folder or the store that all benches of the catalog use."
        if mark is not None:
            raise CatalogError(f"{where} has the images of another catalog than {self.place}.", next_step=fix)
        with self.read() as connection:
            used = connection.scalar(select(func.count()).select_from(METADATA.tables["enrollments"])) or 0
        if used and self.images.is_empty():
            raise CatalogUnavailable(
                f"The images of the catalog {self.place} are not in {where}, which is empty.",
                next_step=f"Mount the network share if it is not mounted. Otherwise: {fix}",
            )
        if used:
            raise CatalogError(f"The images of the catalog {self.place} are not in {where}.", next_step=fix)
        if not self._read_only:
            self.images.set_mark(self.id)

    def _create(self) -> None:
        with self._writing.begin() as connection:
            connection.execute(select(func.pg_advisory_xact_lock(_ENROLLMENT_LOCKS)))
            if _has_tables(connection):
                return  # another process was faster
            _PROPERTIES.metadata.create_all(connection)
            METADATA.create_all(connection)
            first = {"application": APPLICATION, "version": str(SCHEMA_VERSION), "id": uuid.uuid4().hex}
            first |= {table.name: "0" for table in APPEND_ONLY}
            rows = [{"key": key, "value": value} for key, value in first.items()]
            connection.execute(_PROPERTIES.insert(), rows)

    def may_have_changed(self) -> bool:
        """Return whether the server has sent a notification; True without a connection: the next query reports it."""
        import psycopg

        try:
            if self._listener is None or self._listener.closed:
                url = make_url(str(self.place.url)).set(drivername="postgresql").render_as_string(hide_password=False)
                self._listener = psycopg.connect(url, autocommit=True, connect_timeout=5)
                self._listener.execute(f"LISTEN {CHANNEL}")
                return True  # what happened before is not known
            found = False
            for one in self._listener.notifies(timeout=0):
                found = found or one.payload == self.id
            self._listener.execute("SELECT 1")
            return found
        except (psycopg.Error, OSError):  # the connection is lost
            self._listener = None
            return True

    def damage(self, connection: Connection) -> list[str]:  # noqa: ARG002 - the server checks its own pages
        return []

    def orphans(self, connection: Connection) -> list[tuple[str, int | None, str]]:  # noqa: ARG002 - always enforced
        return []

    def last_ids(self, connection: Connection) -> dict[str, int]:
        found = properties(connection)
        given = {table.name: int(found.get(table.name, "0")) for table in APPEND_ONLY}
        for name in ("objects", "enrollments", "sessions", "views"):
            last = connection.execute(text(f"SELECT last_value, is_called FROM {name}_id_seq")).one()
            given[name] = last.last_value if last.is_called else 0
        return given

    def settings(self, connection: Connection) -> list[tuple[str, Any, Any]]:  # noqa: ARG002 - those of the server
        return []

    def size_bytes(self, connection: Connection) -> int:
        sizes = [
            connection.scalar(select(func.pg_total_relation_size(name))) or 0
            for name in (*METADATA.tables, _PROPERTIES.name)
        ]
        return sum(sizes)


def _absent(place: CatalogPlace) -> CatalogError:
    return CatalogError(
        f"The database {place} has no catalog.",
        next_step=("Check catalog.url, or", Do.ENROLL(), "This creates the catalog."),
    )


def limit_idle(connection: Connection, seconds: int) -> None:
    """Let the server end this transaction when the program has asked for nothing for this time."""
    statement = "SELECT set_config('idle_in_transaction_session_timeout', :ms, true)"
    connection.execute(text(statement), {"ms": str(1000 * seconds)})


def lock_catalog(connection: Connection, enrollment_id: int | None = None) -> None:
    """Wait for the lock of the catalog until the end of the transaction; or, shared, for that of one enrollment."""
    limit_idle(connection, LOST_BENCH_S)
    catalog = "CAST(CAST('catalog_properties' AS regclass) AS oid)"
    if enrollment_id is None:
        connection.execute(text(f"SELECT pg_advisory_xact_lock(CAST({catalog} AS bigint))"))
        return
    connection.execute(text(f"SELECT pg_advisory_xact_lock_shared(CAST({catalog} AS bigint))"))
    one = f"SELECT pg_advisory_xact_lock(CAST({catalog} AS integer), CAST(:id AS integer))"
    connection.execute(text(one), {"id": enrollment_id})


def properties(connection: Connection) -> dict[str, str]:
    """Return the properties of a catalog."""
    return {row.key: row.value for row in connection.execute(select(_PROPERTIES))}


def set_property(connection: Connection, key: str, value: str) -> None:
    """Change a property of a catalog."""
    connection.execute(_PROPERTIES.update().where(_PROPERTIES.c.key == key).values(value=value))


def _has_tables(connection: Connection) -> bool:
    # to_regclass may answer from a cache of the session
    here = "relnamespace = CAST(current_schema() AS regnamespace)"
    found = f"SELECT count(*) FROM pg_class WHERE relname = :name AND {here}"
    return bool(connection.execute(text(found), {"name": _PROPERTIES.name}).scalar())


def _check_version(found: dict[str, str], place: CatalogPlace) -> None:
    try:
        version = int(found["version"])
    except (KeyError, ValueError) as error:
        raise damaged("the version of its schema", found.get("version")) from error
    check_version(place, version)


def _engine(place: CatalogPlace, busy_timeout_s: float) -> Any:
    assert place.url is not None
    settings = {key: value.format(busy_ms=max(1, round(1000 * busy_timeout_s))) for key, value in _SETTINGS.items()}
    options = " ".join(f"-c {key}={value}" for key, value in settings.items())
    try:
        url = make_url(place.url)
        if url.drivername not in ("postgresql", "postgresql+psycopg"):
            raise ArgumentError("another kind of database")
        if place.url.partition("?")[0].count("@") > 1:  # the driver's errors would show a part of the password
            raise ArgumentError("an @ in the password")
        given = url.query.get("options", "")
        return create_engine(
            url.difference_update_query(["options"]),
            poolclass=QueuePool,
            pool_pre_ping=True,
            pool_use_lifo=True,
            connect_args={
                "options": f"{options} {given}",
                "connect_timeout": 5,
                "application_name": "hbr-rig",
                "tcp_user_timeout": 15_000,
            },
        )
    except (ArgumentError, ValueError) as error:
        raise ConfigError(
            f"catalog.url = {str(place)!r} is not the URL of a PostgreSQL database.",
            next_step="Give postgresql+psycopg://USER@HOST/DATABASE; the password belongs in ~/.pgpass.",
        ) from error
    except ImportError as error:
        raise ExtraMissing.of("postgres", "catalogs on PostgreSQL", error) from error
