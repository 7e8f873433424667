"""Saved runs for tests."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rig.bench import Bench
from rig.catalog import Catalog, derived
from rig.config import load_config
from rig.events.events import Event
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from rig.plans.photograph_table import photograph_table
from rig.search.model import Model, load_model, model_of
from rig.search.saved_run import save_run
from sim.bench import ShelfOperator, open_sim_bench
from sim.objects.shelf import shelf
from sim.world import World
from tests.small import SMALL

Runs = dict[str, tuple[Path, list[Event]]]


def searched(folder: Path, bench: Bench, model: Model, **options: Any) -> list[Event]:
    """Identify the object on the table, save the run, and return its events."""
    events = []
    with save_run(folder, bench, model) as save:
        for event in identify(bench, model, **options):
            save(event)
            events.append(event)
    return events


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
            events = searched(home / strategy, bench, index, strategy=strategy, seed=number)
            runs[strategy] = home / strategy, events
        operator.next_object, operator.yaw_deg = "mug-star", 70.0
        runs["dense"] = home / "dense", searched(home / "dense", bench, load_model(catalog))
    return runs
