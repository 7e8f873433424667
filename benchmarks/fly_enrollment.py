"""Enrollment in motion compared with enrollment at rest, on the simulated bench.

`python -m benchmarks.fly_enrollment [--objects FOLDER] [--limit N] [--views 72] [--seed 0] [--json FILE]`

Each object is enrolled twice at rest and once in motion, each time put on the table again, and finally views at rest
are taken at the angles of the views in motion. It prints bench time, the similarity of views at the same azimuth, the
bias of the stored azimuths, and the hit rate: each view of the second enrollment at rest is searched for alone, among
all objects enrolled at rest and among all enrolled in motion. The camera's time is calibrated first, and 1 % of the
frames are lost.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import hbr
from calibration.procedures import CameraTime
from hbr.core.angles import wrap180
from hbr.evaluation.statistics import mcnemar_exact
from rig import Catalog, enroll
from rig.bench import Bench
from rig.calibrations import CalibrationResult, apply_results
from rig.catalog import derived
from rig.config import load_config
from rig.events.events import Accepted, Enrolled
from rig.motion.turntable import Turntable
from rig.plans.capture import capture
from rig.views.capture import Viewer
from rig.views.description import BENCH_DESCRIPTOR, EnrollmentDescriber
from sim.bench import ShelfOperator, open_sim_bench
from sim.noise import NoiseModel
from sim.objects.photographs import photographs
from sim.objects.shelf import shelf
from sim.world import World

NOISE = NoiseModel()
KINDS = ("rest", "again", "motion")


def calibrated(operator: ShelfOperator, thing: str) -> tuple[Any, CalibrationResult]:
    """Return the configuration with the camera's time, which is calibrated before."""
    config = load_config(None, ())
    with open_sim_bench(config, operator) as bench:
        *_, result = CameraTime(thing).live(bench)
        assert isinstance(result, CalibrationResult)
        assert result.passed, result.rejections
        return apply_results(config, [result])[0], result


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("--objects", type=Path)
    options.add_argument("--limit", type=int, default=100)
    options.add_argument("--views", type=int, default=72)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--json", type=Path)
    given = options.parse_args()
    things = photographs(given.objects) if given.objects else shelf()
    names = list(things)[: given.limit]
    world = World(seed=given.seed, noise=NOISE)
    operator = ShelfOperator(world, things)
    config, result = calibrated(ShelfOperator(world, shelf()), "mug-star")
    print(f"camera time {result.estimates['offset']}", file=sys.stderr)
    seconds: dict[str, list[float]] = {kind: [] for kind in KINDS}
    angle_errors: list[float] = []
    retakes = 0
    views: dict[str, hbr.Views] = {}
    same_angle: list[float] = []
    with TemporaryDirectory() as folder, open_sim_bench(config, operator) as bench:
        for kind in KINDS:
            with Catalog.open(Path(folder) / kind, clock=bench.clock) as catalog:
                for name in names:
                    begun = time.process_time()
                    for event in enroll(bench, catalog, name, views=given.views, fly=kind == "motion"):
                        if isinstance(event, Enrolled):
                            seconds[kind].append(event.seconds)
                            retakes += event.retakes * (kind == "motion")
                        elif isinstance(event, Accepted) and event.evidence.motion is not None:
                            motion = event.evidence.motion
                            if world.clock.now_ns() - motion.middle_ns < 11e9:
                                exposed = event.evidence.exposed_ns - operator.devices.camera.times.offset_ns  # type: ignore[union-attr]
                                box = (event.segmentation or {}).get("box_px")
                                row = 0.5 if box is None else (box[1] + box[3] / 2) / config.camera.height
                                middle = exposed + round(NOISE.camera_readout_ms * 1e6 * row) + 5_000_000
                                angle_errors.append(motion.angle_deg - world.table_deg(middle))
                    print(f"{kind} {name} {time.process_time() - begun:.1f} s of CPU time", file=sys.stderr, flush=True)
                views[kind] = derived.views(catalog, BENCH_DESCRIPTOR)
        for name in names:
            same_angle += similar_at_rest(bench, views["motion"], name)
    report: dict[str, Any] = {"objects": len(names), "views": given.views}
    for kind in KINDS:
        report[f"seconds_{kind}"] = float(np.mean(seconds[kind]))
    report["ratio"] = report["seconds_rest"] / report["seconds_motion"]
    report["taken_again_at_rest"] = retakes
    # A view at rest has the zero of a platter that is driven upwards, which lies half of the backlash below.
    error = np.array(angle_errors) - NOISE.backlash_deg / 2
    report |= {"angle_bias_deg": float(error.mean()), "angle_rms_deg": float(error.std()), "angles": len(error)}
    similar = {kind: similarities(views["rest"], views[kind]) for kind in ("again", "motion")}
    for kind, values in similar.items():
        report[f"similarity_{kind}"] = [float(values.mean()), float(np.percentile(values, 5))]
    report["similarity_motion_same_angle"] = [float(np.mean(same_angle)), float(np.percentile(same_angle, 5))]
    hits = {kind: search(views[kind], views["again"]) for kind in ("rest", "motion")}
    for kind, (hit, pose) in hits.items():
        report[f"hit_rate_{kind}"] = float(hit.mean())
        report[f"pose_bias_{kind}_deg"] = float(np.median(pose[hit]))
        report[f"pose_rms_{kind}_deg"] = float(np.sqrt(np.mean(np.square(pose[hit & (np.abs(pose) < 15)]))))
    first, second = hits["rest"][0], hits["motion"][0]
    only = int((first & ~second).sum()), int((second & ~first).sum())
    report |= {"queries": len(first), "only_rest": only[0], "only_motion": only[1], "mcnemar_p": mcnemar_exact(*only)}
    print(json.dumps(report, indent=2))
    if given.json:
        given.json.write_text(json.dumps(report, indent=2) + "\n")


