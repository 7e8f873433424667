"""Kill a process at a chosen point of its progress.

Progress is counted in calls that store something: each counts when it starts and when it returns. A child process dies
within `JITTER_S` of its point, so some die inside a call.
"""

import io
import os
import random
import select
import signal
import sqlite3
import sys
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

STORING = {os.mkdir, os.open, os.fsync, os.rename, os.replace, os.unlink}
STORING_METHODS = {"write", "execute", "commit"}
STORING_TYPES = (io.BufferedWriter, sqlite3.Connection, sqlite3.Cursor)
JITTER_S = 0.002


def points(work: Callable[[], object], kills: int, seed: int) -> Iterator[tuple[int, float]]:
    """Do the work once to count its storing calls; yield ``kills`` points of it, each with a delay in seconds."""
    counted: list[int] = []
    random_numbers = random.Random(seed)
    _count_calls(lambda: counted.append(1))
    try:
        work()
    finally:
        sys.setprofile(None)
    for number in range(kills):
        point = round((number + random_numbers.random()) * len(counted) / kills)
        yield point, random_numbers.uniform(1e-6, JITTER_S)


def killed_child(work: Callable[[Callable[[int], object]], object], point: int, delay_s: float) -> list[int]:
    """Do the work in a child process that dies ``delay_s`` after storing call ``point``; return what it reported.

    The work reports numbers from 0 to 255 by the function that it is given.
    """
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            _die_at(point, delay_s)
            work(lambda number: os.write(writing, bytes([number])))
            signal.pause()  # the last point is less than the delay before the end
        finally:
            os._exit(1)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        reported = list(pipe.read())
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    if status != -signal.SIGKILL:
        raise SystemExit(f"The work that should die at point {point} ended with {status}.")
    return reported


def _count_calls(count: Callable[[], None]) -> None:
    """Call ``count`` from now on when a storing call starts and when it returns."""

    def profile(_frame: FrameType, event: str, function: Any) -> None:
        if event not in ("c_call", "c_return"):
            return
        owner = getattr(function, "__self__", None)
        if function in STORING or (isinstance(owner, STORING_TYPES) and function.__name__ in STORING_METHODS):
            count()

    sys.setprofile(profile)


def _die_at(point: int, delay_s: float) -> None:
    """Have another process kill this one ``delay_s`` after the point; the program handles every other signal."""
    remaining = point

    def kill() -> None:
        if os.fork() == 0:
            select.select([], [], [], delay_s)
            os.kill(os.getppid(), signal.SIGKILL)
            os._exit(0)

    def count() -> None:
        nonlocal remaining
        remaining -= 1
        if remaining == 0:
            sys.setprofile(None)
            kill()

    if point == 0:
        kill()
    else:
        _count_calls(count)
