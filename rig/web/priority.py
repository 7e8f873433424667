"""What keeps the processes of a server quick: their priorities, and short pauses for the collection of garbage."""

import gc
import os
from contextlib import suppress
from typing import Final

BENCH: Final = -10
"""The process that owns the bench. Without root, a priority is raised only if the system permits it (`LimitNICE=`)."""
WEB: Final = -5


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
