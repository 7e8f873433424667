"""A search with a strategy of its own, beside those that come with the rig.

To have `rig identify --strategy golden` find it, a package names it in the entry-point group `rig.strategies`:

    [project.entry-points."rig.strategies"]
    golden = "my_package:Golden"
"""

import tempfile

from rig import Catalog, enroll, identify, load_model, open_bench
from rig.events.events import Identified
from rig.search.strategies import AnyStrategy, DenseSearchState, Finish, Rotate, SearchState, descriptor_for, enough
from sim.bench import ShelfOperator

OBJECTS = ("toy-house", "toy-car", "book-night")


class Golden:
    """Turn by the golden angle: wherever it stops, the views so far lie well apart."""

    name = "golden"

    def next(self, look: SearchState) -> Rotate | Finish:
        return enough(look) or Rotate(137.508, "the golden angle leads far from all views so far")


class FarSide:
    """The same on the rig's own search: its rules say when to stop, and views are described by its descriptor."""

    name = "far-side"
    descriptor = "edges+colours"

    def next(self, look: DenseSearchState) -> Rotate | Finish:
        if look.verdict.kind != "look":
            return Finish(look.verdict.words)
        return Rotate(135.0, "nearly the far side")


def main() -> None:
    strategies: tuple[AnyStrategy, ...] = (Golden(), FarSide())
    with (
        tempfile.TemporaryDirectory() as folder,
        open_bench("sim", seed=3) as bench,
        Catalog.open(folder, clock=bench.clock) as catalog,
    ):
        for name in OBJECTS:
            for _ in enroll(bench, catalog, name, views=12):
                pass
        hands = bench.operator
        assert isinstance(hands, ShelfOperator)  # simulated; on a real bench somebody puts the object there
        for strategy in (None, *strategies):
            model = load_model(catalog, descriptor=None if strategy is None else descriptor_for(strategy))
            for name in OBJECTS:
                hands.next_object = name
                for event in identify(bench, model, strategy=strategy):
                    if isinstance(event, Identified):
                        found = f"{event.name or 'unknown':12} {event.views} views, {event.travelled_deg:.0f}°"
                label = "dense" if strategy is None else strategy.name
                print(f"{label:8} {name:12} found as {found}")


if __name__ == "__main__":
    main()
