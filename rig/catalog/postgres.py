"""A catalog in a PostgreSQL database, for several benches at once.

Decision: docs/decisions/0011.
"""

from typing import Final

from sqlalchemy import DDL, Connection, Engine, QueuePool, create_engine, event, func, insert, inspect, select, text
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError

from rig.catalog.database import Database, check_properties, first_properties, properties
from rig.catalog.facts import FACTS, Enrollment, Entry, Property, Row, json_text
from rig.config.catalog_place import CatalogPlace
from rig.core.errors import CatalogError, CatalogUnavailable, ConfigError, ExtraMissing
from rig.core.files import json_values, make_folder
from rig.core.next_steps import Do

_CREATION: Final = 0x48425200
"""Lock of the creation of the tables."""

_LOCK: Final = f"SELECT pg_advisory_xact_lock(CAST(CAST('{Property.__tablename__}' AS regclass) AS bigint))"
"""Takes the lock of a catalog."""

for _fact in FACTS:  # a program that changes a fact in place fails
    _table = _fact.__tablename__
    _changes = ("UPDATE", "DELETE", "TRUNCATE") if _fact is Entry else ("UPDATE",)
    for _statement in (
        f"CREATE FUNCTION {_table}_no_change() RETURNS trigger LANGUAGE plpgsql AS "
        "$$ BEGIN RAISE EXCEPTION 'a fact is written once'; END $$",
        *(
            f"CREATE TRIGGER {_table}_no_{_change.lower()} BEFORE {_change} ON {_table} "
            f"{'' if _change == 'TRUNCATE' else 'FOR EACH ROW '}EXECUTE FUNCTION {_table}_no_change()"
            for _change in _changes
        ),
    ):
        event.listen(_fact.__table__, "after_create", DDL(_statement).execute_if(dialect="postgresql"))  # type: ignore[no-untyped-call]

LOST_BENCH_S: Final = 30
"""After this time the server ends a transaction that has locks, of a bench that lost its network or its power."""

LOST_READER_S: Final = 12 * 3600
"""The same for a transaction without locks: longer, because exports and copies read images and rows in turn."""

# A bench that loses its network is noticed after 10 + 3 x 5 s. A commit waits for the disk, because a view must survive
# a power cut.
_SETTINGS: Final = {
    "lock_timeout": "{busy_ms}",
    "idle_in_transaction_session_timeout": str(1000 * LOST_READER_S),
    "tcp_keepalives_idle": "10",
    "tcp_keepalives_interval": "5",
    "tcp_keepalives_count": "3",
    "synchronous_commit": "on",
}


class PostgresDatabase(Database):
    """The database of a catalog on a PostgreSQL server.

    A commit is durable. A transaction that writes has the lock of the catalog. Readers have a snapshot and do not wait.
    """

    def _engines(self) -> tuple[Engine, Engine]:
        place = self.place
        make_folder(place.path, within=next(one for one in place.path.parents if one.exists()), mode=0o700)
        engine = _engine(place, self._busy_timeout_s)
        return (
            engine.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True),
            engine.execution_options(isolation_level="READ COMMITTED", begin=_LOCK),
        )

    def _begin(self, connection: Connection) -> None:
        if lock := connection.get_execution_options().get("begin"):
            # The transaction sees what was committed before it got the lock: each query has a snapshot of its own.
            limit_idle(connection, LOST_BENCH_S)
            connection.execute(text(lock))
        check_properties(properties(connection), self.place)

    def _open(self, *, create: bool) -> None:
        with self._writes.begin() as connection:
            if not _has_tables(connection):
                if not create:
                    raise CatalogError(
                        f"The database {self.place} has no catalog.",
                        next_step=("Check catalog.url, or", Do.ENROLL(), "This creates the catalog."),
                    )
                connection.execute(select(func.pg_advisory_xact_lock(_CREATION)))
                if not _has_tables(connection):  # else another process was faster
                    Row.metadata.create_all(connection)
                    connection.execute(insert(Property), first_properties())
            found = properties(connection)
        check_properties(found, self.place)
        self.id = found["id"]
        self._check_mark()

    def _check_mark(self) -> None:
        """Check that the images are those of this catalog: if each bench had its own folder, images would be lost."""
        mark = self.images.mark()
        if mark == self.id:
            return
        where = self.images.where("")
        fix = "Set catalog.images to the folder or the store that all benches of the catalog use."
        if mark is not None:
            raise CatalogError(f"{where} has the images of another catalog than {self.place}.", next_step=fix)
        with self.read() as connection:
            used = connection.scalar(select(func.count()).select_from(Enrollment)) or 0
        if used and self.images.is_empty():
            raise CatalogUnavailable(
                f"The images of the catalog {self.place} are not in {where}, which is empty.",
                next_step=f"Mount the network share if it is not mounted. Otherwise: {fix}",
            )
        if used:
            raise CatalogError(f"The images of the catalog {self.place} are not in {where}.", next_step=fix)
        if not self.read_only:
            self.images.set_mark(self.id)


def limit_idle(connection: Connection, seconds: int) -> None:
    """Let the server end this transaction when the program has asked for nothing for this time."""
    statement = "SELECT set_config('idle_in_transaction_session_timeout', :ms, true)"
    connection.execute(text(statement), {"ms": str(1000 * seconds)})


def _has_tables(connection: Connection) -> bool:
    return inspect(connection).has_table(Property.__tablename__)


def _engine(place: CatalogPlace, busy_timeout_s: float) -> Engine:
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
            json_serializer=json_text,
            json_deserializer=json_values,
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
