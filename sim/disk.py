"""A full disk, for this process: what is to be made durable finds no space.

The seam is `os.fsync`, which is where a file system that allocates late, or a quota, tells.
"""

import errno
import os
from collections.abc import Callable
from typing import Any

_os: Any = os


def fill() -> Callable[[], None]:
    """Fill the disk; return what frees it again."""
    durable = os.fsync

    def full(_descriptor: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    _os.fsync = full

    def free() -> None:
        _os.fsync = durable

    return free
