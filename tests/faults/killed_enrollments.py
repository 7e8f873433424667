"""As a program: enrollments that are killed at random moments, each a process of its own.

    python killed_enrollments.py FOLDER KILLS SEED

Each child enrolls into FOLDER/<number> on a simulated bench that was opened before, and reports every view on a pipe as
soon as the plan says that it is stored. It prints a line of JSON for each: the number, whether the child was killed
before it was done, and what it had reported.
"""

import json
import os
import random
import select
import signal
import sys
from pathlib import Path

from rig.catalog import Catalog
from rig.core.clock import SystemClock, seconds_between
from rig.events.events import Accepted
from rig.plans.enroll import enroll
from tests.faults.fault_runs import NAME, Rig, new_rig

VIEWS = 8


def main() -> None:
    folder, kills, seed = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    moments = random.Random(seed)
    clock = SystemClock()
    with new_rig(folder / "bench") as rig:
        whole_s = float("inf")
        for name in ("cold", "warm"):
            begun_ns = clock.now_ns()
            _child(rig, folder / name, None)
            whole_s = min(whole_s, seconds_between(begun_ns, clock.now_ns()))
        for number in range(kills):
            begun_ns = clock.now_ns()
            moment_s = moments.uniform(0.0, whole_s)
            killed, reported = _child(rig, folder / str(number), moment_s)
            if not killed:  # the computer has less to do than before: it was done already
                whole_s = min(whole_s, seconds_between(begun_ns, clock.now_ns()))
            print(json.dumps({"number": number, "killed": killed, "reported": reported}), flush=True)


def _child(rig: Rig, folder: Path, kill_after_s: float | None) -> tuple[bool, list[int]]:
    """Run one enrollment in a process of its own; return whether it was killed, and what it had reported."""
    reports, told = os.pipe()
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            _enroll(rig, folder, told)
            status = 0
        finally:
            os._exit(status)
    os.close(told)
    if kill_after_s is not None:
        select.select([], [], [], kill_after_s)
        os.kill(pid, signal.SIGKILL)
    reported = b""
    while chunk := os.read(reports, 1024):
        reported += chunk
    os.close(reports)
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    if status not in (0, -signal.SIGKILL):
        raise SystemExit(f"an enrollment ended with {status}")
    return status != 0, list(reported)


def _enroll(rig: Rig, folder: Path, told: int) -> None:
    with rig.bench() as bench, Catalog.open(folder, clock=bench.clock) as catalog:
        for event in enroll(bench, catalog, NAME, views=VIEWS):
            if isinstance(event, Accepted):
                os.write(told, bytes([event.index]))


if __name__ == "__main__":
    main()
