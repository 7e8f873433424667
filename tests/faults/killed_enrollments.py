"""A program that runs enrollments and kills each at another point of its progress (`tests.faults.kills`).

Arguments: FOLDER KILLS SEED. Each enrollment runs in a child process, writes to FOLDER/<number> and reports every view
when the plan says that it is stored. The program prints one line of JSON for each child: its number and its views.
"""

import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from rig.catalog import Catalog
from rig.events.events import Accepted
from rig.plans.enroll import enroll
from tests.faults.fault_runs import NAME, Rig, new_rig
from tests.faults.kills import killed_child, points

VIEWS = 6


def main() -> None:
    folder, kills, seed = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    with new_rig(folder / "bench") as rig:
        _enroll(rig, folder / "warm-up", lambda _index: None)  # the first run stores byte code
        counted = partial(_enroll, rig, folder / "counted", lambda _index: None)
        for number, (point, delay_s) in enumerate(points(counted, kills, seed)):
            reported = killed_child(partial(_enroll, rig, folder / str(number)), point, delay_s)
            print(json.dumps({"number": number, "reported": reported}), flush=True)


def _enroll(rig: Rig, folder: Path, report: Callable[[int], object]) -> None:
    with rig.bench() as bench, Catalog.open(folder, clock=bench.clock) as catalog:
        for event in enroll(bench, catalog, NAME, views=VIEWS):
            if isinstance(event, Accepted):
                report(event.index)
