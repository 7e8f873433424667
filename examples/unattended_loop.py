"""Identify one object after the other and write every event as a line of JSON; an error is the last line."""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from rig import Catalog, identify, load_model, open_bench, photograph_table
from rig.config import load_config
from rig.core.clock import SystemClock
from rig.core.errors import RigError
from rig.events.events import Identified, event_dict
from rig.plans.identify import watch
from rig.views.object_presence import TableWatcher


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bench", default="sim")
    parser.add_argument("--catalog", type=Path, required=True, help="folder of the catalog")
    parser.add_argument("--answers", type=int, help="number of answers after which the loop ends (default: endless)")
    arguments = parser.parse_args()

    try:
        with (
            Catalog.open(arguments.catalog, clock=SystemClock(), read_only=True) as catalog,
            open_bench(arguments.bench, load_config()) as bench,
        ):
            placer = bench.placer or TableWatcher(bench)  # no operator at the keyboard: use the camera
            if placer.clear():
                for taken in photograph_table(bench):  # start with an empty table
                    print(json.dumps(event_dict(taken)), flush=True)
            answers = 0
            # The model is loaded before each search, so that newly enrolled objects are found, too.
            for event in watch(bench, lambda: identify(bench, load_model(catalog), placer=placer)):
                print(json.dumps(event_dict(event)), flush=True)
                answers += isinstance(event, Identified)
                if answers == arguments.answers:
                    break
    except RigError as error:
        print(json.dumps(asdict(error.problem)), flush=True)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
