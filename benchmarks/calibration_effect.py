"""What calibrating is worth: the same objects found on the same faulty benches, before and after.

`python -m benchmarks.calibration_effect [--seeds 3] [--first-seed 0] [--level usual] [--orientation encoder]` enrolls
objects on a simulated bench and finds them again on another one: the same after its camera was knocked, and its servo
and IMU replaced. Both are as they are, or both were calibrated by `backlash`, `encoder`, `motion_model`, `gyro_scale`,
`camera_model`, `table_axis` and `repeatability`; worlds, objects and angles are the same. The levels of error are those
of a bench built with care, of a usual one, and of a poor one, each within the parts' datasheets; a view's angle is that
of the encoder, or of the gyro alone.

Prints a table in Markdown: the rate of right answers, of "unknown" for objects that were not enrolled, and of "unknown"
for those that were, with Wilson's 95 % intervals; how often the angle at which the object is said to stand is right
within a step of the enrolled views (objects that look alike from several sides are not) and its error then; and how far
the angles of the views are from the true ones.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import hbr
from calibration.procedures import Backlash, CameraModel, Encoder, GyroScale, MotionModel, Repeatability, TableAxis
from hbr.evaluation.statistics import wilson
from rig.bench import Bench, calibrate
from rig.calibrations import CalibrationResult, CalibrationStore
from rig.catalog import Catalog
from rig.config import load_config
from rig.core.errors import RigError
from rig.events.events import Identified, Moved
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from sim.bench import ShelfOperator, open_sim_bench
from sim.noise import NoiseModel
from sim.objects.shelf import shelf
from sim.world import World

LEVELS = {
    "careful": NoiseModel(encoder_harmonic_deg=0.1, gyro_scale_error=0.005, camera_mount=0.2),
    "usual": NoiseModel(encoder_harmonic_deg=0.3, backlash_deg=0.5, gyro_scale_error=0.015, camera_mount=0.7),
    "poor": NoiseModel(
        encoder_harmonic_deg=0.8,
        backlash_deg=1.5,
        gyro_scale_error=0.015,
        camera_mount=1.2,
        light_flicker=0.01,
        placement_mm=2.0,
    ),
}
OBJECTS, UNKNOWN, TRIALS, VIEWS = 10, 5, 2, 24
OTHER_BENCH = 1000
"""The seed of the bench on which objects are found is so much above that of the one on which they were enrolled."""

Told = dict[str, list[float]]


def calibrated_on(bench: Bench, store: CalibrationStore, told: Told, thing: str) -> None:
    """Calibrate the bench and put in force what passes."""
    found: dict[str, CalibrationResult] = {}
    procedures = (Backlash(), Encoder(), MotionModel(), GyroScale(), CameraModel(), TableAxis(), Repeatability(thing))
    for procedure in procedures:
        *_, result = procedure.live(bench, *(found[name] for name in procedure.requires))
        assert isinstance(result, CalibrationResult)
        found[result.name] = result
        store.add(result)
        told[f"refused {result.name}"].append(not result.passed)
        calibrate(bench, store)


def angles_off(events: Iterator[Any], operator: ShelfOperator, orientation: str) -> list[float]:
    """Run an enrollment and return how far the angles of its rests are from the true ones, but for where zero is."""
    off = []
    turned_deg = 0.0
    for event in events:
        if isinstance(event, Moved):
            turned_deg += event.rotation_imu_deg or 0.0
            read_deg = event.encoder_deg if orientation == "encoder" else turned_deg
            off.append(read_deg - operator.world.table_deg())
    return [float(value) for value in np.array(off) - np.mean(off)]


def run(seed: int, noise: NoiseModel, orientation: str, calibrated: bool, folder: Path) -> Told:
    """Return the figures of one bench and the other: right, unknown and confirmed answers, errors in degrees, views."""
    objects = shelf()
    names = np.random.default_rng(seed).permutation(sorted(objects))[: OBJECTS + UNKNOWN].tolist()
    config = load_config(None, (f"table.orientation={orientation}",))
    told: Told = defaultdict(list)
    for bench_seed in (seed, seed + OTHER_BENCH):
        operator = ShelfOperator(World(noise=noise, seed=bench_seed), objects)
        with open_sim_bench(config, operator) as bench:
            if calibrated:
                calibrated_on(bench, CalibrationStore(folder / f"results {bench_seed}"), told, names[0])
            with Catalog.open(folder / "catalog", clock=bench.clock, create=bench_seed == seed) as catalog:
                if bench_seed == seed:
                    for name in names[:OBJECTS]:
                        told["angle"] += angles_off(enroll(bench, catalog, name, views=VIEWS), operator, orientation)
                    continue
                index = hbr.ViewIndex(catalog.views().views)
            rng = np.random.default_rng(seed)
            for name in names * TRIALS:
                operator.next_object, operator.yaw_deg = name, float(rng.uniform(0, 360))
                try:
                    *_, answer = identify(bench, index, strategy="ahbr", seed=seed)
                except RigError:  # e.g. encoder and gyro that do not agree
                    told["broken off"].append(True)
                    told["right" if name in names[:OBJECTS] else "unknown"].append(False)
                    continue
                assert isinstance(answer, Identified)
                told["views"].append(answer.views)
                if name in names[:OBJECTS]:
                    told["right"].append(answer.name == name)
                    told["lost"].append(answer.name is None)
                    if answer.name == name:
                        told["yaw"].append(abs((answer.yaw_deg - operator.yaw_deg + 180) % 360 - 180))
                else:
                    told["unknown"].append(answer.name is None)
    return told


def rate(values: list[float]) -> str:
    """Return hits of trials with Wilson's interval."""
    hits = int(sum(values))
    low, high = wilson(hits, len(values))
    return f"{hits}/{len(values)} ({100 * low:.0f}–{100 * high:.0f} %)"


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--seeds", type=int, default=3)
    arguments.add_argument("--first-seed", type=int, default=0)
    arguments.add_argument("--level", choices=LEVELS, action="append")
    arguments.add_argument("--orientation", choices=("encoder", "imu"), action="append")
    given = arguments.parse_args()
    print(
        "| errors | angle by | bench | right | unknown recognized | known unknown | pose within 15° | RMSE "
        "| table's angle, RMS | views |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for level in given.level or LEVELS:
        for orientation in given.orientation or ("encoder", "imu"):
            for calibrated in (False, True):
                told: Told = defaultdict(list)
                for seed in range(given.first_seed, given.first_seed + given.seeds):
                    with TemporaryDirectory() as folder:
                        for key, values in run(seed, LEVELS[level], orientation, calibrated, Path(folder)).items():
                            told[key] += values
                near = [error <= 360 / VIEWS for error in told["yaw"]]
                rms, off = (np.sqrt((np.array(v) ** 2).mean()) for v in (np.array(told["yaw"])[near], told["angle"]))
                print(
                    f"| {level} | {orientation} | {'calibrated' if calibrated else 'as it is'} | {rate(told['right'])} "
                    f"| {rate(told['unknown'])} | {rate(told['lost'])} | {rate(near)} "
                    f"| {rms:.1f} ° | {off:.2f} ° | {np.mean(told['views']):.2f} |",
                    flush=True,
                )
                for key, values in told.items():
                    if key.startswith(("refused ", "broken off")) and any(values):
                        print(f"| {level} | {key} | {sum(values):.0f}/{len(values)} | | | | | | | |")


if __name__ == "__main__":
    main()
