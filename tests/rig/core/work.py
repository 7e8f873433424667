"""Work for other processes; this file imports little, because each process imports it."""

import os
import signal

from hbr.descriptors import descriptor


def square(item: int) -> int:
    if item == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return item * item


def length(item: tuple[str, int]) -> int:
    return descriptor(item[0]).length
