"""Search with a strategy of your own, beside those that come with the rig."""

import tempfile

import hbr
from rig import Catalog, enroll, identify, load_model, open_bench
from rig.events.events import Identified
from rig.search.session import AnyStrategy, DenseSearch, Finish, HoughSearch, Rotate
from rig.search.strategies import descriptor_for, end_by_margin
from rig.views.description import BENCH_DESCRIPTOR
from sim.bench import ShelfOperator

OBJECTS = ("toy-house", "toy-car", "book-night")


class Golden:
    """Rotate by the golden angle: at any time, the views so far lie well apart."""

    name = "golden"

    def next(self, search: HoughSearch) -> Rotate | Finish:
        return end_by_margin(search) or Rotate(137.508, note="the golden angle leads far from all views so far")


class FarSide:
    """The far side of the object, on the dense search: its probabilities end the search."""

    name = "far-side"
    descriptor = BENCH_DESCRIPTOR

    def next(self, search: DenseSearch) -> Rotate | Finish:
        if search.decision.outcome is not hbr.Outcome.CONTINUE:
            return Finish(search.decision.reason)
        return Rotate(135.0, note="nearly the far side")


def main() -> None:
    strategies: tuple[AnyStrategy, ...] = (Golden(), FarSide())
    with (
        tempfile.TemporaryDirectory() as folder,
        open_bench("sim", seed=3) as bench,
        Catalog.open(folder, clock=bench.clock) as catalog,
    ):
        for name in OBJECTS:
            for _ in enroll(bench, catalog, name, views=8):
                pass
        operator = bench.placer
        assert isinstance(operator, ShelfOperator)  # simulated; on a real bench the operator places the object
        for strategy in (None, *strategies):
            model = load_model(catalog, descriptor=None if strategy is None else descriptor_for(strategy))
            for name in OBJECTS:
                operator.next_object = name
                for event in identify(bench, model, strategy=strategy):
                    if isinstance(event, Identified):
                        found = f"{event.name or 'unknown':12} {event.views} views, {event.travelled_deg:.0f}°"
                label = "dense" if strategy is None else strategy.name
                print(f"{label:8} {name:12} found as {found}")


if __name__ == "__main__":
    main()
