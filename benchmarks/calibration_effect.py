"""What calibrating is worth: the same objects found on the same faulty bench, before and after.

`python -m benchmarks.calibration_effect [--seeds 2]` opens simulated benches with strong errors: an encoder that is off
by half a degree over its turn, much play, a wrong scale of the gyro, a restless light. On each, objects are enrolled
and found again at drawn angles, first as the bench is, then after `backlash`, `encoder`, `motion_model`, `gyro_scale`
and `repeatability` were calibrated; worlds, objects and angles are the same. Prints a table in Markdown: the rate of
right answers, of "unknown" for objects that were not enrolled, how often the angle at which the object is said to stand
is right within a step of the enrolled views (objects that look alike from several sides are not) and its error then,
and how far the table's angle by the encoder is from the true one.
"""

import argparse
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import hbr
from calibration import backlash, encoder, gyro_scale, motion_model, repeatability
from rig.bench import Bench, calibrate
from rig.catalog import Catalog
from rig.config import load_config
from rig.facts import Fact, FactStore
from rig.plans.enroll import enroll
from rig.plans.events import Identified
from rig.plans.identify import identify
from rig.turntable import Turntable
from sim.bench import ShelfOperator, open_sim_bench
from sim.noise import NoiseModel
from sim.objects.shelf import shelf
from sim.world import World

SETTINGS = ("camera.width=320", "camera.height=240", "view.roi=[40, 0, 240, 240]")
ERRORS = NoiseModel(encoder_harmonic_deg=0.5, backlash_deg=0.8, gyro_scale_error=0.02, light_flicker=0.02)
OBJECTS, STRANGERS, TRIALS, VIEWS = 6, 2, 3, 24
AZIMUTHS_DEG = range(0, 360, 30)

PROCEDURES: tuple[Callable[[Bench], Iterator[Any]], ...] = (
    backlash.live,
    encoder.live,
    motion_model.live,
    gyro_scale.live,
)


def run(seed: int, calibrated: bool, folder: Path) -> dict[str, list[float]]:
    """Return the figures of one bench: right, unknown and confirmed answers, errors in degrees, views."""
    things = shelf()
    names = np.random.default_rng(seed).permutation(sorted(things))[: OBJECTS + STRANGERS].tolist()
    operator = ShelfOperator(World(noise=ERRORS, seed=seed), things)
    told: dict[str, list[float]] = defaultdict(list)
    with open_sim_bench(load_config(None, SETTINGS), operator) as bench:
        if calibrated:
            store = FactStore(folder / "facts")
            for procedure in (*PROCEDURES, lambda bench: repeatability.live(bench, names[0])):
                *_, fact = procedure(bench)
                assert isinstance(fact, Fact)
                store.keep(fact)
                told[f"passed {fact.name}"].append(fact.passed)
                calibrate(bench, store)
        with Turntable(bench) as table:
            for azimuth_deg in AZIMUTHS_DEG:
                table.goto(float(azimuth_deg))
                told["angle"].append(table.rest_deg - operator.world.table_deg())
            table.goto(0.0)
        told["angle"] = (np.array(told["angle"]) - np.mean(told["angle"])).tolist()  # where its zero is, matters not
        with Catalog.open(folder / "catalog", clock=bench.clock, create=True) as catalog:
            for name in names[:OBJECTS]:
                list(enroll(bench, catalog, name, views=VIEWS))
            index = hbr.ViewIndex(catalog.views().views)
        rng = np.random.default_rng(seed)
        for name in names * TRIALS:
            operator.next_object, operator.yaw_deg = name, float(rng.uniform(0, 360))
            *_, answer = identify(bench, index, seed=seed)
            assert isinstance(answer, Identified)
            told["views"].append(answer.views)
            if name in names[:OBJECTS]:
                told["right"].append(answer.name == name)
                if answer.name == name:
                    told["yaw"].append(abs((answer.yaw_deg - operator.yaw_deg + 180) % 360 - 180))
            else:
                told["unknown"].append(answer.name is None)
    return told


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--seeds", type=int, default=2)
    seeds = arguments.parse_args().seeds
    print("| bench | right | strangers unknown | pose within 15° | its RMSE | table's angle, RMS | views |")
    print("|---|---|---|---|---|---|---|")
    for calibrated in (False, True):
        told: dict[str, list[float]] = defaultdict(list)
        for seed in range(seeds):
            with TemporaryDirectory() as folder:
                for key, values in run(seed, calibrated, Path(folder)).items():
                    told[key] += values
        angle = np.array(told["angle"])
        near = np.array([error for error in told["yaw"] if error <= 360 / VIEWS])
        print(
            f"| {'calibrated' if calibrated else 'as it is'} | {sum(told['right']):.0f}/{len(told['right'])} "
            f"| {sum(told['unknown']):.0f}/{len(told['unknown'])} | {near.size}/{len(told['yaw'])} "
            f"| {np.sqrt((near**2).mean()):.2f} ° | {np.sqrt((angle**2).mean()):.3f} ° "
            f"| {np.mean(told['views']):.2f} |",
            flush=True,
        )
        for key, values in told.items():
            if key.startswith("passed "):
                print(f"|   {key} | {sum(values):.0f}/{len(values)} | | | | | |")


if __name__ == "__main__":
    main()
