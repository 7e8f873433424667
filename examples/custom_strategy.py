"""A search with a strategy of its own, beside those that come with the rig.

To have `rig identify --strategy golden` find it, a package names it in the entry-point group `rig.strategies`:

    [project.entry-points."rig.strategies"]
    golden = "my_package:Golden"
"""

import tempfile

import hbr
from rig import Catalog, enroll, identify, open_bench
from rig.plans.events import Identified
from rig.plans.strategies import Look, Stop, Strategy, Turn, enough
from sim.bench import ShelfOperator

OBJECTS = ("toy-house", "toy-car", "book-night")


class Golden:
    """Turn by the golden angle: wherever it stops, the views so far lie well apart."""

    name = "golden"

    def next(self, look: Look) -> Turn | Stop:
        return enough(look) or Turn(137.508, "the golden angle leads far from all views so far")


def main() -> None:
    strategies: tuple[Strategy | str, ...] = ("ahbr", "sweep", Golden())
    with (
        tempfile.TemporaryDirectory() as folder,
        open_bench("sim", seed=3) as bench,
        Catalog.open(folder, clock=bench.clock) as catalog,
    ):
        for name in OBJECTS:
            for _ in enroll(bench, catalog, name, views=12):
                pass
        index = hbr.ViewIndex(catalog.views().views)
        hands = bench.operator
        assert isinstance(hands, ShelfOperator)  # simulated; on a real bench somebody puts the object there
        for strategy in strategies:
            for name in OBJECTS:
                hands.next_object = name
                for event in identify(bench, index, strategy=strategy):
                    if isinstance(event, Identified):
                        found = f"{event.name or 'unknown':12} {event.views} views, {event.travelled_deg:.0f}°"
                label = strategy if isinstance(strategy, str) else strategy.name
                print(f"{label:8} {name:12} found as {found}")


if __name__ == "__main__":
    main()
