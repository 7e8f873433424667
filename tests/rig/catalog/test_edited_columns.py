"""Every column of a catalog's facts is edited: no command shows a changed fact, or `rig catalog verify` finds it."""

import random
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from rig.catalog.facts import Derived, Enrollment, Entry, Row, Session, View, digested
from rig.catalog.verify import verify
from rig.core.errors import RigError
from tests.rig.catalog.catalog_samples import finished
from tests.rig.catalog.test_hostile_catalogs import SHOWN, edited, opened, reported, sample, shown

pytestmark = pytest.mark.sqlite
__all__ = ["sample", "shown"]

FACTS = [
    (table.name, column.name)
    for table in Row.metadata.sorted_tables
    if table.name != Derived.__tablename__
    for column in table.columns
]


def edit(root: Path, table: str, column: str, found: random.Random) -> str:
    """Change a column in one row, and return the statement; the new value has the kind of the old one, or is NULL."""
    with closing(sqlite3.connect(root / "catalog.sqlite")) as connection:
        rows = connection.execute(f'SELECT rowid, "{column}" FROM {table}').fetchall()
    row, value = found.choice(rows)
    others = [old for _, old in rows if old != value]
    kind = found.choice(["changed", "changed", "another row's", "null"])
    if kind == "another row's" and others:
        new = found.choice(others)
    elif kind == "null" and value is not None:
        new = None
    elif isinstance(value, str):
        at = found.randrange(len(value) + 1)
        new = value[:at] + found.choice("0a7 ") + value[at:]
    elif isinstance(value, bytes):
        new = value + b"\0"
    else:
        new = (value or 0) + found.choice([1, -1, 7])
    return f'UPDATE {table} SET "{column}" = {literal(new)} WHERE rowid = {row}'


def literal(value: object) -> str:
    if value is None:
        return "NULL"
    if isinstance(value, bytes):
        return f"x'{value.hex()}'"
    return "'" + value.replace("'", "''") + "'" if isinstance(value, str) else repr(value)


def test_a_digest_covers_every_column_that_means_the_same_in_all_catalogs() -> None:
    covered = {table: {column.name for _, column in digested(table)} for table in (Enrollment, Session, View, Entry)}
    left_out = {table.__tablename__: {*table.__table__.columns.keys()} - names for table, names in covered.items()}
    assert left_out == {
        "enrollments": {"id", "object_id", "digest"},
        "sessions": {"enrollment_id", "digest"},
        "views": {"id", "enrollment_id", "digest"},
        "log": {"digest"},
    }


@pytest.mark.parametrize("count", [12, pytest.param(200, marks=[pytest.mark.nightly, pytest.mark.timeout(1200)])])
def test_no_edited_column_is_accepted(sample: Path, shown: dict[str, Any], tmp_path: Path, count: int) -> None:
    expected = reported(Path(shutil.copytree(sample, tmp_path / "intact")))
    missed = []
    for seed in range(count):
        table, column = FACTS[seed * 7 % len(FACTS)]
        root = Path(shutil.copytree(sample, tmp_path / str(seed)))
        statement = edit(root, table, column, random.Random(seed))
        try:
            edited(root, statement)
        except sqlite3.IntegrityError:
            continue  # a unique key: the database itself rejects it
        for reader, show in SHOWN.items():
            try:
                with opened(root) as catalog:
                    if show(catalog) != shown[reader]:
                        missed.append(f"{reader} accepts {statement}")
            except RigError:
                pass
        try:
            with opened(root) as catalog:
                is_found = bool(finished(verify(catalog, jobs=1)).findings)
            if not is_found and reported(root) != expected:
                missed.append(f"verify does not find {statement}")
        except RigError:
            pass
        shutil.rmtree(root)
    assert missed == []
