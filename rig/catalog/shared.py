"""A catalog on a server, as a bench uses it: with the journal and the local copy of this computer.

Commands and the web server open their catalogs here, so that each of them works without the server.

Decision: docs/decisions/0051.
"""

import threading
from collections.abc import Callable, Collection
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Final

import numpy as np

import hbr
from rig.catalog.catalog import Catalog
from rig.catalog.delivery import Delivery, deliver
from rig.catalog.jobs import JobProgress
from rig.catalog.journal import Journal, waiting
from rig.catalog.local_copy import open_or_copy
from rig.catalog.prepared import searched_views
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock
from rig.core.errors import RigError

CHECK_S: Final = 2.0
"""Time between two checks of the journal."""
RETRY_S: Final = 15.0
"""Time until the next attempt, if the server did not answer or a person has to decide about a name."""
END_S: Final = 5.0
"""How long the end of a program waits for a delivery; the next program continues it."""


def open_for_enrollment(place: CatalogPlace, clock: Clock) -> Catalog:
    """Open the catalog for new views: the journal of this computer if the catalog is on a server."""
    return Catalog.open(place, clock=clock) if place.url is None else Journal.of(place, clock)


def deliver_journal(place: CatalogPlace, clock: Clock, *, replacing: Collection[str] = ()) -> list[Delivery]:
    """Deliver the journal to the server of the catalog.

    Raises
    ------
    CatalogUnavailable
        The server does not answer; the journal keeps everything.
    CatalogError, CatalogBusy
        The server or the journal cannot be used, or another program delivers the journal.
    """
    with Journal.of(place, clock) as journal, Catalog.open(place, clock=clock) as server:
        return deliver(journal, server, replacing=replacing)


def delivery_words(one: Delivery, place: CatalogPlace) -> str:
    """Return the outcome for an object of the journal, as a sentence."""
    if one.conflict is not None:
        return f"{one.conflict.what} Next step: {one.conflict.next_step}"
    return f"Delivered {one.name} with {one.views} views to {place}."


def failure_words(error: RigError) -> str:
    """Return the reason why nothing could be delivered, as sentences."""
    kept = "What is in the journal of this computer is delivered later"
    return f"{error.what} {kept}. Next step: {error.next_step}"


def journal_words(catalog: Catalog) -> str:
    """Return a sentence if the views of the enrollment must wait for the server; empty if the server has its name."""
    if not isinstance(catalog, Journal) or catalog.unreachable is None:
        return ""
    error = catalog.unreachable
    return f"{error.what} The views go into the journal of this computer. Next step: {error.next_step}"


def comparable_views(
    catalog: Catalog, name: str, *, progress: Callable[[JobProgress], None] | None = None
) -> hbr.Views:
    """Return the views that a new object is compared with, and its own.

    For an object of a journal, the others are those of the server or of its local copy, if there is one.
    """
    if not isinstance(catalog, Journal):
        return searched_views(catalog, progress=progress)[0]
    try:
        with open_or_copy(catalog.server, catalog.clock) as shared:
            views, others = searched_views(catalog, shared, progress=progress)
    except RigError:  # no server, and no copy yet
        return searched_views(catalog, progress=progress)[0]
    own = views.select(views.object_index == views.object_names.index(name))
    own = hbr.Views.of_object(name, own.descriptors, own.azimuth_deg, own.descriptor)
    kept = others.select(np.array([one != name for one in others.object_names], bool)[others.object_index])
    return hbr.Views.concatenate([own, kept])


@dataclass(frozen=True, slots=True)
class JournalState:
    """The numbers of objects and answers that wait for the server, and the reasons: sentences for the operator."""

    waiting: int = 0
    reasons: tuple[str, ...] = ()


class BackgroundDelivery(AbstractContextManager["BackgroundDelivery"]):
    """A thread that delivers the journal, whenever the server answers, during the work of a ``with`` block.

    It has its own connections. ``report`` gets a sentence about each delivered object, and one about each reason why an
    object was not delivered. ``changed`` gets each new state. Both are called in the thread.
    """

    def __init__(
        self,
        place: CatalogPlace,
        clock: Clock,
        report: Callable[[str], None],
        *,
        changed: Callable[[JournalState], None] | None = None,
        check_s: float = CHECK_S,
        retry_s: float = RETRY_S,
    ) -> None:
        self.state = JournalState()
        self._place = place
        self._clock = clock
        self._report = report
        self._changed = changed
        self._check_s = check_s
        self._retry_s = retry_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="catalog delivery", daemon=True)
        if place.url is not None:
            self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join(END_S)

    def _run(self) -> None:
        while True:
            state, before = self._attempt(), self.state
            if state != before:
                self.state = state
                for reason in state.reasons:
                    if reason not in before.reasons:
                        self._report(reason)
                if self._changed is not None:
                    self._changed(state)
            if self._ended.wait(self._retry_s if state.reasons else self._check_s):
                return

    def _attempt(self) -> JournalState:
        """Deliver what is in the journal; return what stays there."""
        left = self.state.waiting
        try:
            left = waiting(self._place, self._clock)
            if not left:
                return JournalState()
            done = deliver_journal(self._place, self._clock)
            for one in done:
                if one.conflict is None:
                    self._report(delivery_words(one, self._place))
            reasons = tuple(delivery_words(one, self._place) for one in done if one.conflict is not None)
            return JournalState(waiting(self._place, self._clock), reasons)
        except RigError as error:
            return JournalState(left, (failure_words(error),))
