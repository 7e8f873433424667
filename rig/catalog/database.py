"""The database of a catalog: SQLite in a file, or PostgreSQL for several benches.

Decision: docs/decisions/0011.
"""

import uuid
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from sqlalchemy import Connection, insert, select
from sqlalchemy.orm import Session as Transaction

from rig.catalog.columns import damaged
from rig.catalog.facts import SCHEMA_VERSION, Property, Row
from rig.catalog.images import Images
from rig.config.catalog_place import CatalogPlace
from rig.core.errors import CatalogError

APPLICATION = "hbr-rig catalog"


class Database(ABC):
    """The database of a catalog, and the store of its images."""

    place: CatalogPlace
    images: Images
    read_only: bool

    @property
    def root(self) -> Path:
        """Folder of the catalog on this computer."""
        return self.place.path

    @contextmanager
    def read(self) -> Iterator[Transaction]:
        """Yield a transaction that sees the catalog as it is at its first query."""
        with self.catalog_errors(), self._reading() as connection, _transaction(connection) as transaction:
            yield transaction

    @contextmanager
    def write(self) -> Iterator[Transaction]:
        """Yield a transaction that adds to the catalog. An exception rolls it back. No other one runs meanwhile."""
        if self.read_only:
            raise CatalogError(f"The catalog {self.place} is open for reading only.", next_step="Open it for writing.")
        with self.catalog_errors(), self._writing() as connection, _transaction(connection) as transaction:
            yield transaction
            transaction.flush()

    @abstractmethod
    def close(self) -> None:
        """Close all connections."""

    @abstractmethod
    def _reading(self) -> AbstractContextManager[Connection]: ...

    @abstractmethod
    def _writing(self) -> AbstractContextManager[Connection]: ...

    @abstractmethod
    def catalog_errors(self) -> AbstractContextManager[None]:
        """Raise errors of the database and of the store of images as errors of the catalog."""

    def damage(self, transaction: Transaction) -> list[str]:  # noqa: ARG002 - a server checks its own pages
        """Return what the database's own check of its structure finds."""
        return []


def _transaction(connection: Connection) -> Transaction:
    return Transaction(connection, expire_on_commit=False, autoflush=True)


def create_tables(connection: Connection) -> None:
    """Create the tables of a new catalog."""
    Row.metadata.create_all(connection)
    connection.execute(insert(Property), first_properties())


def first_properties() -> list[dict[str, str]]:
    """Return the properties of a new catalog."""
    first = {"application": APPLICATION, "version": str(SCHEMA_VERSION), "id": uuid.uuid4().hex, "head": "0  0 0 0"}
    return [{"key": key, "value": value} for key, value in first.items()]


def properties(connection: Connection | Transaction) -> dict[str, str]:
    """Return the properties of a catalog."""
    return dict(connection.execute(select(Property.key, Property.value)).all())


def check_properties(found: dict[str, str], place: CatalogPlace) -> None:
    """Check that a database is a catalog, of this version.

    Raises `CatalogError`: it belongs to another program, or to another version of this one. `CatalogDamaged`: no
    program has written such a version.
    """
    if found.get("application") != APPLICATION:
        raise CatalogError(f"{place} is the database of another program.", next_step="Give the place of a catalog.")
    try:
        version = int(found["version"])
    except (KeyError, ValueError) as error:
        raise damaged("the version of its tables", found.get("version")) from error
    if version < 1:
        raise damaged("the version of its tables", version)
    if version != SCHEMA_VERSION:
        raise CatalogError(
            f"The catalog {place} was written by another version of the program: its tables have version {version}, "
            f"this program knows {SCHEMA_VERSION}.",
            next_step="Use the version of hbr-rig that wrote it, or another catalog.",
            evidence={"found": version, "known": SCHEMA_VERSION},
        )
