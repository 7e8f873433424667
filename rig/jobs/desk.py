"""What a job gets from the presenter that runs it, and what it yields besides events."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, TypeVar

from rig.bench import Bench
from rig.bench.bench import DEVICES
from rig.catalog import Action, Catalog
from rig.catalog.jobs import JobProgress
from rig.catalog.journal import deliver_journal, delivery_words, failure_words, open_for_enrollment
from rig.config import RigConfig
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock, SystemClock
from rig.core.errors import CatalogBusy, CatalogError, RigError
from rig.core.next_steps import SomeSteps
from rig.doctor.finding import Finding
from rig.events.events import Event
from rig.plans.operator import Operator, Unattended


@dataclass(frozen=True, slots=True)
class Remark:
    """A sentence for the operator: about the catalog, the journal, the log, or an ``event`` that prepares the job.

    ``steps`` says what to do about it.
    """

    text: str
    is_warning: bool = True
    event: Event | None = None
    steps: SomeSteps = ()


@dataclass(frozen=True, slots=True)
class JobResult:
    """The result of a job that ends without an event: its values, which are JSON or a model of it, and a sentence."""

    values: Any
    text: str


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a measurement: ``share`` from 0 to 1, and ``words`` about the last step."""

    share: float
    words: str


T = TypeVar("T")
Step = Event | Remark | JobResult | Progress | Finding
Steps = Generator[Step, None, T]


class Desk(ABC):
    """The place where a job runs: it opens bench and catalog, and asks the operator."""

    operator: Operator
    """Answers the questions."""
    config: RigConfig
    """The configuration of the bench before it is opened."""
    place: CatalogPlace
    """Place of the bench's catalog."""
    log_waits_for_server = True
    """Whether an action on the bench may wait until a catalog on a server has its entry in the log."""

    @abstractmethod
    def open_bench(self, devices: Iterable[str] = DEVICES) -> AbstractContextManager[Bench]:
        """Open the bench, or return the one that is open; the servo and ``devices`` are opened now."""

    def who_places(self, bench: Bench) -> Operator:
        """Return who answers questions about the objects of a tray: no person if the bench places them by itself."""
        return self.operator if bench.placer is None else Unattended()

    @abstractmethod
    def open_to_read(self) -> Catalog:
        """Open the catalog for a search; if its server does not answer, its local copy."""

    def open_to_enroll(self, clock: Clock) -> Catalog:
        """Open the catalog for new views, which ``clock`` dates; if it is on a server, the journal."""
        return open_for_enrollment(self.place, clock)

    def deliver(self) -> Iterator[Remark]:
        """Deliver the journal to the server of the catalog, if it has one; it keeps what cannot be delivered."""
        if self.place.url is None:
            return
        try:
            for one in deliver_journal(self.place, SystemClock()):
                yield Remark(delivery_words(one, self.place), is_warning=one.conflict is not None)
        except (CatalogError, CatalogBusy) as error:
            yield Remark(failure_words(error))

    def preparing(self) -> AbstractContextManager[Callable[[JobProgress], None]]:
        """Return a display of the progress while the views of the catalog are read for the first time."""
        return nullcontext(lambda _: None)

    def log(self, action: Action, **details: Any) -> Iterator[Remark]:
        """Write an action on the bench into the log of its catalog, if it has one."""
        if not self.place.may_exist() or not (self.place.url is None or self.log_waits_for_server):
            return
        try:
            with Catalog.open(self.place, clock=SystemClock()) as catalog:
                catalog.note(action, **details)
        except RigError as error:  # the action itself succeeded
            yield Remark(f"The log has no entry for this action. {error.what}")
