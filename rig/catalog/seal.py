"""Digests over the rows of a catalog. They show every later change that this program did not make.

An enrollment has a digest over its own row and all its sessions, views and descriptors, an object over its own row,
and a row of an append-only table (audit log, results, corrections) over its own values and the digest before it. A
change by the program seals a row again only if the digest was right before: damage stays noticed. Digests show
accidents: an attacker can compute them, too.

Decision: docs/decisions/0034.
"""

import hashlib
import json
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Final

from sqlalchemy import Connection, Table

from rig.catalog.schema import descriptors, enrollments, objects, sessions, views
from rig.core.errors import CatalogDamaged

FIRST: Final = ""
"""The digest before the first row of an append-only table."""


def _columns(table: Table) -> str:
    return ", ".join(f"{table.name}.{column.name}" for column in table.columns if column.name != "digest")


_OBJECTS: Final = f"SELECT digest, {_columns(objects)} FROM objects WHERE {{}} ORDER BY id"
_ENROLLMENTS: Final = f"SELECT digest, {_columns(enrollments)} FROM enrollments WHERE {{}} ORDER BY id"
_PARTS: Final = (
    f"SELECT enrollment_id, {_columns(sessions)} FROM sessions WHERE {{}} ORDER BY enrollment_id, id",
    f"SELECT enrollment_id, {_columns(views)} FROM views WHERE {{}} ORDER BY enrollment_id, id",
    f"SELECT enrollment_id, {_columns(descriptors)} FROM views JOIN descriptors ON view_id = views.id WHERE {{}} "
    "ORDER BY enrollment_id, view_id, name, version",
)


@contextmanager
def changing_enrollments(connection: Connection, ids: Iterable[int]) -> Iterator[None]:
    """Seal enrollments after a change of their rows, except those that were damaged before."""
    intact = [one for one, sealed, found in enrollment_digests(connection, set(ids)) if sealed == found]
    yield
    seal_enrollments(connection, intact)


@contextmanager
def changing_object(connection: Connection, object_id: int) -> Iterator[None]:
    """Seal an object after a change of its row, unless it was damaged before."""
    intact = [one for one, sealed, found in object_digests(connection, [object_id]) if sealed == found]
    yield
    seal_objects(connection, intact)


def seal_enrollments(connection: Connection, ids: Collection[int] | None) -> None:
    """Store the digests of enrollments; None for all."""
    _store(connection, enrollments, enrollment_digests(connection, ids))


def seal_objects(connection: Connection, ids: Collection[int] | None) -> None:
    """Store the digests of objects; None for all."""
    _store(connection, objects, object_digests(connection, ids))


def object_digests(connection: Connection, ids: Collection[int] | None = None) -> list[tuple[int, str | None, str]]:
    """Return id, stored digest and found digest of objects; None for all."""
    rows = connection.exec_driver_sql(*_only(_OBJECTS, "id", ids)).all()
    return [(row[1], row[0], _digest(FIRST, row[1:])) for row in rows]


def enrollment_digests(connection: Connection, ids: Collection[int] | None = None) -> list[tuple[int, str | None, str]]:
    """Return id, stored digest and found digest of enrollments; None for all."""
    sealed, hashes = {}, {}
    for row in connection.exec_driver_sql(*_only(_ENROLLMENTS, "id", ids)):
        sealed[row[1]] = row[0]
        hashes[row[1]] = hashlib.sha256(ascii(tuple(row[1:])).encode())
    for part in _PARTS:
        for row in connection.exec_driver_sql(*_only(part, "enrollment_id", ids)):
            if row[0] in hashes:  # an orphan otherwise
                hashes[row[0]].update(ascii(tuple(row)).encode())
    return [(enrollment_id, sealed[enrollment_id], found.hexdigest()) for enrollment_id, found in hashes.items()]


def check_loaded(connection: Connection, object_ids: Collection[int], enrollment_ids: Collection[int]) -> None:
    """Raise `CatalogDamaged` if one of these objects or enrollments is not as it was stored."""
    if (damage := damage_of(connection, object_ids, enrollment_ids)) is not None:
        raise damage


def damage_of(
    connection: Connection, object_ids: Collection[int] | None, enrollment_ids: Collection[int] | None
) -> CatalogDamaged | None:
    """Return the error that some of these objects or enrollments are not as they were stored; None for all."""
    broken = {one for one, sealed, found in object_digests(connection, object_ids) if sealed != found}
    spoiled = {one for one, sealed, found in enrollment_digests(connection, enrollment_ids) if sealed != found}
    if not broken | spoiled:
        return None
    names = connection.exec_driver_sql(
        "SELECT DISTINCT name FROM objects WHERE id IN (SELECT value FROM json_each(?)) "
        "OR id IN (SELECT object_id FROM enrollments WHERE id IN (SELECT value FROM json_each(?))) ORDER BY id",
        (json.dumps(sorted(broken)), json.dumps(sorted(spoiled))),
    )
    shown = [str(name) for name in names.scalars()]
    return CatalogDamaged(
        f"{', '.join(map(repr, shown[:3]))}{' and others' if len(shown) > 3 else ''} in the catalog changed after they "
        "were stored",
        next_step="check the catalog (rig catalog verify); use a backup, or delete these objects and enroll them again",
        evidence={"objects": shown[:20]},
    )


def appended_digests(
    connection: Connection, table: Table, *, after: int = 0, limit: int = -1
) -> list[tuple[int, str | None, str]]:
    """Return id, stored digest and expected digest of rows of an append-only table: all, or some ``after`` an id."""
    found = []
    before = _digest_before(connection, table, after + 1)
    for row in connection.exec_driver_sql(f"{_appended(table, 'id > ?')} LIMIT ?", (after, limit)):
        found.append((row[1], row[0], _digest(before, row[1:])))
        before = row[0] or FIRST
    return found


def seal_appended(connection: Connection, table: Table) -> None:
    """Store the digests of the rows of an append-only table that have none, those at its end."""
    first = connection.exec_driver_sql(f"SELECT min(id) FROM {table.name} WHERE digest IS NULL").scalar()
    before = FIRST if first is None else _digest_before(connection, table, first)
    for row in connection.exec_driver_sql(_appended(table, "id >= ?"), (first,)).all():
        before = _digest(before, row[1:])
        connection.exec_driver_sql(f"UPDATE {table.name} SET digest = ? WHERE id = ?", (before, row[1]))


def _digest_before(connection: Connection, table: Table, row_id: int) -> str:
    newest = f"SELECT digest FROM {table.name} WHERE id < ? ORDER BY id DESC LIMIT 1"
    return str(connection.exec_driver_sql(newest, (row_id,)).scalar() or FIRST)


def _appended(table: Table, where: str) -> str:
    return f"SELECT digest, {_columns(table)} FROM {table.name} WHERE {where} ORDER BY id"


def _digest(before: str, row: Iterable[Any]) -> str:
    return hashlib.sha256(f"{before}{tuple(row)!a}".encode()).hexdigest()


def _only(statement: str, column: str, ids: Collection[int] | None) -> tuple[str, tuple[str, ...]]:
    if ids is None:
        return statement.format("TRUE"), ()
    return statement.format(f"{column} IN (SELECT value FROM json_each(?))"), (json.dumps(sorted(ids)),)


def _store(connection: Connection, table: Table, digests: Iterable[tuple[int, str | None, str]]) -> None:
    for row_id, sealed, found in digests:
        if sealed != found:
            connection.exec_driver_sql(f"UPDATE {table.name} SET digest = ? WHERE id = ?", (found, row_id))
