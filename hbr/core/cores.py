"""Number of threads that share one large computation."""

import os
from typing import Final

_CORES: Final = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

THREADS: Final = min(_CORES, 4)
"""Threads of one computation. More of them would wait for the memory or for the interpreter."""
