"""Comparison of the digests of a whole catalog in the background of longer work.

Searches and exports compare the digests of what they load. Deleted objects, unfinished and earlier enrollments, the
log and the results are compared here. The images are compared by `rig catalog verify` only.
"""

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Final

from rig.catalog import state
from rig.catalog.catalog import Catalog
from rig.catalog.verify import Finding, Problem, row_checks
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock, seconds_between
from rig.core.errors import CatalogDamaged, RigError
from rig.core.next_steps import Do

SHARE: Final = 0.05
"""Largest share of a processor core, after the first `BURST_S` of work: small catalogs are compared at once."""
BURST_S: Final = 0.1


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
                with catalog.database.read() as transaction:
                    checks = list(row_checks(transaction))
                for check in checks:
                    with catalog.database.read() as transaction:
                        for finding in check(transaction):
                            raise _error(finding)
                    now_ns = self._clock.now_ns()
                    spent_s += seconds_between(begun_ns, now_ns)
                    if self._ended.wait((spent_s - BURST_S) / SHARE - seconds_between(start_ns, now_ns)):
                        return
                    begun_ns = self._clock.now_ns()
        except CatalogDamaged as damage:
            self._report(damage)
        except RigError:
            pass  # the catalog was moved or is locked: the work itself reports it


def _error(finding: Finding) -> CatalogDamaged:
    if finding.problem is not Problem.LOG_CHANGED:
        return state.changed([str(finding.object_name)])
    line = finding.details["entry_id"]
    return CatalogDamaged(
        f"Entry {line} of the log of the catalog is not the one that was written, or entries are missing.",
        next_step=(Do.VERIFY_CATALOG(), "Then use a backup."),
        evidence={"log_entry": line},
    )
