"""The catalog of a served bench: its local copy, its journal, and their state for the pages."""

from collections.abc import Callable
from typing import Any

from rig.catalog import Catalog
from rig.catalog.local_copy import Attempts, open_or_copy
from rig.catalog.shared import (
    BackgroundDelivery,
    JournalState,
    deliver_journal,
    delivery_words,
    failure_words,
    open_for_enrollment,
)
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock
from rig.core.errors import CatalogBusy, CatalogError


class BenchCatalog:
    """The catalog of a bench: opens it for requests and jobs, even while its server does not answer.

    Parameters
    ----------
    place
        Place of the catalog.
    clock
        The computer's clock.
    changed
        Called with `state` after each change.
    report
        Gets a sentence about each object that was delivered in the background, and about each reason why one was not.
    """

    def __init__(
        self,
        place: CatalogPlace,
        clock: Clock,
        changed: Callable[[dict[str, Any]], None],
        report: Callable[[str], None],
    ) -> None:
        self.place = place
        self.state: dict[str, Any] = {"local_copy_utc": None, "waiting": 0, "reasons": []}
        self._clock = clock
        self._changed = changed
        self._report = report
        self._attempts = Attempts(clock)

    def open_to_read(self) -> Catalog:
        """Open the catalog, or its local copy; a catalog that does not exist yet is created."""
        create = not self.place.may_exist()
        catalog = open_or_copy(self.place, self._clock, create=create, attempts=self._attempts)
        copied = catalog.copied_utc
        self.become({"local_copy_utc": None if copied is None else f"{copied:%Y-%m-%d %H:%M:%S} UTC"})
        return catalog

    def open_to_change(self) -> Catalog:
        """Open the catalog to change its objects; a `CatalogUnavailable` if its server does not answer."""
        return Catalog.open(self.place, clock=self._clock)

    def open_to_enroll(self, clock: Clock) -> Catalog:
        """Open the catalog, or the journal, for new views; ``clock`` dates them."""
        return open_for_enrollment(self.place, clock)

    def deliver(self) -> list[str]:
        """Deliver the journal now; return sentences about delivered objects, and reasons for the others."""
        if self.place.url is None:
            return []
        try:
            return [delivery_words(one, self.place) for one in deliver_journal(self.place, self._clock)]
        except (CatalogError, CatalogBusy) as error:
            return [failure_words(error)]

    def background_delivery(self) -> BackgroundDelivery:
        """Return a delivery of the journal during the work of a ``with`` block."""
        return BackgroundDelivery(self.place, self._clock, self._report, changed=self._show)

    def _show(self, state: JournalState) -> None:
        self.become({"waiting": state.waiting, "reasons": list(state.reasons)})

    def become(self, values: dict[str, Any]) -> None:
        """Take changes of the state, and report them."""
        state = {**self.state, **values}
        if state != self.state:
            self.state = state
            self._changed(state)
