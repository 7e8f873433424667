"""Comparison of the digests of many rows, as the database stores them: without making objects of them."""

from collections.abc import Iterator, Mapping
from itertools import groupby
from operator import itemgetter
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
from rig.catalog.facts import Enrollment, Row, Session, View, digested, sha256_of
from rig.catalog.jobs import portions

AT_ONCE: Final = 100
"""Enrollments whose rows are in memory at once."""


def damaged_enrollments(transaction: Transaction, seals: Mapping[int, str | None]) -> Iterator[int]:
    """Yield which of these enrollments, by their ids and seals, are not as they were written."""
    enrollments, views = Enrollment.__table__.c, View.__table__.c
    is_postgres = transaction.get_bind().dialect.name == "postgresql"
    for part in portions(sorted(seals), AT_ONCE):
        own = {
            row[0]: row[1:]
            for row in transaction.execute(
                select(Enrollment.id, Enrollment.digest, Enrollment.key, *_raw(is_postgres, Enrollment)).where(
                    enrollments.id.in_(part)
                )
            )
        }
        keys = {number: str(row[1]) for number, row in own.items()}
        digests = {number: [row[0]] for number, row in own.items()}
        wrong = {number for number, row in own.items() if row[0] != sha256_of((keys[number], *row[2:]))}
        for table, order in ((Session, Session.number), (View, views.view_index)):
            rows = transaction.execute(
                select(table.enrollment_id, table.digest, *_raw(is_postgres, table))
                .where(table.enrollment_id.in_(part))
                .order_by(table.enrollment_id, order)
            )
            for number, group in groupby(rows, itemgetter(0)):
                for row in group:
                    digests[number].append(row[1])
                    if row[1] != sha256_of((keys[number], *row[2:])):
                        wrong.add(number)
        wrong |= {number for number in own if seals[number] not in (None, sha256_of(tuple(digests[number])))}
        yield from sorted(wrong)


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
