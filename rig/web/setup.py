"""What the two processes of a server share: their set-up, and what keeps them quick."""

import gc
import os
from contextlib import suppress
from pathlib import Path
from typing import Final

from pydantic import BaseModel, ConfigDict, Field

from rig.config import RigConfig
from rig.config.catalog_place import CatalogPlace
from rig.web.access import new_token

BENCH_NICE: Final = -10
"""The process that owns the bench. Without root, a priority is raised only if the system permits it (`LimitNICE=`)."""
WEB_NICE: Final = -5  # before other programs, because it receives STOP; after the bench, which obeys it


class Setup(BaseModel):
    """The bench that is served and how to open it, the address at which the server listens, and its allowed clients.

    ``config_file`` is the file that the pages change, if they can. ``arguments`` are the arguments of `rig` that
    select the same bench. ``local_token`` lets commands of the same user on this computer watch.
    """

    model_config = ConfigDict(frozen=True)

    bench: str
    config: RigConfig
    config_file: Path | None = None
    seed: int | None = None
    arguments: tuple[str, ...] = ()
    host: str = "127.0.0.1"
    port: int = 0
    other_hosts: tuple[str, ...] = ()
    certfile: Path | None = None
    keyfile: Path | None = None
    needs_login: bool = False
    max_upload_bytes: int = 500_000_000
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
