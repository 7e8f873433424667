"""Comparison of the digests of a whole catalog in the background of longer work.

Searches and exports compare the digests of what they load. Deleted objects, unfinished and earlier enrollments, the
log and the results are compared here. The images are compared by `rig catalog verify` only.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Final

from sqlalchemy import Connection, Table, select

from rig.catalog.catalog import Catalog
from rig.catalog.columns import FIX
from rig.catalog.schema import APPEND_ONLY, enrollments, objects
from rig.catalog.seal import appended_digests, damage_of
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock, seconds_between
from rig.core.errors import CatalogDamaged, RigError

SHARE: Final = 0.05
"""Largest share of a processor core, after the first `BURST_S` of work: small catalogs are compared at once."""
BURST_S: Final = 0.1
_ROWS: Final = 100
"""Rows of a portion, so that the other threads of the program wait for milliseconds at most."""


class BackgroundCheck(AbstractContextManager["BackgroundCheck"]):
    """A thread that compares the digests of the catalog at ``place`` until all are compared or a ``with`` block ends.

    It has its own connection, for reading only. A portion is one transaction, so that a change of the catalog in the
    meantime is no damage. ``report`` gets the first damage; it is called in the thread.
    """

    def __init__(self, place: CatalogPlace | Path, clock: Clock, report: Callable[[RigError], None]) -> None:
        self._place = place
        self._clock = clock
        self._report = report
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="catalog check", daemon=True)
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def wait(self, timeout_s: float | None = None) -> None:
        """Wait until all digests are compared, or damage is reported."""
        self._thread.join(timeout_s)

    def _run(self) -> None:
        start_ns = begun_ns = self._clock.now_ns()
        spent_s = 0.0
        try:
            with Catalog.open(self._place, clock=self._clock, create=False, read_only=True) as catalog:
                for damage in _portions(catalog):
                    if damage is not None:
                        self._report(damage)
                        return
                    now_ns = self._clock.now_ns()
                    spent_s += seconds_between(begun_ns, now_ns)
                    if self._ended.wait((spent_s - BURST_S) / SHARE - seconds_between(start_ns, now_ns)):
                        return
                    begun_ns = self._clock.now_ns()
        except CatalogDamaged as damage:
            self._report(damage)
        except RigError:
            pass  # the catalog was moved or is locked: the work itself reports it


def _portions(catalog: Catalog) -> Iterator[CatalogDamaged | None]:
    """Compare the digests in portions; yield the damage of each."""
    database = catalog.database
    with database.read() as connection:
        object_ids = connection.scalars(select(objects.c.id)).all()
        enrollment_ids = connection.scalars(select(enrollments.c.id)).all()
    for start in range(0, len(object_ids), _ROWS):
        with database.read() as connection:
            damage = damage_of(connection, object_ids[start : start + _ROWS], ())
        yield damage
    for enrollment_id in enrollment_ids:
        with database.read() as connection:
            damage = damage_of(connection, (), [enrollment_id])
        yield damage
    for table in APPEND_ONLY:
        after: int | None = 0
        while after is not None:
            with database.read() as connection:
                damage, after = _appended(connection, table, after)
            yield damage


def _appended(connection: Connection, table: Table, after: int) -> tuple[CatalogDamaged | None, int | None]:
    """Compare rows of an append-only table; return the damage and the last id, None at the end of the table."""
    rows = appended_digests(connection, table, after=after, limit=_ROWS)
    for expected_id, (row_id, sealed, found) in enumerate(rows, after + 1):
        if sealed != found or row_id != expected_id:
            what = f"row {row_id} of {table.name} in the catalog is not the one that was written, or rows are missing"
            return CatalogDamaged(what, next_step=FIX, evidence={"table": table.name, "row": row_id}), None
    return None, rows[-1][0] if rows else None
