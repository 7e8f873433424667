"""The views of Fig. 7 of the paper: 16 objects at irregular angles, which the gyro of the simulated bench measures.

`python -m benchmarks.figure_7 CATALOG [--seed 0]`

Each object gets 44 to 73 views, and steps of 0.3 to 1.7 times their mean; both are random. Two near twins of the 16
objects follow. The new catalog is for `rig eval figure-7 --set catalog.path=CATALOG`.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hbr.core.angles import wrap360
from hbr.core.arrays import FloatArray
from rig import Catalog, enroll
from rig.catalog import Provenance
from rig.config import load_config
from rig.plans.photograph_table import photograph_table
from sim.bench import ShelfOperator, open_sim_bench
from sim.demo.run import ENROLLED
from sim.objects.shelf import shelf
from sim.world import World

TWINS = ("mug-star", "bottle-harvest")
OBJECTS = (*(name for name in ENROLLED if name not in TWINS), "bowl-hoops", "ball-football", *TWINS)
VIEWS = (44, 73)
STEP = (0.3, 1.7)


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("catalog", type=Path)
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args()
    record(given.catalog, OBJECTS, given.seed)


def record(folder: Path, names: Sequence[str], seed: int, views: tuple[int, int] = VIEWS) -> None:
    """Enroll the objects into a new catalog, and print how their angles are distributed."""
    rng = np.random.default_rng(seed)
    operator = ShelfOperator(World(seed=seed), shelf())
    steps_deg, errors_deg = [], []
    with (
        open_sim_bench(load_config(None, ("table.orientation=imu",)), operator) as bench,
        Catalog.open(folder, clock=bench.clock) as catalog,
    ):
        operator.clear()
        for _ in photograph_table(bench):
            pass
        for name in names:
            # An enrollment of the plan that is continued keeps its planned angles, which are even otherwise.
            plan_deg = azimuths(rng, int(rng.integers(*views, endpoint=True)))
            provenance = Provenance(bench.name, bench.devices(), bench.conditions)
            catalog.begin(name, planned_azimuth_deg=plan_deg.tolist(), provenance=provenance)
            for _ in enroll(bench, catalog, name, resume=True):
                pass
            stored = catalog.object(name).views
            taken_deg = np.sort([view.azimuth_deg for view in stored])
            steps_deg.append(np.diff(taken_deg, append=taken_deg[0] + 360))
            errors_deg.append([view.imu_deg - view.encoder_deg for view in stored])
            print(f"{name}: {len(stored)} views", flush=True)
    steps, errors = np.concatenate(steps_deg), np.concatenate(errors_deg)
    print(f"{len(steps)} views, {steps.min():.2f} to {steps.max():.2f} degrees apart, median {np.median(steps):.2f}")
    print(f"gyro minus encoder: RMS {np.sqrt(np.mean(errors**2)):.2f}, at most {np.abs(errors).max():.2f} degrees")


def azimuths(rng: np.random.Generator, count: int) -> FloatArray:
    """Return the azimuths of a revolution with irregular steps, in the order of an enrollment."""
    steps = rng.uniform(*STEP, count)
    table_deg = 360 * (np.cumsum(steps) - steps[0]) / steps.sum()
    return wrap360(-table_deg)


if __name__ == "__main__":
    main()
