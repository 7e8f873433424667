"""Time of the exact Tanimoto search and of a retrieval step, compared with one float32 product of a query."""

import argparse
import statistics
import timeit
from collections.abc import Callable, Sequence
from itertools import count

import numpy as np

from benchmarks.record import times_ms
from hbr import ViewIndex, Views, next_view, retrieve
from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.paper.index import Method

VIEWS_OF_AN_OBJECT = 72
QUERIES = 12
K = 10


def model(objects: int) -> Views:
    """Return views like those of CEDD: sparse, skewed levels that change slowly around each object."""
    rng = np.random.default_rng(0)
    shape = (objects, 1, 144)
    used = rng.random(shape) < 0.12
    mean = rng.gamma(1.5, 2.0, shape) * used
    phase, swing = rng.uniform(0, 2 * np.pi, shape), rng.uniform(0, 2, shape) * used
    rotation = np.linspace(0, 2 * np.pi, VIEWS_OF_AN_OBJECT, endpoint=False)[:, None]
    levels = np.empty((objects, VIEWS_OF_AN_OBJECT, 144), np.uint8)
    for start in range(0, objects, 500):
        part = slice(start, start + 500)
        noise = rng.normal(0, 0.3, levels[part].shape) * used[part]
        levels[part] = np.clip(np.rint(mean[part] + swing[part] * np.sin(rotation + phase[part]) + noise), 0, 7)
    return Views(
        levels.reshape(-1, 144),
        np.tile(np.degrees(rotation[:, 0]), objects),
        np.repeat(np.arange(objects), VIEWS_OF_AN_OBJECT),
        tuple(f"object {j}" for j in range(objects)),
    )


def queries_of(views: Views, rows: IndexArray, seed: int) -> LevelArray:
    """Return views with some bins changed by one level, like image noise does."""
    rng = np.random.default_rng(seed)
    shape = (len(rows), 144)
    off = (rng.random(shape) < 0.1) * rng.integers(-1, 2, shape)
    return np.clip(views.descriptors[rows] + off, 0, 7).astype(np.uint8)


def milliseconds(function: Callable[[int], object], repeats: int) -> float:
    """Return the median time of a call, over different arguments."""
    number = count()
    return statistics.median(times_ms(lambda: function(next(number)), repeats))


def product_ms(views: Views, queries: LevelArray, repeats: int) -> tuple[float, float]:
    """Return the time of one float32 product of a query with all views, alone and with the selection of the best."""
    as_float = views.descriptors.astype(np.float32)
    lengths = np.einsum("ij,ij->i", as_float, as_float)
    as_queries = queries.astype(np.float32)

    def scan(i: int) -> object:
        query = as_queries[i % QUERIES]
        dots = as_float @ query
        similarities = dots / (lengths + query @ query - dots)
        best = np.argpartition(-similarities, K)[:K]
        return best[np.argsort(-similarities[best])]

    return milliseconds(lambda i: as_float @ as_queries[i % QUERIES], repeats), milliseconds(scan, repeats)


def bench_search(views: Views, methods: Sequence[Method], repeats: int) -> None:
    """Measure search and construction with every method."""
    queries = queries_of(views, np.random.default_rng(1).integers(len(views), size=QUERIES), 2)
    alone, scanned = product_ms(views, queries, repeats)
    print(f"{len(views):>9} {'numpy float32 product alone':<44} {alone:9.3f} {alone / scanned:6.2f}")
    print(f"{len(views):>9} {'numpy float32 product, argpartition (= 1)':<44} {scanned:9.3f} {1:6.2f}")
    for method in methods:
        begun = timeit.default_timer()
        index = ViewIndex(views, method)
        index.search(views.descriptors[0], K)  # builds it
        build_s = timeit.default_timer() - begun

        def search(i: int, index: ViewIndex = index) -> object:
            index._remembered.clear()
            return index.search(queries[i % QUERIES], K)

        took = milliseconds(search, repeats)
        print(
            f"{len(views):>9} {f'ViewIndex {method}, built in {build_s:.1f} s':<44} {took:9.3f} {took / scanned:6.2f}"
        )


def step_ms(views: Views, index: ViewIndex, repeats: int) -> tuple[float, float]:
    """Return the median time of a step with 8 queries: after the 7 steps before it, and without known lists."""
    rng = np.random.default_rng(3)
    after, at_once = [], []
    for j in rng.integers(len(views.object_names), size=repeats).tolist():
        rows = views.of(j)[[0, 18, 30, 45, 60, 66, 9, 51]]
        seen, angles_deg = queries_of(views, rows, j), views.azimuth_deg[rows]

        def step(seen: LevelArray = seen, angles_deg: FloatArray = angles_deg) -> object:
            return next_view(retrieve(seen, angles_deg, index))

        index._remembered.clear()
        at_once += times_ms(step, 1, first=False)
        index._remembered.clear()
        retrieve(seen[:-1], angles_deg[:-1], index)
        after += times_ms(step, 1, first=False)
    return statistics.median(after), statistics.median(at_once)


def bench_step(views: Views, repeats: int) -> None:
    """Measure one step of an active search, compared with one product."""
    alone, _ = product_ms(views, queries_of(views, np.arange(QUERIES), 2), repeats)
    steps = zip(("the 8th step", "8 queries at once"), step_ms(views, ViewIndex(views), repeats), strict=True)
    for name, took in steps:
        print(f"{len(views):>9} {f'retrieve, next_view: {name} (product = 1)':<44} {took:9.3f} {took / alone:6.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tree", action="store_true", help="Also measure the KD-tree with 720,000 views.")
    tree = parser.parse_args().tree
    print(f"{'views':>9} {'call':<44} {'median ms':>9} {'ratio':>6}")
    every: tuple[Method, ...] = ("flat", "tree")
    for objects, repeats in ((100, 200), (1_389, 60), (10_000, 30)):
        views = model(objects)
        bench_search(views, every if objects < 10_000 or tree else every[:1], repeats)
        bench_step(views, repeats)


if __name__ == "__main__":
    main()
