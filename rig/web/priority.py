"""Priorities of the threads of a server, as far as the system permits: the control loop before all, exports last."""

import os
import threading
from contextlib import suppress
from typing import Final

BENCH: Final = -10
"""The process that owns the bench. Without root, a priority is raised only if the system permits it (`LimitNICE=`)."""
WEB: Final = -5
LOW: Final = 10


def set_priority(nice: int) -> None:
    """Give the calling thread, and threads that it starts, this priority; without the right to it, nothing changes."""
    with suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), nice)
