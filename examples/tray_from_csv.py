"""Enroll the objects of a CSV list; skip complete objects and resume interrupted ones."""

import argparse
from pathlib import Path

from rig import Catalog, open_bench, photograph_table
from rig.config import load_config
from rig.events.events import Enrolled, Item, Rejected
from rig.plans.tray import enroll_tray, read_tray


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tray", type=Path, help="CSV with the columns name, label, note, views")
    parser.add_argument("--bench", default="sim")
    parser.add_argument("--catalog", type=Path, required=True, help="folder of the catalog")
    parser.add_argument("--views", type=int, default=72)
    arguments = parser.parse_args()

    items = read_tray(arguments.tray)  # reports all mistakes at once, with their lines
    with (
        open_bench(arguments.bench, load_config()) as bench,
        Catalog.open(arguments.catalog, clock=bench.clock) as catalog,
    ):
        if bench.placer is not None:  # otherwise the operator runs `rig empty-table`
            list(photograph_table(bench))
        for event in enroll_tray(bench, catalog, items, views=arguments.views):
            match event:
                case Item():
                    print(f"{event.number}/{event.of} {event.name}: {event.action} {event.reason or ''}".rstrip())
                case Rejected():
                    print(f"  view {event.index + 1} repeated: {'; '.join(event.reasons)}")
                case Enrolled():
                    print(f"  {event.views} views in {event.seconds:.0f} s")
                case _:
                    pass


if __name__ == "__main__":
    main()
