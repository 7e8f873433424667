"""Frame rate of the simulated camera with noise, for each object, on one core.

Run: OPENBLAS_NUM_THREADS=1 python benchmarks/bench_render.py
"""

import timeit

import cv2
import numpy as np

from sim.camera import SimCapture
from sim.objects.shelf import shelf
from sim.world import World

REPEATS, FRAMES = 5, 8


def best_ms(capture: SimCapture) -> float:
    """Return the time of one frame in milliseconds: the minimum, because other programs disturb the measurement."""
    return min(timeit.repeat(capture.read, number=FRAMES, repeat=REPEATS)) / FRAMES * 1e3


def main() -> None:
    cv2.setNumThreads(1)
    world = World(seed=1)
    capture = SimCapture(world)
    capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1)
    capture.set(cv2.CAP_PROP_AUTO_WB, 0)
    print(f"{'empty platter':18s} {best_ms(capture):6.2f} ms")
    times = []
    for name, item in shelf().items():
        world.put(item, 33.0, (1.2, -0.7))
        first = timeit.timeit(capture.read, number=1) * 1e3
        times.append(best_ms(capture))
        print(f"{name:18s} {times[-1]:6.2f} ms {1000 / times[-1]:6.0f} frames/s, the first frame {first:.0f} ms")
    print(f"{'mean':18s} {np.mean(times):6.2f} ms {1000 / np.mean(times):6.0f} frames/s, slowest {max(times):.2f} ms")


if __name__ == "__main__":
    main()
