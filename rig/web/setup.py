"""What the two processes of a server share: their set-up, the catalog of the bench, and what keeps them quick."""

import gc
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, Field

from rig.catalog import Catalog
from rig.catalog.copying import Attempts, open_or_copy
from rig.catalog.journal import BackgroundDelivery, JournalState
from rig.config import RigConfig
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock
from rig.web.access import new_token

BENCH_NICE: Final = -10
"""The process that owns the bench. Without root, a priority is raised only if the system permits it (`LimitNICE=`)."""
WEB_NICE: Final = -5  # before other programs, because it receives STOP; after the bench, which obeys it


class Listening(BaseModel):
    """The address at which a server listens, and its allowed clients."""

    model_config = ConfigDict(frozen=True)

    host: str
    port: int
    other_hosts: tuple[str, ...] = ()
    certfile: Path | None = None
    keyfile: Path | None = None
    needs_login: bool = False
    max_upload_bytes: int = 500_000_000


class Setup(BaseModel):
    """The bench that is served and how to open it, and the address of the server.

    ``arguments`` are the arguments of `rig` that select the same bench. ``local_token`` lets commands of the same user
    on this computer watch.
    """

    model_config = ConfigDict(frozen=True)

    bench: str
    config: RigConfig
    seed: int | None = None
    arguments: tuple[str, ...] = ()
    listening: Listening
    local_token: str = Field(default_factory=new_token)

    @property
    def state_folder(self) -> Path:
        """Folder of the bench's state, with the stop channel."""
        return self.config.state_path(self.bench)

    @property
    def catalog_place(self) -> CatalogPlace:
        return self.config.catalog_place(self.bench)

    @property
    def runs(self) -> Path:
        """Folder of the saved runs."""
        return self.config.catalog_path(self.bench) / "runs"


class BenchCatalog:
    """The catalog of a bench: opens it for requests and jobs, even while its server does not answer.

    ``changed`` gets `state` after each change, and ``report`` a sentence about each object that was delivered in the
    background, and about each reason why one was not.
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


def print_note(text: str) -> None:
    """Print a note on stderr, unless it is closed."""
    with suppress(OSError):
        print(f"Note: {text}", file=sys.stderr, flush=True)


def set_priority(nice: int) -> None:
    """Give the calling thread, and those that it starts, a priority; without the right to it, nothing changes.

    All threads of an interpreter need the same one: a thread that waits for the processor may hold the interpreter.
    """
    with suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, nice)


def shorten_pauses() -> None:
    """Exclude all objects that exist now from the collection of garbage.

    They live as long as the process. One pass over the imported modules stops all threads for 0.1 s.
    """
    gc.collect()
    gc.freeze()
