"""The interface of a catalog's database, with two engines: `rig.catalog.sqlite_database` and `rig.catalog.postgres`.

Decision: docs/decisions/0050.
"""

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Table, insert, text

from rig.catalog.image_store import ImageStore
from rig.catalog.schema import RESULTS_VERSION, SCHEMA_VERSION
from rig.config.catalog_place import CatalogPlace
from rig.core.errors import CatalogError, CatalogOutdated


class Database(ABC):
    """The database of a catalog, and the store of its images.

    Attributes
    ----------
    place
        Where the catalog is.
    images
        The store of the images.
    version
        Version of the tables. A catalog of `READABLE_VERSION` or later can be read without a migration.
    """

    place: CatalogPlace
    images: ImageStore
    version: int

    @property
    def root(self) -> Path:
        """Folder of the catalog on this computer."""
        return self.place.path

    @property
    def has_results(self) -> bool:
        """Whether the catalog has tables for results."""
        return self.version >= RESULTS_VERSION

    @abstractmethod
    def close(self) -> None:
        """Close all connections."""

    @abstractmethod
    def read(self) -> AbstractContextManager[Connection]:
        """Yield a transaction that sees the catalog as it is at its first query."""

    @abstractmethod
    def write(self, enrollment_id: int | None = None) -> AbstractContextManager[Connection]:
        """Yield a transaction that changes the catalog. An exception rolls it back.

        Parameters
        ----------
        enrollment_id
            The only enrollment that it changes; None for any change. Changes of different enrollments may run at once,
            any other change runs alone.
        """

    @abstractmethod
    def catalog_errors(self) -> AbstractContextManager[None]:
        """Raise errors of the database and of the store of images as errors of the catalog."""

    @abstractmethod
    def damage(self, connection: Connection) -> list[str]:
        """Return what the database's own check of its structure finds."""

    @abstractmethod
    def orphans(self, connection: Connection) -> list[tuple[str, int | None, str]]:
        """Return table, row and missing table of each row that refers to a missing row."""

    @abstractmethod
    def last_ids(self, connection: Connection) -> dict[str, int]:
        """Return the last id that each table has given."""

    @abstractmethod
    def settings(self, connection: Connection) -> list[tuple[str, Any, Any]]:
        """Return name, value and right value of each wrong setting of the database."""

    @abstractmethod
    def size_bytes(self, connection: Connection) -> int:
        """Return the size of the database."""

    def may_have_changed(self) -> bool:
        """Return whether another query can find something new since the last call."""
        return True

    def read_only_error(self) -> CatalogError:
        """Return the error for a change of a catalog that is open for reading."""
        return CatalogError(f"The catalog {self.place} is open for reading only.", next_step="Open it for writing.")

    def outdated(self) -> CatalogOutdated:
        """Return the error for a catalog that must be migrated first."""
        return CatalogOutdated(
            f"The catalog {self.place} was written by an earlier program: its schema has version {self.version}, "
            f"this program works with {SCHEMA_VERSION}.",
            next_step="Migrate it (a backup is made): rig catalog migrate",
            evidence={"found": self.version, "known": SCHEMA_VERSION},
        )


def newer(place: CatalogPlace, version: int) -> CatalogError:
    """Return the error for a catalog of a version that this program does not know."""
    return CatalogError(
        f"The catalog {place} was written by a newer program: its schema has version {version}, "
        f"this program knows {SCHEMA_VERSION}.",
        next_step="Update hbr-rig on this computer.",
        evidence={"found": version, "known": SCHEMA_VERSION},
    )


def insert_row(connection: Connection, table: Table, **values: object) -> int:
    """Insert a row and return its id."""
    row_id: int = connection.execute(insert(table).values(values).returning(table.c.id)).scalar_one()
    return row_id


def given_id(connection: Connection, table: Table) -> dict[str, int]:
    """Return the id of the next row of an append-only table as its column; empty if the database gives it.

    The sequences of PostgreSQL leave gaps after a rollback, and a gap in these tables means that rows are missing.
    """
    if connection.dialect.name != "postgresql":
        return {}
    more = "CAST(CAST(value AS bigint) + 1 AS text)"
    statement = text(f"UPDATE catalog_properties SET value = {more} WHERE key = :name RETURNING value")
    return {"id": int(connection.execute(statement, {"name": table.name}).scalar_one())}