def similar_at_rest(bench: Bench, moving: hbr.Views, name: str) -> list[float]:
    """Return the similarity of each view in motion of an object to a view that is taken at rest at its angle."""
    rows = moving.of(moving.object_names.index(name))
    angles_deg = -moving.azimuth_deg[rows] % 360
    describe, viewer = EnrollmentDescriber(bench.config.view, (BENCH_DESCRIPTOR,)), Viewer(bench.camera, bench.config)
    similarity = hbr.descriptors.descriptor(moving.descriptor).similarity
    bench.place(name)
    images = []
    with Turntable(bench) as table:
        for number in np.argsort(angles_deg):
            move = table.goto(float(angles_deg[number]))
            image = value_of(capture(0, viewer, table, move.settled_ns)).image_bgr
            images.append((number, describe.learn(image), image))
        table.goto(0.0)
    found = []
    for number, view, image in images:
        levels = describe.describe(view, image).levels[BENCH_DESCRIPTOR]
        found.append(float(similarity(moving.levels(rows[number : number + 1]), levels[None])[0, 0]))
    return found


def value_of(events: Iterator[Any]) -> Any:
    """Run a plan and return its value."""
    while True:
        try:
            next(events)
        except StopIteration as done:
            return done.value


def similarities(one: hbr.Views, other: hbr.Views) -> np.ndarray[Any, Any]:
    """Return the similarity of each view of ``other`` to the views of ``one`` at its azimuth, by interpolation."""
    found = []
    for number, name in enumerate(one.object_names):
        rows, against = one.of(number), other.of(other.object_names.index(name))
        table = hbr.descriptors.descriptor(one.descriptor).similarity(other.levels(against), one.levels(rows))
        for k, azimuth in enumerate(other.azimuth_deg[against].tolist()):
            away = np.abs(wrap180(one.azimuth_deg[rows] - azimuth))
            near = np.argsort(away)[:2]
            weight = 1 - away[near] / away[near].sum()
            found.append(float((table[k, near] * weight).sum()))
    return np.array(found)


def search(enrolled: hbr.Views, queries: hbr.Views) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Search for each view alone; return whether the best object is right, and the error of its azimuth in degrees."""
    index = hbr.DenseIndex(enrolled)
    hit, error = [], []
    for row in range(len(queries)):
        ranking = hbr.update_belief(queries.levels(np.array([row]))[0], 0.0, index).ranking()
        name = queries.object_names[queries.object_index[row]]
        hit.append(enrolled.object_names[int(ranking.object_index[0])] == name)
        error.append(float(wrap180(ranking.pose_deg[0] - queries.azimuth_deg[row])))
    return np.array(hit), np.array(error)


if __name__ == "__main__":
    main()
