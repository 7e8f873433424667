"""A simulated full disk for this process: `os.fsync` fails.

File systems with delayed allocation or a quota also report a full disk at `os.fsync`.
"""

import errno
import os
from collections.abc import Callable
from typing import Any

_os: Any = os


def fill() -> Callable[[], None]:
    """Fill the disk; return the function that frees it."""
    fsync = os.fsync

    def full(_descriptor: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    _os.fsync = full

    def free() -> None:
        _os.fsync = fsync

    return free
