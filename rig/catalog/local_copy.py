"""The local copy of a catalog on a server: a folder of this computer with the data that searches need.

It is an SQLite catalog: the rows of the objects in use with their ids and digests, and the newest empty-table image.
A search reads it when the server does not answer, and says how old it is.

Decision: docs/decisions/0051.
"""

import json
import shutil
from contextlib import suppress
from datetime import datetime
from typing import Any, Final

from sqlalchemy import Connection, Table, delete, select

from rig.catalog.catalog import Catalog
from rig.catalog.queries import retrieved
from rig.catalog.rows import copied_columns, insert_copies
from rig.catalog.schema import descriptors, enrollments, objects, sessions, views
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock
from rig.core.errors import CatalogUnavailable
from rig.core.files import json_values, read, write

STATE: Final = "state.json"
RULES: Final = "search_rules.json"
_AT_ONCE: Final = 100
"""Enrollments that are read from the server at once."""
_PATIENCE: Final = 20


def update_copy(catalog: Catalog) -> bool:
    """Bring the local copy up to date; return whether anything had changed. Only changed objects are read."""
    folder = catalog.place.copy_folder
    with Catalog.open(folder, clock=catalog.clock) as copy:
        with catalog.database.read() as reading, copy.database.write() as writing:
            now, before = _used(reading), _used(writing)
            gone, new = before - now, now - before
            _remove(writing, {one[2] for one in gone}, {one[0] for one in gone})
            added = sorted(one[2] for one in new)
            _copy(reading, writing, objects, objects.c.id, sorted({one[0] for one in new}))
            for start in range(0, len(added), _AT_ONCE):
                part = added[start : start + _AT_ONCE]
                for table in (enrollments, sessions, views):
                    key = table.c.id if table is enrollments else table.c.enrollment_id
                    _copy(reading, writing, table, key, part)
                own = select(views.c.id).where(views.c.enrollment_id.in_(part))
                _copy(reading, writing, descriptors, descriptors.c.view_id, list(reading.scalars(own)))
            newest = _newest_empty_table(reading)
        if newest is not None and not copy.database.images.size(newest):
            copy.database.images.write(newest, catalog.database.images.read(newest))
    with suppress(FileNotFoundError):
        shutil.copyfile(catalog.path / RULES, folder / RULES)
    state = {"catalog": str(catalog.place), "copied_utc": catalog.clock.utc().isoformat()}
    write(folder / STATE, json.dumps(state).encode(), mode=0o600)
    return bool(gone or new)


def open_copy(place: CatalogPlace, clock: Clock) -> Catalog:
    """Return the local copy, open for reading; `Catalog.copied_utc` says when it was made.

    Raises
    ------
    CatalogUnavailable
        There is no copy of this catalog.
    """
    folder = place.copy_folder
    try:
        state = json_values(read(folder / STATE, max_bytes=10_000))
        if state["catalog"] != str(place):
            raise ValueError("a copy of another catalog")
        copied_utc = datetime.fromisoformat(state["copied_utc"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CatalogUnavailable(
            f"This computer has no copy of the catalog {place}.",
            next_step="Search once while the server answers: the search makes the copy.",
        ) from error
    copy = Catalog.open(folder, clock=clock, create=False, read_only=True)
    copy.copied_utc, copy.copy_of = copied_utc, place
    return copy


class Attempts:
    """Attempts to open catalogs, with pauses, so that the operator does not wait repeatedly for a server that is down.

    An attempt that failed after a time t is repeated after 20 t: a host that rejects a connection takes milliseconds,
    a network that drops packets takes seconds. Until then the same error is raised at once.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._not_before_ns = clock.now_ns()
        self._error: CatalogUnavailable | None = None

    def open(self, place: CatalogPlace, *, create: bool = False) -> Catalog:
        """Open a catalog, for reading only unless it is created if there is none; errors as `Catalog.open`."""
        begun_ns = self._clock.now_ns()
        if self._error is not None and begun_ns < self._not_before_ns:
            raise self._error.with_traceback(None)  # a traceback grows each time that an error is raised
        try:
            return Catalog.open(place, clock=self._clock, create=create, read_only=not create)
        except CatalogUnavailable as error:
            now_ns = self._clock.now_ns()
            self._error, self._not_before_ns = error, now_ns + _PATIENCE * (now_ns - begun_ns)
            raise


def open_or_copy(
    place: CatalogPlace, clock: Clock, *, create: bool = False, attempts: Attempts | None = None
) -> Catalog:
    """Return a catalog, open for reading; its local copy while its server or its store does not answer.

    With ``create`` the catalog is created if there is none, and is open for writing. ``attempts`` are those of a
    program that opens the catalog often.

    Raises
    ------
    CatalogUnavailable
        There is no copy either.
    """
    try:
        return (attempts or Attempts(clock)).open(place, create=create)
    except CatalogUnavailable as error:
        try:
            return open_copy(place, clock)
        except CatalogUnavailable as missing:
            raise CatalogUnavailable(
                f"{error.what} {missing.what}",
                next_step=(*error.steps, *missing.steps),
                evidence=error.evidence,
            ) from error


def _used(connection: Connection) -> set[tuple[Any, ...]]:
    rows = connection.execute(
        select(objects.c.id, objects.c.digest, enrollments.c.id, enrollments.c.digest)
        .join(enrollments)
        .where(retrieved())
    )
    return {tuple(row) for row in rows}


def _remove(connection: Connection, enrollment_ids: set[int], object_ids: set[int]) -> None:
    own = select(views.c.id).where(views.c.enrollment_id.in_(enrollment_ids))
    connection.execute(delete(descriptors).where(descriptors.c.view_id.in_(own)))
    for table in (views, sessions):
        connection.execute(delete(table).where(table.c.enrollment_id.in_(enrollment_ids)))
    connection.execute(delete(enrollments).where(enrollments.c.id.in_(enrollment_ids)))
    connection.execute(delete(objects).where(objects.c.id.in_(object_ids)))


def _copy(reading: Connection, writing: Connection, table: Table, key: Any, ids: list[int]) -> None:
    for start in range(0, len(ids), 500):
        wanted = select(*copied_columns(reading, table)).where(key.in_(ids[start : start + 500]))
        insert_copies(writing, table, reading.execute(wanted))


def _newest_empty_table(connection: Connection) -> str | None:
    found: str | None = connection.scalar(
        select(sessions.c.empty_table_image)
        .join(enrollments, sessions.c.enrollment_id == enrollments.c.id)
        .join(objects)
        .where(retrieved(), sessions.c.empty_table_image.is_not(None))
        .order_by(sessions.c.started_utc.desc())
        .limit(1)
    )
    return found
