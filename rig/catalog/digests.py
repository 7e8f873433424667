"""Comparison of the digests of many rows, as the database stores them: without making objects of them."""

from collections.abc import Collection, Iterator, Mapping
from functools import lru_cache
from typing import Any, Final

from sqlalchemy import (
    JSON,
    Boolean,
    ColumnElement,
    DateTime,
    Float,
    Integer,
    Select,
    Text,
    bindparam,
    cast,
    func,
    select,
    type_coerce,
)
from sqlalchemy.orm import Session as Transaction
from sqlalchemy.orm import aliased
from sqlalchemy.types import NullType

from rig.catalog.columns import stored_type
from rig.catalog.facts import Enrollment, Entry, Row, Session, View, digested, sha256_of
from rig.catalog.jobs import portions

AT_ONCE: Final = 100
"""Enrollments whose rows are in memory at once."""


def damaged_lines(transaction: Transaction, end: int, digest: str) -> Iterator[int]:
    """Yield the numbers of lines of a log with this end that are missing or not as they were written."""
    last, before = 0, ""
    columns = select(Entry.id, Entry.digest, *_raw(_is_postgres(transaction), Entry)).order_by(Entry.id)
    for number, found, *row in transaction.execute(columns.execution_options(yield_per=500)):
        yield from range(last + 1, number)
        if found != sha256_of((before if number == last + 1 else "", *row)):
            yield number
        last, before = number, found
    yield from range(last + 1, end)
    if (last, before) != (end, digest):
        yield max(last, end)


def wrong_lines(transaction: Transaction, ids: Collection[int]) -> list[int]:
    """Return which of these lines of the log are not as they were written after the line before each."""
    wrong: list[int] = []
    for part in portions(sorted(ids), 500):
        rows = transaction.execute(_lines(_is_postgres(transaction)), {"ids": part})
        wrong += [number for number, digest, *row in rows if digest != sha256_of(tuple(row))]
    return wrong


@lru_cache(maxsize=2)  # each view that is enrolled asks it, and to build the statement takes longer than to execute it
def _lines(is_postgres: bool) -> Select[Any]:
    before = aliased(Entry)
    return (
        select(Entry.id, Entry.digest, func.coalesce(before.digest, ""), *_raw(is_postgres, Entry))
        .outerjoin(before, before.id == Entry.id - 1)
        .where(Entry.id.in_(bindparam("ids", expanding=True)))
    )


def damaged_enrollments(transaction: Transaction, seals: Mapping[int, str | None]) -> Iterator[int]:
    """Yield which of these enrollments, by their ids and seals, are not as they were written."""
    is_postgres = _is_postgres(transaction)
    for part in portions(sorted(seals), AT_ONCE):
        keys: dict[int, str] = dict(
            transaction.execute(select(Enrollment.id, Enrollment.key).where(Enrollment.id.in_(part))).all()
        )
        digests: dict[int, list[str]] = {number: [] for number in keys}
        wrong = set()
        # In the order of a seal: the enrollment, its sessions, its views.
        for table, owner, order in (
            (Enrollment, Enrollment.id, Enrollment.id),
            (Session, Session.enrollment_id, Session.number),
            (View, View.enrollment_id, View.index),
        ):
            columns = select(owner, table.digest, *_raw(is_postgres, table))
            for number, found, *row in transaction.execute(columns.where(owner.in_(part)).order_by(owner, order)):
                digests[number].append(found)
                if found != sha256_of((str(keys[number]), *row)):
                    wrong.add(number)
        wrong |= {number for number, own in digests.items() if seals[number] not in (None, sha256_of(tuple(own)))}
        yield from sorted(wrong)


def _is_postgres(transaction: Transaction) -> bool:
    return transaction.get_bind().dialect.name == "postgresql"


def _raw(is_postgres: bool, table: type[Row]) -> list[ColumnElement[Any]]:
    """Return the digested columns, with equal values for equal rows on both databases."""
    return [_as_stored(column, is_postgres).label(f"raw_{name}") for name, column in digested(table)]


def _as_stored(column: ColumnElement[Any], is_postgres: bool) -> ColumnElement[Any]:
    if is_postgres:
        match stored_type(column):
            case DateTime():
                return func.to_char(column, "YYYY-MM-DD HH24:MI:SS.US")
            case JSON():
                return cast(column, Text)
            case Boolean():
                return cast(column, Integer)
            case Float():
                return type_coerce(column, NullType()) + 0.0
    return type_coerce(column, NullType())
