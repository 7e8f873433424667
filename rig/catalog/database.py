"""The database of a catalog: SQLite in a file, or PostgreSQL for several benches.

Decision: docs/decisions/0011.
"""

import uuid
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from sqlalchemy import Connection, Engine, select
from sqlalchemy.orm import Session as Transaction

from rig.catalog.columns import damaged
from rig.catalog.facts import SCHEMA_VERSION, Property
from rig.catalog.failures import catalog_errors
from rig.catalog.images import open_images
from rig.config.catalog_place import CatalogPlace
from rig.core.errors import CatalogError

APPLICATION = "hbr-rig catalog"


class Database(ABC):
    """The database of a catalog, and the store of its images. Parameters and errors are those of `Catalog.open`."""

    def __init__(self, place: CatalogPlace, *, create: bool, read_only: bool, busy_timeout_s: float) -> None:
        self.place = place
        self.images = open_images(place)
        self.read_only = read_only
        self._busy_timeout_s = busy_timeout_s
        self._reads, self._writes = self._engines()
        try:
            with self.catalog_errors():
                self._open(create=create and not read_only)
        except BaseException:
            self.close()
            raise

    @property
    def root(self) -> Path:
        """Folder of the catalog on this computer."""
        return self.place.path

    @contextmanager
    def read(self) -> Iterator[Transaction]:
        """Yield a transaction that sees the catalog as it is at its first query."""
        with self.catalog_errors(), self._reads.begin() as connection:
            self._begin(connection)
            with _transaction(connection) as transaction:
                yield transaction

    @contextmanager
    def write(self) -> Iterator[Transaction]:
        """Yield a transaction that adds to the catalog. An exception rolls it back. No other one runs meanwhile."""
        if self.read_only:
            raise CatalogError(f"The catalog {self.place} is open for reading only.", next_step="Open it for writing.")
        with self.catalog_errors(), self._writes.begin() as connection:
            self._begin(connection)
            with _transaction(connection) as transaction:
                yield transaction
                transaction.flush()

    def close(self) -> None:
        """Close all connections."""
        self._reads.dispose()

    def catalog_errors(self) -> AbstractContextManager[None]:
        """Raise errors of the database and of the store of images as errors of the catalog."""
        return catalog_errors(self.place, self._busy_timeout_s)

    @abstractmethod
    def _engines(self) -> tuple[Engine, Engine]:
        """Return the engines of transactions that read and that write, with one pool of connections."""

    @abstractmethod
    def _open(self, *, create: bool) -> None:
        """Check the database; ``create`` it if there is none."""

    @abstractmethod
    def _begin(self, connection: Connection) -> None:
        """Begin a transaction, as the option ``begin`` of its engine says: one that writes waits for the others."""

    def damage(self, transaction: Transaction) -> list[str]:  # noqa: ARG002 - a server checks its own pages
        """Return what the database's own check of its structure finds."""
        return []


def _transaction(connection: Connection) -> Transaction:
    return Transaction(connection, expire_on_commit=False, autoflush=True)


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
