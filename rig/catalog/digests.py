"""Comparison of the digests of many rows, as the database stores them: without making objects of them."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

from sqlalchemy import (
    JSON,
    Boolean,
    ColumnElement,
    DateTime,
    Float,
    Integer,
    Text,
    cast,
    func,
    select,
    type_coerce,
)
from sqlalchemy.orm import Session as Transaction
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
