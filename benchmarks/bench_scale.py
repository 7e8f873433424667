"""Steps of the default search against the reading of the packed descriptors, from 7,200 to 720,000 views.

Times are minima, because other programs disturb the memory. `benchmarks.bench_catalog` measures from the start of the
program on.
"""

import argparse
import timeit
from collections.abc import Callable

import numpy as np

from benchmarks.record import record
from hbr import DenseIndex, PackedViews, StoppingRule, next_best_view, update_belief
from hbr.core.arrays import LevelArray
from hbr.dense.filter import BETA, completed
from hbr.descriptors import descriptor
from hbr.kernels import without_library

KIND = "edges+colours"
VIEWS_OF_AN_OBJECT = 72
REPEATS = 25


def packed_views(objects: int) -> LevelArray:
    """Return packed views of objects: levels as frequent as in photographs, which change slowly with the azimuth."""
    rng = np.random.default_rng(0)
    packed = np.empty((objects, VIEWS_OF_AN_OBJECT, descriptor(KIND).size_bytes), np.uint8)
    for start in range(0, objects, 100):
        some = min(100, objects - start)
        edges, other = (rng.choice(4, (some, 1, 512), p=(0.45, 0.3, 0.17, 0.08)) for _ in range(2))
        azimuth = np.arange(VIEWS_OF_AN_OBJECT)[None, :, None] / VIEWS_OF_AN_OBJECT
        seen = np.where((azimuth - rng.random((some, 1, 512))) % 1.0 < 0.4, other, edges)
        colours = 128 + rng.normal(0, 15, (some, 1, 32)) + rng.normal(0, 3, (some, VIEWS_OF_AN_OBJECT, 32))
        levels = np.concatenate([seen, np.clip(np.rint(colours), 0, 255)], axis=2).astype(np.uint8)
        rows = descriptor(KIND).pack_rows(levels.reshape(-1, 544))
        packed[start : start + some] = rows.reshape(some, VIEWS_OF_AN_OBJECT, -1)
    return packed.reshape(-1, packed.shape[2])


def milliseconds(function: Callable[[], object], repeats: int = REPEATS) -> float:
    function()
    return min(timeit.repeat(function, number=1, repeat=repeats)) * 1e3


def bench(objects: int) -> None:
    """Measure the steps of a search among this number of objects."""
    packed = packed_views(objects)
    views = PackedViews(
        packed,
        np.tile(np.arange(VIEWS_OF_AN_OBJECT) * 5.0, objects),
        np.repeat(np.arange(objects), VIEWS_OF_AN_OBJECT),
        tuple(f"object {j}" for j in range(objects)),
        KIND,
    )
    words = packed.view(np.uint64)
    peer = "reading the packed views"
    read_ms = milliseconds(words.max)
    first, second = views.levels(np.array([100, 118]))
    index = DenseIndex(views)
    rule = StoppingRule(BETA, 0.9, np.full((objects, 4), 0.9), (0.1,) * 4, 0.01, 0.02, 0.0, 1)
    one = update_belief(first, 0.0, index)
    two = update_belief(second, 90.0, one)
    kept = len(one.index)

    def step(levels: LevelArray, orientation_deg: float, so_far: object) -> object:
        belief = update_belief(levels, orientation_deg, so_far)  # type: ignore[arg-type]
        rule.decide(belief)
        return next_best_view(belief)

    name = f"{len(views):,} views"
    record(f"{name}: reading", read_ms, peer, read_ms)
    record(f"{name}: preparing the index", milliseconds(lambda: DenseIndex(views), 3), peer, read_ms)
    record(
        f"{name}: belief after the first view", milliseconds(lambda: update_belief(first, 0.0, index)), peer, read_ms
    )
    record(
        f"{name}: first step with decision and next view", milliseconds(lambda: step(first, 0.0, index)), peer, read_ms
    )
    record(
        f"{name}: later step with decision and next view", milliseconds(lambda: step(second, 90.0, one)), peer, read_ms
    )
    if kept < objects:
        check_ms = milliseconds(lambda: completed(two, index), 5)
        record(f"{name}: last check of the objects left out, two views", check_ms, peer, read_ms)
    if objects <= 1_000:
        with without_library():
            plain = DenseIndex(views)
            numpy_ms = milliseconds(lambda: step(second, 90.0, update_belief(first, 0.0, plain, kept=kept)), 3)
        both_ms = milliseconds(lambda: step(second, 90.0, update_belief(first, 0.0, index)))
        record(f"{name}: two steps, compiled", both_ms, "the same in NumPy", numpy_ms)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", type=int, nargs="+", default=[100, 1_000, 10_000])
    for objects in parser.parse_args().objects:
        bench(objects)


if __name__ == "__main__":
    main()
