"""The interface of a catalog's database, with two engines: `rig.catalog.sqlite_database` and `rig.catalog.postgres`.

Decision: docs/decisions/0050.
"""

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Table, insert, text

from rig.catalog.columns import damaged
from rig.catalog.image_store import ImageStore
from rig.catalog.schema import SCHEMA_VERSION
from rig.config.catalog_place import CatalogPlace
from rig.core.errors import CatalogError


class Database(ABC):
    """The database of a catalog, and the store of its images.

    Attributes
    ----------
    place
        Where the catalog is.
    images
        The store of the images.
    """

    place: CatalogPlace
    images: ImageStore

    @property
    def root(self) -> Path:
        """Folder of the catalog on this computer."""
        return self.place.path

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


def check_version(place: CatalogPlace, version: int) -> None:
    """Check the version of a catalog's tables.

    Raises
    ------
    CatalogError
        Another version of the program wrote the catalog.
    CatalogDamaged
        No program has written such a version.
    """
    if version < 1:
        raise damaged("the version of its schema", version)
    if version != SCHEMA_VERSION:
        raise CatalogError(
            f"The catalog {place} was written by another version of the program: its schema has version {version}, "
            f"this program knows {SCHEMA_VERSION}.",
            next_step="Use the version of hbr-rig that wrote it, or another catalog.",
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
