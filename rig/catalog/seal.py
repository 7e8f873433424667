"""Digests over the rows of a catalog. They show every later change that this program did not make.

An enrollment has a digest over its own row and all its sessions, views and descriptors, an object over its own row,
and a row of an append-only table (audit log, results, corrections) over its own values and the digest before it. A
change by the program seals a row again only if the digest was right before, so that damage is not hidden. Digests
detect accidents, but not an attacker, who can compute them, too.

Decision: docs/decisions/0034.
"""

import hashlib
import json
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from typing import Any, Final

from sqlalchemy import Connection, Table, text

from rig.catalog.columns import JsonText, Utc
from rig.catalog.schema import descriptors, enrollments, objects, sessions, views
from rig.core.errors import CatalogDamaged
from rig.core.next_steps import Do

_PARTS: Final = (
    (sessions, "sessions", "enrollment_id, id"),
    (views, "views", "enrollment_id, id"),
    (descriptors, "views JOIN descriptors ON view_id = views.id", "enrollment_id, view_id, name, version"),
)

_AT_ONCE: Final = 2_000
"""Rows that are in memory at once."""

FIRST: Final = ""
"""The digest before the first row of an append-only table."""


def _columns(table: Table, connection: Connection) -> str:
    """Return the columns of a digest, with equal values for equal rows on every engine."""
    named = [column for column in table.columns if column.name != "digest"]
    if connection.dialect.name != "postgresql":
        return ", ".join(f"{table.name}.{column.name}" for column in named)
    words = []
    for column in named:
        name = f'{table.name}."{column.name}"'
        if isinstance(column.type, Utc):  # as SQLAlchemy stores it in SQLite
            name = f"to_char({name}, 'YYYY-MM-DD HH24:MI:SS.US')"
        elif isinstance(column.type, JsonText):
            name = f"CAST({name} AS TEXT)"
        words.append(name)
    return ", ".join(words)


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
    rows = _rows(connection, objects, "digest", "objects", "id", "id", ids)
    return [(row[1], row[0], _digest(FIRST, row[1:])) for row in rows]


def enrollment_digests(connection: Connection, ids: Collection[int] | None = None) -> list[tuple[int, str | None, str]]:
    """Return id, stored digest and found digest of enrollments; None for all."""
    sealed, hashes = {}, {}
    for row in _rows(connection, enrollments, "digest", "enrollments", "id", "id", ids):
        sealed[row[1]] = row[0]
        hashes[row[1]] = hashlib.sha256(ascii(tuple(row[1:])).encode())
    for table, source, order in _PARTS:
        for row in _rows(connection, table, "enrollment_id", source, "enrollment_id", order, ids):
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
    shown = _names_of(connection, broken, spoiled)
    return CatalogDamaged(
        f"{', '.join(map(repr, shown[:3]))}{' and others' if len(shown) > 3 else ''} in the catalog changed after they "
        "were stored.",
        next_step=(Do.VERIFY_CATALOG(), "Then use a backup, or delete these objects and enroll them again."),
        evidence={"objects": shown[:20]},
    )


def _names_of(connection: Connection, object_ids: Collection[int], enrollment_ids: Collection[int]) -> list[str]:
    owners = f"SELECT object_id FROM enrollments WHERE id {_among(connection, 'enrollments')}"
    names = connection.execute(
        text(f"SELECT name FROM objects WHERE id {_among(connection, 'objects')} OR id IN ({owners}) ORDER BY id"),
        {"objects": _ids(connection, object_ids), "enrollments": _ids(connection, enrollment_ids)},
    )
    return [str(name) for name in dict.fromkeys(names.scalars())]


def appended_digests(
    connection: Connection, table: Table, *, after: int = 0, limit: int = 1 << 62
) -> list[tuple[int, str | None, str]]:
    """Return id, stored digest and expected digest of rows of an append-only table: all, or some ``after`` an id."""
    found = []
    before = _digest_before(connection, table, after + 1)
    for row in _appended(connection, table, after + 1, limit):
        found.append((row[1], row[0], _digest(before, row[1:])))
        before = row[0] or FIRST
    return found


def seal_appended(connection: Connection, table: Table) -> None:
    """Store the digests of the rows of an append-only table that have none, those at its end."""
    first = connection.execute(text(f"SELECT min(id) FROM {table.name} WHERE digest IS NULL")).scalar()
    if first is None:
        return
    before = _digest_before(connection, table, first)
    for row in _appended(connection, table, first, 1 << 62):
        before = _digest(before, row[1:])
        _seal(connection, table, row[1], before)


def _digest_before(connection: Connection, table: Table, row_id: int) -> str:
    newest = f"SELECT digest FROM {table.name} WHERE id < :id ORDER BY id DESC LIMIT 1"
    return str(connection.execute(text(newest), {"id": row_id}).scalar() or FIRST)


def _appended(connection: Connection, table: Table, first: int, limit: int) -> Sequence[Any]:
    columns = _columns(table, connection)
    statement = f"SELECT digest, {columns} FROM {table.name} WHERE id >= :first ORDER BY id LIMIT :limit"
    return connection.execute(text(statement), {"first": first, "limit": limit}).all()


def _digest(before: str, row: Iterable[Any]) -> str:
    return hashlib.sha256(f"{before}{tuple(row)!a}".encode()).hexdigest()


def _rows(
    connection: Connection, table: Table, first: str, source: str, key: str, order: str, ids: Collection[int] | None
) -> Iterable[Any]:
    """Return a first column and the columns of a table for digests, of the rows whose ``key`` is among the ids."""
    statement = f"SELECT {first}, {_columns(table, connection)} FROM {source}"
    if ids is None:  # in parts: the rows of a large catalog take gigabytes
        every = connection.execute(text(f"{statement} ORDER BY {order}"), execution_options={"yield_per": _AT_ONCE})
        return chain.from_iterable(every.partitions())
    wanted = f"{statement} WHERE {key} {_among(connection, 'ids')} ORDER BY {order}"
    return connection.execute(text(wanted), {"ids": _ids(connection, ids)}).all()


def _among(connection: Connection, parameter: str) -> str:
    if connection.dialect.name == "postgresql":
        return f"= ANY(CAST(:{parameter} AS BIGINT[]))"
    return f"IN (SELECT value FROM json_each(:{parameter}))"


def _ids(connection: Connection, ids: Collection[int]) -> object:
    return sorted(ids) if connection.dialect.name == "postgresql" else json.dumps(sorted(ids))


def _store(connection: Connection, table: Table, digests: Iterable[tuple[int, str | None, str]]) -> None:
    for row_id, sealed, found in digests:
        if sealed != found:
            _seal(connection, table, row_id, found)


def _seal(connection: Connection, table: Table, row_id: int, digest: str) -> None:
    statement = f"UPDATE {table.name} SET digest = :digest WHERE id = :id"
    connection.execute(text(statement), {"digest": digest, "id": row_id})
