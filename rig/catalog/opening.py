"""Open the database of a catalog with the engine that its place names."""

from rig.catalog.database import Database
from rig.config.catalog_place import CatalogPlace


def open_database(place: CatalogPlace, *, create: bool, read_only: bool, busy_timeout_s: float) -> Database:
    """Return the database; parameters and errors as for the classes."""
    if place.url is None:
        from rig.catalog.sqlite_database import SqliteDatabase

        return SqliteDatabase(place, create=create, read_only=read_only, busy_timeout_s=busy_timeout_s)
    from rig.catalog.postgres import PostgresDatabase

    return PostgresDatabase(place, create=create, read_only=read_only, busy_timeout_s=busy_timeout_s)
