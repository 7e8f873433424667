"""Times from the shaft's stop until the table counts as at rest, for simulated platters that ring.

`python -m benchmarks.settling [--damping 0.02 0.05 0.2] [--seeds 1] [--first-seed 3]` calibrates each platter, moves
the table up and down by 5 to 180°, and prints a table in Markdown: the slowest rest upwards and downwards, in seconds.
A seed draws the friction of the servo. The first move has its own column: when the torque is switched on, the shaft
rests anywhere within its friction. "never": the table did not come to rest within the time for a move.
"""

import argparse
from collections import defaultdict
from itertools import pairwise
from math import inf
from typing import Final

import numpy as np

from calibration.ringing import Ringing
from rig.calibrations import CalibrationResult
from rig.config import load_config
from rig.core.errors import MotionTimeout
from rig.motion.turntable import Turntable
from sim.bench import ShelfOperator, open_sim_bench
from sim.noise import NoiseModel
from sim.world import World

FREQUENCIES_HZ, DAMPINGS = (6.0, 9.0, 13.0, 20.0), (0.02, 0.05, 0.2)
FIRST, UP, DOWN = "first move", "upwards", "downwards"
TARGETS_DEG: Final = (10.0, 15.0, 45.0, 40.0, 85.0, 40.0, 130.0, 30.0, 210.0, 30.0, 25.0)


def settling_s(hz: float, damping: float, seed: int) -> dict[str, float]:
    """Return the slowest rest of each kind of move: seconds after the shaft is slower than a table at rest may be."""
    slowest: dict[str, float] = defaultdict(float)
    world = World(noise=NoiseModel(structure_hz=hz, structure_damping=damping), seed=seed)
    config = load_config(None, ())
    with open_sim_bench(config, ShelfOperator(world, {}), open_now=("servo", "imu")) as bench:
        *_, found = Ringing(6).live(bench)
        assert isinstance(found, CalibrationResult)
        ringing = {key.removeprefix("table."): value for key, value in found.settings.items()} if found.passed else {}
        with Turntable(bench, **ringing) as table:
            for index, (start_deg, target_deg) in enumerate(pairwise((table.rest_deg, *TARGETS_DEG))):
                kind = UP if target_deg > start_deg else DOWN
                kind = kind if index else FIRST
                try:
                    table.goto(target_deg)
                except MotionTimeout:
                    slowest[kind] = inf
                    break
                slowest[kind] = max(slowest[kind], settled_s(table, world, config.table.quiet_dps))
    return slowest


def settled_s(table: Turntable, world: World, quiet_dps: float) -> float:
    """Return how long after its shaft was slower than ``quiet_dps`` the table counted as at rest, in the last move."""
    rest_s = table.moves[-1].readings[-1][0] * 1e-9
    times = np.arange(rest_s - 5.0, rest_s, 0.001)
    speeds_dps = np.array([abs(world.shaft(round(time_s * 1e9))[1]) for time_s in times])
    return rest_s - float(times[speeds_dps > quiet_dps][-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--damping", type=float, nargs="+", default=DAMPINGS)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=3)
    args = parser.parse_args()
    print(f"| platter | {UP} | {DOWN} | {FIRST} |", "|---|---|---|---|", sep="\n")
    for hz in FREQUENCIES_HZ:
        for damping in args.damping:
            runs = [settling_s(hz, damping, args.first_seed + index) for index in range(args.seeds)]
            slowest = [max(run[kind] for run in runs) for kind in (UP, DOWN, FIRST)]
            cells = " | ".join("never" if seconds == inf else f"{seconds:.3f}" for seconds in slowest)
            print(f"| {hz:g} Hz, damping {damping:g} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
