"""Priorities of the processes of a server, as far as the system permits: the control loop comes first."""

import os
from contextlib import suppress
from typing import Final

BENCH: Final = -10
"""The process that owns the bench. Without root, a priority is raised only if the system permits it (`LimitNICE=`)."""
WEB: Final = -5


def set_priority(nice: int) -> None:
    """Give this process a priority; without the right to it, nothing changes. Called before threads start."""
    with suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, nice)
