"""Computing time of a frame of a search in motion, as a ratio to the frame period of 30 frames/s.

`python -m benchmarks.fly_frames [--objects 100] [--views 72]`

The frames are those of a rotation by 180° on the simulated bench in 640x480, before its plain background and before
that of another bench. The catalog has random descriptions, which a search compares as it does any others. Drawing the
frames is not counted. The median and the 95 % quantile of the CPU time of one thread are given for each step.

Then the same frames are fed in real time at 30 frames/s for ten seconds (``--seconds``), and those are counted that
the search drops because it is too slow. The result is valid only on an idle computer; the load is printed.
"""

import argparse
import os
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

import hbr
from hbr.dense.arc import ArcSession
from hbr.dense.stopping import StoppingRule
from rig.config import RigConfig, load_config
from rig.core.clock import SystemClock
from rig.devices.camera import Frame
from rig.motion.flight_views import FlightFrames
from rig.motion.turntable import Turntable
from rig.views.description import BENCH_DESCRIPTOR, SearchDescriber
from rig.views.stream import FrameStream
from sim.bench import ShelfOperator, open_sim_bench
from sim.change import another_bench
from sim.objects.projection import Image
from sim.objects.shelf import shelf
from sim.world import World

FPS = 30
Work = Callable[[Frame], None]


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("--objects", type=int, default=100)
    options.add_argument("--views", type=int, default=72)
    options.add_argument("--seconds", type=float, default=10.0)
    given = options.parse_args()
    cv2.setNumThreads(1)
    rng = np.random.default_rng(0)
    index = random_index(rng, given.objects, given.views)
    print(f"| frames of 640x480, {given.objects} objects with {given.views} views | median | 95 % | median / period |")
    print("|---|--:|--:|--:|")
    counted = []
    for background in ("plain", "another bench"):
        steps, images, begin = measured(index, background)
        for step, spent in steps.items():
            median, high = np.median(spent) * 1e3, np.percentile(spent, 95) * 1e3
            print(f"| {background}: {step} | {median:.1f} ms | {high:.1f} ms | {median * FPS / 1e3:.2f} |")
        counted.append((background, *fed(images, begin, given.seconds)))
    print()
    for background, used, dropped in counted:
        print(f"{background}: {dropped} of {used + dropped} frames dropped at {FPS} frames/s")
    print(f"load of the computer {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


def random_index(rng: np.random.Generator, objects: int, views: int) -> hbr.DenseIndex:
    """Return an index of random descriptions."""
    kind = hbr.descriptor(BENCH_DESCRIPTOR)
    levels = rng.integers(0, 4, (objects * views, kind.length), np.uint8)
    azimuth_deg = np.tile(np.arange(views) * 360.0 / views, objects)
    names = tuple(f"object {n}" for n in range(objects))
    return hbr.DenseIndex(hbr.Views(levels, azimuth_deg, np.repeat(np.arange(objects), views), names, BENCH_DESCRIPTOR))


def measured(index: hbr.DenseIndex, background: str) -> tuple[dict[str, list[float]], list[Image], Callable[[], Work]]:
    """Return the CPU time of each step for each frame in seconds, the images, and a function that begins a search."""
    operator = ShelfOperator(World(seed=2), shelf(), next_object="mug-star")
    config = load_config(None, ("camera_time.offset_ms=1", "camera_time.jitter_ms=0.2"))
    spent: dict[str, list[float]] = defaultdict(list)
    images: list[Image] = []
    with open_sim_bench(config, operator) as bench:
        assert operator.devices is not None
        bench.place(None)
        if background != "plain":
            operator.devices.camera.backdrop = another_bench(np.random.default_rng(1))
        locks = bench.camera.read_locks()
        with Turntable(bench) as table:
            frames = FlightFrames(bench, table)

            def begin() -> Work:
                describe, session = begun(index, config)
                return lambda frame: work(frame, describe, session)

            def work(frame: Frame, describe: SearchDescriber, session: ArcSession) -> None:
                started = time.thread_time()
                trajectory = timed(spent["angle"], frames.recorder.fit)
                if trajectory is None:
                    return
                checked = partial(frames.attempt, frame, trajectory, locks)
                attempt = timed(spent["checks"], checked)
                levels = timed(spent["description"], lambda: describe(frame.image_bgr)).levels[BENCH_DESCRIPTOR]
                motion = attempt.evidence.motion
                assert motion is not None
                timed(spent["search"], lambda: session.add(levels, motion.angle_deg % 360))
                spent["sum"].append(time.thread_time() - started)

            use = begin()

            def take(frame: Frame) -> None:
                images.append(frame.image_bgr)
                use(frame)

            table.fly(180.0, frames.flight(take, (0.0, 180.0), config.table.velocity_dps))
    return {step: list(times) for step, times in spent.items()}, images, begin


def begun(index: hbr.DenseIndex, config: RigConfig) -> tuple[SearchDescriber, ArcSession]:
    """Return a search that never ends."""
    never = StoppingRule(30.0, 2.0, np.zeros((len(index), 4)), (-9.0,) * 4, 0.01, 0.02, 0.0, 0)
    return SearchDescriber(config.view, BENCH_DESCRIPTOR, revise=False), ArcSession(index, never, 2.0)


class PlayedCamera:
    """A camera that delivers JPEG images in real time and decodes them, in a loop."""

    def __init__(self, images: list[Image], clock: SystemClock) -> None:
        self.identity = SimpleNamespace(fps=float(FPS))
        self._images = [cv2.imencode(".jpg", image)[1] for image in images]
        self._clock = clock
        self._begun_ns = clock.now_ns()

    def capture(self, after_ns: int, _meanwhile: Callable[[], object] | None = None) -> Frame:
        """Return the first frame after a time, or wait for it."""
        number = max(-(-(after_ns - self._begun_ns) * FPS // 1_000_000_000), 0)
        stamp_ns = self._begun_ns + number * 1_000_000_000 // FPS
        self._clock.sleep((stamp_ns - self._clock.now_ns()) * 1e-9)
        image = cv2.imdecode(self._images[number % len(self._images)], cv2.IMREAD_COLOR)
        assert image is not None
        return Frame(np.asarray(image, np.uint8), stamp_ns)


def fed(images: list[Image], begin: Callable[[], Work], seconds: float) -> tuple[int, int]:
    """Search repeatedly in real time; return the numbers of used and of dropped frames."""
    clock = SystemClock()
    stream = FrameStream(PlayedCamera(images, clock), clock)  # type: ignore[arg-type]
    used, until_ns = 0, clock.now_ns() + round(seconds * 1e9)
    while clock.now_ns() < until_ns:
        work = begin()
        for _ in images:
            frame = stream.next(lambda: None, newest=True)
            assert frame is not None
            work(frame)
        used += len(images)
    return used, stream.skipped


def timed(spent: list[float], work: Callable[[], Any]) -> Any:
    """Call a function, and add the CPU time that it took."""
    begun = time.thread_time()
    result = work()
    spent.append(time.thread_time() - begun)
    return result


if __name__ == "__main__":
    main()
