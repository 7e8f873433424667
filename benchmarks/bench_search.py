"""Exact Tanimoto search against a plain numpy scan and scipy's KD-tree, and a whole retrieval step."""

import argparse
import statistics
import timeit
from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from hbr import ViewIndex, Views, next_view, retrieve
from hbr.arrays import FloatArray, LevelArray

VIEWS_OF_AN_OBJECT = 72
QUERIES = 12
K = 10


def model(objects: int) -> Views:
    """CEDD-like views: sparse, skewed levels that change slowly around each object."""
    rng = np.random.default_rng(0)
    shape = (objects, 1, 144)
    used = rng.random(shape) < 0.12
    mean = rng.gamma(1.5, 2.0, shape) * used
    phase, swing = rng.uniform(0, 2 * np.pi, shape), rng.uniform(0, 2, shape) * used
    turn = np.linspace(0, 2 * np.pi, VIEWS_OF_AN_OBJECT, endpoint=False)[:, None]
    levels = np.empty((objects, VIEWS_OF_AN_OBJECT, 144), np.uint8)
    for start in range(0, objects, 500):
        part = slice(start, start + 500)
        noise = rng.normal(0, 0.3, levels[part].shape) * used[part]
        levels[part] = np.clip(np.rint(mean[part] + swing[part] * np.sin(turn + phase[part]) + noise), 0, 7)
    return Views(
        levels.reshape(-1, 144),
        np.tile(np.degrees(turn[:, 0]), objects),
        np.repeat(np.arange(objects), VIEWS_OF_AN_OBJECT),
        tuple(f"object {j}" for j in range(objects)),
    )


def milliseconds(function: Callable[[int], object], repeats: int) -> tuple[float, float]:
    """Minimum and median of a call, over different queries."""
    times = [timeit.timeit(lambda i=i: function(i % QUERIES), number=1) for i in range(repeats)]  # type: ignore[misc]
    return min(times) * 1e3, statistics.median(times) * 1e3


def bench(objects: int, repeats: int, with_tree: bool) -> None:
    views = model(objects)
    rng = np.random.default_rng(1)
    rows = rng.integers(len(views), size=QUERIES)
    # the queries are views with some bins off by a level, as noise in the image makes them
    off = (rng.random((QUERIES, 144)) < 0.1) * rng.integers(-1, 2, (QUERIES, 144))
    queries = np.clip(views.descriptors[rows] + off, 0, 7).astype(np.uint8)

    as_float = views.descriptors.astype(np.float32)
    lengths = np.einsum("ij,ij->i", as_float, as_float)

    def scan(i: int) -> object:
        query = queries[i].astype(np.float32)
        dots = as_float @ query
        similarities = dots / (lengths + query @ query - dots)
        best = np.argpartition(-similarities, K)[:K]
        return best[np.argsort(-similarities[best])]

    results = {"numpy float32 product, argpartition": milliseconds(scan, repeats)}
    if with_tree:
        tree = cKDTree(as_float)
        results["scipy cKDTree (Euclidean: not the same)"] = milliseconds(lambda i: tree.query(queries[i], K), repeats)
    flat, bound = ViewIndex(views, "flat"), ViewIndex(views, "bound")
    results["ViewIndex flat"] = milliseconds(lambda i: flat.search(queries[i], K), repeats)
    results["ViewIndex bound"] = milliseconds(lambda i: bound.search(queries[i], K), repeats)
    peer = results["numpy float32 product, argpartition"][1]
    for name, (least, median) in results.items():
        print(f"{len(views):>9} {name:<42} {least:8.3f} {median:9.3f} {median / peer:6.2f}")

    index = ViewIndex(views)
    mine = views.of(objects // 2)[[0, 18, 30, 45, 60, 66, 9, 51]]
    turns_deg = views.azimuth_deg[mine]
    for count in (2, 8):
        seen = views.descriptors[mine[:count]]

        def step(_: int, seen: LevelArray = seen, turned_deg: FloatArray = turns_deg[:count]) -> object:
            return next_view(retrieve(seen, turned_deg, index))

        least, median = milliseconds(step, max(5, repeats // 2))
        print(f"{len(views):>9} {f'retrieve and next_view, {count} queries':<42} {least:8.3f} {median:9.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--million", action="store_true", help="measure 1,000,000 views too (2 GB of memory)")
    print(f"{'views':>9} {'call':<42} {'min ms':>8} {'median ms':>9} {'ratio':>6}")
    bench(100, 200, with_tree=True)
    bench(1_389, 40, with_tree=True)
    if parser.parse_args().million:
        bench(13_889, 20, with_tree=False)


if __name__ == "__main__":
    main()
