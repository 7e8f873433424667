"""The catalog of a served bench: its local copy, its journal, and their state for the pages."""

from collections.abc import Callable
from typing import Any

from rig.catalog import Catalog
from rig.catalog.copying import Attempts, open_or_copy
from rig.catalog.journal import BackgroundDelivery, JournalState
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock


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
