"""Saved runs for tests."""

from collections.abc import Sequence
from pathlib import Path

from rig.catalog import Catalog, derived
from rig.config import load_config
from rig.events.events import Event
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from rig.plans.photograph_table import photograph_table
from rig.search.model import load_model, model_of
from rig.search.saved_run import RunWriter
from sim.bench import ShelfOperator, open_sim_bench
from sim.objects.shelf import shelf
from sim.world import World
from tests.small import SMALL

Runs = dict[str, tuple[Path, list[Event]]]


def saved_runs(home: Path, strategies: Sequence[str] = ("ahbr", "hbr", "sweep", "random")) -> Runs:
    """Return the folders of runs by strategy, and the events that each run yielded; one run is ``dense``."""
    operator = ShelfOperator(World(seed=9), shelf())
    runs: Runs = {}
    settings = (*SMALL, "identify.max_views=4", "identify.margin=0.9")  # every run takes all its views
    with (
        open_sim_bench(load_config(None, settings), operator) as bench,
        Catalog.open(home / "catalog", clock=bench.clock) as catalog,
    ):
        list(photograph_table(bench))
        for name in ("mug-white", "mug-star", "lamp"):
            list(enroll(bench, catalog, name, views=4))
        index = model_of(derived.views(catalog))
        for number, strategy in enumerate(strategies):
            operator.next_object, operator.yaw_deg = "mug-star", 40.0 * number
            with RunWriter(home / strategy, bench, index) as writer:
                events = []
                for event in identify(bench, index, strategy=strategy, seed=number, top=2):
                    writer.add(event)
                    events.append(event)
            runs[strategy] = home / strategy, events
        model = load_model(catalog)
        operator.next_object, operator.yaw_deg = "mug-star", 70.0
        with RunWriter(home / "dense", bench, model) as writer:
            events = []
            for event in identify(bench, model, top=2):
                writer.add(event)
                events.append(event)
        runs["dense"] = home / "dense", events
    return runs
