"""Computing time of a frame of a search in motion, as a ratio to the frame period of 30 frames/s.

`python -m benchmarks.fly_frames [--objects 100] [--views 72]`

The frames are those of a rotation by 180° on the simulated bench in 640x480, before its plain background and before
that of another bench. The catalog has random descriptions, which a search compares as it does any others. Drawing the
frames is not counted. The median and the 95 % quantile of the CPU time of one thread are given for each step.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

import hbr
from hbr.dense.arc import ArcRule, ArcSession
from hbr.dense.stopping import StoppingRule
from rig.config import load_config
from rig.motion.flight_views import FlightJudge
from rig.motion.turntable import Flight, Turntable
from rig.views.description import BENCH_DESCRIPTOR, SearchDescriber
from rig.views.stream import FrameStream
from sim.bench import ShelfOperator, open_sim_bench
from sim.change import another_bench
from sim.objects.shelf import shelf
from sim.world import World

FPS = 30


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("--objects", type=int, default=100)
    options.add_argument("--views", type=int, default=72)
    given = options.parse_args()
    cv2.setNumThreads(1)
    rng = np.random.default_rng(0)
    index = random_index(rng, given.objects, given.views)
    print(f"| frames of 640x480, {given.objects} objects with {given.views} views | median | 95 % | median / period |")
    print("|---|--:|--:|--:|")
    for background in ("plain", "another bench"):
        for step, spent in measured(index, background).items():
            median, high = np.median(spent) * 1e3, np.percentile(spent, 95) * 1e3
            print(f"| {background}: {step} | {median:.1f} ms | {high:.1f} ms | {median * FPS / 1e3:.2f} |")


def random_index(rng: np.random.Generator, objects: int, views: int) -> hbr.DenseIndex:
    """Return an index of random descriptions."""
    kind = hbr.descriptor(BENCH_DESCRIPTOR)
    levels = rng.integers(0, 4, (objects * views, kind.length), np.uint8)
    azimuth_deg = np.tile(np.arange(views) * 360.0 / views, objects)
    names = tuple(f"object {n}" for n in range(objects))
    return hbr.DenseIndex(hbr.Views(levels, azimuth_deg, np.repeat(np.arange(objects), views), names, BENCH_DESCRIPTOR))


def measured(index: hbr.DenseIndex, background: str) -> dict[str, list[float]]:
    """Return the CPU time of each step for each frame of a turn, in seconds."""
    operator = ShelfOperator(World(seed=2), shelf(), next_object="mug-star")
    config = load_config(None, ("camera_time.offset_ms=1", "camera_time.jitter_ms=0.2"))
    spent: dict[str, list[float]] = defaultdict(list)
    never = StoppingRule(30.0, 2.0, np.zeros((len(index), 4)), (-9.0,) * 4, 0.01, 0.02, 0.0, 0)
    session = ArcSession(index, ArcRule(never, 2.0))
    with open_sim_bench(config, operator) as bench:
        assert operator.devices is not None
        bench.operator.place(None)
        if background != "plain":
            operator.devices.camera.backdrop = another_bench(np.random.default_rng(1))
        describe = SearchDescriber(bench.config.view, BENCH_DESCRIPTOR, revise=False)
        locks = bench.camera.read_locks()
        with Turntable(bench) as table:
            recorder, stream = table.recorder(), FrameStream(bench.camera, bench.clock)
            judge = FlightJudge(config, locks, True, bench.clock.now_ns(), stream.period_s)

            def each() -> None:
                frame = stream.next(table.collect_gyro)
                begun = time.thread_time()
                trajectory = timed(spent["angle"], recorder.fit)
                if trajectory is None:
                    return
                attempt = timed(spent["checks"], lambda: judge.judge(frame, trajectory, irregular=False))
                levels = timed(spent["description"], lambda: describe(frame.image_bgr)).levels[BENCH_DESCRIPTOR]
                motion = attempt.evidence.motion
                assert motion is not None
                timed(spent["search"], lambda: session.add(levels, motion.angle_deg % 360))
                spent["sum"].append(time.thread_time() - begun)

            table.fly(180.0, Flight(each, (0.0, 180.0), recorder, config.table.velocity_dps))
    return spent


def timed(spent: list[float], work: Callable[[], Any]) -> Any:
    """Do some work, and add the CPU time that it took."""
    begun = time.thread_time()
    result = work()
    spent.append(time.thread_time() - begun)
    return result


if __name__ == "__main__":
    main()
