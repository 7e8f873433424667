"""A program that runs enrollments and kills each at another point of its progress.

    python killed_enrollments.py FOLDER KILLS SEED

Progress is counted in calls that store something: each counts when it starts and when it returns. The program enrolls
once to count them, then spreads KILLS points evenly over the count. Each enrollment runs in a child process, writes to
FOLDER/<number> and reports every view on a pipe when the plan says that it is stored. The child dies within `JITTER_S`
of its point, so some die inside a call. The program prints one line of JSON for each child: its number and the views
that it reported.
"""

import io
import json
import os
import random
import signal
import sqlite3
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from rig.catalog import Catalog
from rig.events.events import Accepted
from rig.plans.enroll import enroll
from tests.faults.fault_runs import NAME, Rig, new_rig

VIEWS = 8
STORING = {os.mkdir, os.open, os.fsync, os.rename, os.replace, os.unlink}
STORING_METHODS = {"write", "execute", "commit"}
STORING_TYPES = (io.BufferedWriter, sqlite3.Connection, sqlite3.Cursor)
JITTER_S = 0.002


def main() -> None:
    folder, kills, seed = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    random_numbers = random.Random(seed)
    with new_rig(folder / "bench") as rig:
        counted: list[int] = []
        _count_calls(lambda: counted.append(1))
        _enroll(rig, folder / "counted", lambda _index: None)
        sys.setprofile(None)
        for number in range(kills):
            point = round((number + random_numbers.random()) * len(counted) / kills)
            delay_s = random_numbers.uniform(1e-6, JITTER_S)
            reported = _killed_child(rig, folder / str(number), point, delay_s)
            print(json.dumps({"number": number, "reported": reported}), flush=True)


def _count_calls(count: Callable[[], None]) -> None:
    """Call ``count`` from now on when a storing call starts and when it returns."""

    def profile(_frame: FrameType, event: str, function: Any) -> None:
        if event not in ("c_call", "c_return"):
            return
        owner = getattr(function, "__self__", None)
        if function in STORING or (isinstance(owner, STORING_TYPES) and function.__name__ in STORING_METHODS):
            count()

    sys.setprofile(profile)


def _killed_child(rig: Rig, folder: Path, point: int, delay_s: float) -> list[int]:
    """Enroll in a child process that dies ``delay_s`` after storing call ``point``; return the reported views."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            _die_at(point, delay_s)
            _enroll(rig, folder, lambda index: os.write(writing, bytes([index])))
            signal.pause()  # the last point is less than the delay before the end
        finally:
            os._exit(1)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        reported = list(pipe.read())
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    if status != -signal.SIGALRM:
        raise SystemExit(f"The enrollment that should die at point {point} ended with {status}.")
    return reported


def _die_at(point: int, delay_s: float) -> None:
    """Start a timer at the point; its signal ends the process without any handler, as SIGKILL does."""
    remaining = point

    def count() -> None:
        nonlocal remaining
        remaining -= 1
        if remaining == 0:
            signal.setitimer(signal.ITIMER_REAL, delay_s)
            sys.setprofile(None)

    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    if point == 0:
        signal.setitimer(signal.ITIMER_REAL, delay_s)
    else:
        _count_calls(count)


def _enroll(rig: Rig, folder: Path, report: Callable[[int], object]) -> None:
    with rig.bench() as bench, Catalog.open(folder, clock=bench.clock) as catalog:
        for event in enroll(bench, catalog, NAME, views=VIEWS):
            if isinstance(event, Accepted):
                report(event.index)


if __name__ == "__main__":
    main()
