"""A step of the dense filter against one of AHBR, and every descriptor against plain CEDD, each in the same run.

Times are the processor's: what else the machine does hardly matters.
"""

import argparse
import statistics
import timeit
from collections.abc import Callable
from time import process_time

import cv2
import numpy as np

from benchmarks.bench_search import model, queries_of
from hbr import Background, DenseIndex, ViewIndex, Views, believe, descriptor, next_look, next_view, retrieve, sight
from hbr.arrays import ImageArray, IndexArray
from hbr.dense import Belief
from hbr.descriptors import names
from hbr.evaluation.scenes import plain_bench

#: The views that a search has seen, as places on an object's ring of 72.
SEEN = (0, 18, 30, 45, 60, 66, 9, 51)
REPEATS = 40


def milliseconds(function: Callable[[int], object], repeats: int) -> float:
    """Median of a call."""
    function(0)
    return (
        statistics.median(timeit.timeit(lambda i=i: function(i), timer=process_time, number=1) for i in range(repeats))
        * 1e3
    )  # type: ignore[misc]


def of_kind(views: Views, kind: str) -> Views:
    """The same objects by another descriptor: levels that change slowly around each."""
    if kind == views.descriptor:
        return views
    rng = np.random.default_rng(5)
    mix = rng.normal(0, 0.1, (views.descriptors.shape[1], descriptor(kind).length))
    levels = np.clip(np.rint(views.descriptors @ mix + 1), 0, 3).astype(np.uint8)
    return Views(levels, views.azimuth_deg, views.object_index, views.object_names, kind)


def bench_step(objects: int) -> None:
    """The 2nd and the 8th step of a search, lists and beliefs of the views before known."""
    cedd = model(objects)
    chosen = np.random.default_rng(3).integers(objects, size=REPEATS)
    index = ViewIndex(cedd)
    for n in (2, 8):
        ahbr = []
        for j in chosen.tolist():
            rows = cedd.of(j)[list(SEEN[:n])]
            queries, angles = queries_of(cedd, rows, j), cedd.azimuth_deg[rows]
            index._remembered.clear()
            retrieve(queries[:-1], angles[:-1], index)
            ahbr.append(
                timeit.timeit(
                    lambda q=queries, a=angles: next_view(retrieve(q, a, index)), timer=process_time, number=1
                )
            )  # type: ignore[misc]
        peer = statistics.median(ahbr) * 1e3
        print(f"{len(cedd):>7} {f'AHBR, step {n} (= 1)':<58} {peer:8.3f} {1:6.2f}")
        for kind in ("cedd", "edges+colours"):
            views = of_kind(cedd, kind)
            dense = DenseIndex(views)
            took = statistics.median(_step_s(views, dense, views.of(j)[list(SEEN[:n])]) for j in chosen.tolist()) * 1e3
            print(
                f"{len(cedd):>7} {f'dense filter and next look by {kind}, step {n}':<58} {took:8.3f} {took / peer:6.2f}"
            )


def _step_s(views: Views, index: DenseIndex, rows: IndexArray) -> float:
    so_far: DenseIndex | Belief = index
    for i in rows[:-1].tolist():
        so_far = believe(views.descriptors[i], float(views.azimuth_deg[i]), so_far)
    last, angle_deg = views.descriptors[rows[-1]], float(views.azimuth_deg[rows[-1]])
    return timeit.timeit(lambda: next_look(believe(last, angle_deg, so_far)), timer=process_time, number=1)


def bench_describe(name: str, frame: ImageArray, empty: ImageArray | None) -> None:
    """Finding the object, and each descriptor of it."""
    background = None if empty is None else Background(empty)
    plain = milliseconds(lambda _: descriptor("cedd").describe(frame), REPEATS)
    print(f"{name:>7} {'cedd of the whole frame (= 1)':<58} {plain:8.3f} {1:6.2f}")
    found = milliseconds(lambda _: sight(frame, reference=background), REPEATS)
    print(f"{name:>7} {'find the object and its light':<58} {found:8.3f} {found / plain:6.2f}")
    seen = sight(frame, reference=background)

    def describe(kind: str) -> object:
        seen.__dict__.pop("alone", None)  # each has to make it anew
        return descriptor(kind).describe(seen)

    for kind in names()[1:]:
        took = milliseconds(lambda _, kind=kind: describe(kind), REPEATS)  # type: ignore[misc]
        size = f"{descriptor(kind).size_bytes} bytes"
        print(f"{name:>7} {f'{kind} of the object, {size}':<58} {took:8.3f} {took / plain:6.2f}")


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    cv2.setNumThreads(1)
    print(f"{'views':>7} {'call':<58} {'median ms':>8} {'ratio':>6}")
    for objects in (100, 1_000):
        bench_step(objects)
    table = np.clip(plain_bench(np.random.default_rng(0)), 0, 255).astype(np.uint8)
    rng = np.random.default_rng(1)
    thing = table.copy()
    thing[60:190, 120:200] = cv2.resize(rng.integers(0, 256, (6, 4, 3), np.uint8), (80, 130))
    print(f"{'frame':>7} {'call':<58} {'median ms':>8} {'ratio':>6}")
    for width in (320, 640):
        size = width, width * 3 // 4
        bench_describe(f"{width}", *(cv2.resize(picture, size).astype(np.uint8) for picture in (thing, table)))
    black = np.full((128, 128, 3), 20, np.uint8)
    black[10:118, 30:98] = cv2.resize(thing[60:190, 120:200], (68, 108))
    bench_describe("128", black, None)


if __name__ == "__main__":
    main()
