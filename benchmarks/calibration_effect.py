"""Effect of calibration: the same objects are identified on the same benches, with and without calibration.

`python -m benchmarks.calibration_effect [--seeds 3] [--first-seed 0] [--level usual] [--orientation encoder]` enrolls
objects on a simulated bench and identifies them on another one: the same bench with a moved camera, another servo and
another IMU. Either both are uncalibrated, or both were calibrated by `backlash`, `encoder`, `motion_model`,
`gyro_scale`, `camera_model`, `table_axis` and `repeatability`. Worlds, objects and angles are the same. The levels of
error are those of a carefully built bench, of a usual one and of a poor one, all within the datasheets of the parts.
The angle of a view is that of the encoder, or only that of the gyro.

The output is a table in Markdown. It has the rates of correct answers, of "unknown" for unknown objects and of
"unknown" for enrolled objects, with Wilson's 95 % intervals; the rate of poses that are correct within one step of the
enrolled views (which fails for objects that look the same from several sides), with their error; and the error of the
angles of the views.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from calibration.procedures import Backlash, CameraModel, Encoder, GyroScale, MotionModel, Repeatability, TableAxis
from hbr.evaluation.statistics import wilson
from rig.bench import Bench, calibrate
from rig.calibrations import CalibrationResult, CalibrationStore
from rig.catalog import Catalog, derived
from rig.config import load_config
from rig.core.errors import RigError
from rig.events.events import Identified, Moved
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from rig.search.model import model_of
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
STATES = "uncalibrated", "calibrated"
OTHER_BENCH = 1000
"""Difference between the seeds of the bench for identification and of the bench for enrollment."""

Figures = dict[str, list[float]]


def calibrated_on(bench: Bench, store: CalibrationStore, figures: Figures, name: str) -> None:
    """Calibrate the bench, and put the results that pass in force."""
    found: dict[str, CalibrationResult] = {}
    procedures = (
        Backlash(),
        Encoder(),
        MotionModel(),
        GyroScale(),
        CameraModel(),
        TableAxis(),
        Repeatability(name),
    )
    for procedure in procedures:
        *_, result = procedure.live(bench, *(found[required] for required in procedure.requires))
        assert isinstance(result, CalibrationResult)
        found[result.name] = result
        store.add(result)
        figures[f"rejected {result.name}"].append(not result.passed)
        calibrate(bench, store)


def angle_errors(events: Iterator[Any], operator: ShelfOperator, orientation: str) -> list[float]:
    """Run an enrollment and return the errors of the angles of its views, without their mean."""
    errors = []
    rotated_deg = 0.0
    for event in events:
        if isinstance(event, Moved):
            rotated_deg += event.rotation_imu_deg or 0.0
            read_deg = event.encoder_deg if orientation == "encoder" else rotated_deg
            errors.append(read_deg - operator.world.table_deg())
    return [float(value) for value in np.array(errors) - np.mean(errors)]


def run(seed: int, noise: NoiseModel, orientation: str, calibrated: bool, folder: Path) -> Figures:
    """Return the figures of both benches: correct and unknown answers, errors in degrees, numbers of views."""
    objects = shelf()
    names = np.random.default_rng(seed).permutation(sorted(objects))[: OBJECTS + UNKNOWN].tolist()
    config = load_config(None, (f"table.orientation={orientation}",))
    figures: Figures = defaultdict(list)
    for bench_seed in (seed, seed + OTHER_BENCH):
        operator = ShelfOperator(World(noise=noise, seed=bench_seed), objects)
        with open_sim_bench(config, operator) as bench:
            if calibrated:
                calibrated_on(bench, CalibrationStore(folder / f"results {bench_seed}"), figures, names[0])
            with Catalog.open(folder / "catalog", clock=bench.clock, create=bench_seed == seed) as catalog:
                if bench_seed == seed:
                    for name in names[:OBJECTS]:
                        figures["angle"] += angle_errors(
                            enroll(bench, catalog, name, views=VIEWS), operator, orientation
                        )
                    continue
                index = model_of(derived.views(catalog))
            rng = np.random.default_rng(seed)
            for name in names * TRIALS:
                operator.next_object, operator.yaw_deg = name, float(rng.uniform(0, 360))
                try:
                    *_, answer = identify(bench, index, strategy="ahbr", seed=seed)
                except RigError:  # for example, encoder and gyro disagree
                    figures["stopped"].append(True)
                    figures["right" if name in names[:OBJECTS] else "unknown"].append(False)
                    continue
                assert isinstance(answer, Identified)
                figures["views"].append(answer.views)
                if name in names[:OBJECTS]:
                    figures["right"].append(answer.name == name)
                    figures["lost"].append(answer.name is None)
                    if answer.name == name and answer.yaw_set_deg:
                        figures["yaw"].append(abs((answer.yaw_set_deg[0] - operator.yaw_deg + 180) % 360 - 180))
                else:
                    figures["unknown"].append(answer.name is None)
    return figures


def rate(values: list[float]) -> str:
    """Return the rate of hits with Wilson's interval."""
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
        "| errors | angle by | bench | correct | unknown recognised | enrolled unknown | pose within 15° | RMSE "
        "| table angle, RMS | views |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for level in given.level or LEVELS:
        for orientation in given.orientation or ("encoder", "imu"):
            for calibrated in (False, True):
                figures: Figures = defaultdict(list)
                for seed in range(given.first_seed, given.first_seed + given.seeds):
                    with TemporaryDirectory() as folder:
                        for key, values in run(seed, LEVELS[level], orientation, calibrated, Path(folder)).items():
                            figures[key] += values
                near = [error <= 360 / VIEWS for error in figures["yaw"]]
                rms, off = (
                    np.sqrt((np.array(v) ** 2).mean()) for v in (np.array(figures["yaw"])[near], figures["angle"])
                )
                print(
                    f"| {level} | {orientation} | {STATES[calibrated]} | {rate(figures['right'])} "
                    f"| {rate(figures['unknown'])} | {rate(figures['lost'])} | {rate(near)} "
                    f"| {rms:.1f} ° | {off:.2f} ° | {np.mean(figures['views']):.2f} |",
                    flush=True,
                )
                for key, values in figures.items():
                    if key.startswith(("rejected ", "stopped")) and any(values):
                        print(f"| {level} | {key} | {sum(values):.0f}/{len(values)} | | | | | | | |")


if __name__ == "__main__":
    main()
