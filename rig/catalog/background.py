"""Comparison of the digests of a whole catalog in the background of longer work.

Searches and exports compare the digests of what they load. Deleted objects, unfinished and earlier enrollments, the
log and the results are compared here. The images are compared by `rig catalog verify` only.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Final

from sqlalchemy import select
from sqlalchemy.orm import Session as Transaction

from rig.catalog import digests, log, state
from rig.catalog.catalog import Catalog
from rig.catalog.facts import Enrollment, Entry
from rig.catalog.state import Ended
from rig.catalog.verify import missing_enrollments
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock, seconds_between
from rig.core.errors import CatalogDamaged, RigError
from rig.core.next_steps import Do

SHARE: Final = 0.05
"""Largest share of a processor core, after the first `BURST_S` of work: small catalogs are compared at once."""
BURST_S: Final = 0.1
_LINES: Final = 100
"""Lines of the log in a portion, so that the other threads of the program wait for milliseconds at most."""


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
                for check in _portions(catalog):
                    with catalog.database.read() as transaction:
                        check(transaction)
                    now_ns = self._clock.now_ns()
                    spent_s += seconds_between(begun_ns, now_ns)
                    if self._ended.wait((spent_s - BURST_S) / SHARE - seconds_between(start_ns, now_ns)):
                        return
                    begun_ns = self._clock.now_ns()
        except CatalogDamaged as damage:
            self._report(damage)
        except RigError:
            pass  # the catalog was moved or is locked: the work itself reports it


def _portions(catalog: Catalog) -> Iterator[Callable[[Transaction], None]]:
    """Yield the checks of portions of the rows, which raise `CatalogDamaged`."""
    with catalog.database.read() as transaction:
        last, _ = log.head(transaction)
        ids = transaction.scalars(select(Enrollment.id).order_by(Enrollment.id)).all()
    for first in range(1, last + 1, _LINES):
        yield partial(_check_lines, first, min(first + _LINES - 1, last))
    yield partial(_check_lines, last + 1, None)  # the lines since then, and the end of the log
    yield log.check_complete
    yield _check_missing
    yield from (partial(_check_enrollment, number) for number in ids)


def _check_lines(first: int, last: int | None, transaction: Transaction) -> None:
    wrong = next(log.wrong_lines(transaction, first, last), None)
    if wrong is None:
        return
    line = transaction.execute(select(Entry.object_name).where(Entry.id == wrong, Entry.deleted.is_not(None))).scalar()
    if line is not None:
        raise state.changed([line])
    raise CatalogDamaged(
        f"Entry {wrong} of the log of the catalog is not the one that was written, or entries are missing.",
        next_step=(Do.VERIFY_CATALOG(), "Then use a backup."),
        evidence={"log_entry": wrong},
    )


def _check_enrollment(number: int, transaction: Transaction) -> None:
    found = transaction.execute(
        select(Ended.seal, Ended.object_id).where(state.IS_STATUS, Ended.enrollment_id == number)
    ).first()
    if found is not None and any(digests.damaged_enrollments(transaction, {number: found[0]})):
        raise state.changed([str(state.by_id(transaction, found[1]).object_name)])


def _check_missing(transaction: Transaction) -> None:
    if missing := missing_enrollments(transaction):
        raise state.changed([str(one.object_name) for one in missing])
