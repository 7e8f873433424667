"""Steps of the default search against the reading of the packed descriptors, from 7,200 to 720,000 views.

Times are minima, because other programs disturb the memory. `benchmarks.bench_catalog` measures from the start of the
program on.
"""

import argparse

import numpy as np

from benchmarks.record import record, times_ms
from hbr import DenseIndex, DenseSession, PackedViews
from hbr.core.arrays import LevelArray
from hbr.descriptors import descriptor
from hbr.kernels import without_library

KIND = "edges+colours+cedd"
VIEWS_OF_AN_OBJECT = 72
REPEATS = 25


def packed_views(objects: int) -> LevelArray:
    """Return packed views of objects: levels as frequent as in photographs, which change slowly with the azimuth."""
    rng = np.random.default_rng(0)
    packed = np.empty((objects, VIEWS_OF_AN_OBJECT, descriptor(KIND).size_bytes), np.uint8)
    for start in range(0, objects, 100):
        some = min(100, objects - start)
        bits = rng.random((2, some, 1, 512)) < 0.25
        textures = rng.integers(1, 8, (2, some, 1, 144)) * (rng.random((2, some, 1, 144)) < 0.15)
        azimuth = np.arange(VIEWS_OF_AN_OBJECT)[None, :, None] / VIEWS_OF_AN_OBJECT
        edges, cedd = (
            np.where((azimuth - rng.random((some, 1, one.shape[2]))) % 1.0 < 0.4, other, one)
            for one, other in (bits, textures)
        )
        colours = 128 + rng.normal(0, 15, (some, 1, 32)) + rng.normal(0, 3, (some, VIEWS_OF_AN_OBJECT, 32))
        levels = np.concatenate([edges, np.clip(np.rint(colours), 0, 255), cedd], axis=2).astype(np.uint8)
        rows = descriptor(KIND).pack_rows(levels.reshape(-1, levels.shape[2]))
        packed[start : start + some] = rows.reshape(some, VIEWS_OF_AN_OBJECT, -1)
    return packed.reshape(-1, packed.shape[2])


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
    words = packed.ravel().view(np.uint64)
    peer = "reading the packed views"
    read_ms = min(times_ms(words.max, REPEATS))
    first, second = views.levels(np.array([100, 118]))
    index = DenseIndex(views)

    def steps(number: int) -> object:
        """Take the first views of a search, each with its decision and the choice of the next view."""
        session = DenseSession(index)
        for levels, orientation_deg in ((first, 0.0), (second, 90.0))[:number]:
            session.add(levels, orientation_deg)
            session.next_best_view()
        return session

    name = f"{len(views):,} views"
    record(f"{name}: reading", read_ms, peer, read_ms)
    record(f"{name}: preparing the index", min(times_ms(lambda: DenseIndex(views), 3)), peer, read_ms)
    one_ms, both_ms = (min(times_ms(lambda n=n: steps(n), REPEATS)) for n in (1, 2))  # type: ignore[misc]
    record(f"{name}: first step with decision and next view", one_ms, peer, read_ms)
    record(f"{name}: later step with decision and next view", both_ms - one_ms, peer, read_ms)
    if objects <= 1_000:
        with without_library():
            index = DenseIndex(views)
            numpy_ms = min(times_ms(lambda: steps(2), 3))
        record(f"{name}: two steps, compiled", both_ms, "the same in NumPy", numpy_ms)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", type=int, nargs="+", default=[100, 1_000, 10_000])
    for objects in parser.parse_args().objects:
        bench(objects)


if __name__ == "__main__":
    main()
