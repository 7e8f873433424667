"""Time of a step of each search, compared with AHBR, and of every descriptor, compared with plain CEDD.

Times are processor times, minimum and median. Ratios are ratios of minima, because other programs disturb the caches.
"""

import argparse
import statistics
from functools import partial
from time import process_time

import cv2
import numpy as np

from benchmarks.bench_search import model, queries_of
from benchmarks.record import times_ms
from hbr import (
    Background,
    DenseIndex,
    ViewIndex,
    Views,
    descriptor,
    next_best_view,
    next_view,
    retrieve,
    segment,
    update_belief,
)
from hbr.core.arrays import ImageArray, IndexArray
from hbr.dense.filter import Belief
from hbr.descriptors import names
from hbr.drawing.bench import ENROLLMENT, DrawnBench, Visit
from hbr.paper.hmm import PoseBelief, PoseModel, update_poses

#: The views of a search, as positions on an object's ring of 72.
SEEN = (0, 18, 30, 45, 60, 66, 9, 51)
REPEATS = 40


def row(size: object, call: str, took_ms: list[float], peer_ms: list[float]) -> None:
    low, middle = min(took_ms), statistics.median(took_ms)
    print(f"{size:>7} {call:<58} {low:8.3f} {middle:10.3f} {low / min(peer_ms):6.2f}")


def of_kind(views: Views, kind: str) -> Views:
    """Return the same objects with another descriptor, whose levels change slowly around each object."""
    if kind == views.descriptor:
        return views
    rng = np.random.default_rng(5)
    mix = rng.normal(0, 0.1, (views.descriptors.shape[1], descriptor(kind).length))
    levels = (views.descriptors @ mix > 0).astype(np.uint8)
    return Views(levels, views.azimuth_deg, views.object_index, views.object_names, kind)


def bench_step(objects: int) -> None:
    """Measure the 2nd and the 8th step of a search; lists and beliefs of the views before are known."""
    cedd = model(objects)
    chosen = np.random.default_rng(3).integers(objects, size=REPEATS)
    index = ViewIndex(cedd)
    kinds = {kind: of_kind(cedd, kind) for kind in ("cedd", "edges+colours+cedd")}
    indices = {kind: DenseIndex(views) for kind, views in kinds.items()}
    # On a bench, no two objects have the same azimuths, so that each has a transition of its own.
    apart_deg = np.random.default_rng(4).uniform(0, 1, len(cedd))
    poses = PoseModel(Views(cedd.descriptors, cedd.azimuth_deg + apart_deg, cedd.object_index, cedd.object_names))
    for n in (2, 8):
        ahbr: list[float] = []
        hmm: list[float] = []
        dense: dict[str, list[float]] = {kind: [] for kind in kinds}
        for j in chosen.tolist():
            rows = cedd.of(j)[list(SEEN[:n])]
            queries, angles = queries_of(cedd, rows, j), cedd.azimuth_deg[rows]
            index._remembered.clear()
            retrieve(queries[:-1], angles[:-1], index)
            step = partial(lambda q, a: next_view(retrieve(q, a, index)), queries, angles)
            ahbr += times_ms(step, 1, process_time, first=False)
            hmm.append(_hmm_step_ms(poses, rows))
            for kind, views in kinds.items():
                dense[kind].append(_step_ms(views, indices[kind], views.of(j)[list(SEEN[:n])]))
        row(len(cedd), f"AHBR, step {n} (= 1)", ahbr, ahbr)
        row(len(cedd), f"hidden Markov model and view of least risk, step {n}", hmm, ahbr)
        for kind, took in dense.items():
            row(len(cedd), f"dense filter and next best view by {kind}, step {n}", took, ahbr)


def _step_ms(views: Views, index: DenseIndex, rows: IndexArray) -> float:
    so_far: DenseIndex | Belief = index
    for i in rows[:-1].tolist():
        so_far = update_belief(views.descriptors[i], float(views.azimuth_deg[i]), so_far)
    last, angle_deg = views.descriptors[rows[-1]], float(views.azimuth_deg[rows[-1]])
    (took_ms,) = times_ms(lambda: next_best_view(update_belief(last, angle_deg, so_far)), 1, process_time, first=False)
    return took_ms


def _hmm_step_ms(model: PoseModel, rows: IndexArray) -> float:
    def after(row: int, so_far: PoseModel | PoseBelief) -> PoseBelief:
        similar = model.compared.similarity(model.views.descriptors[row][None])[0]
        return update_poses(similar, float(model.views.azimuth_deg[row]), so_far)

    so_far: PoseModel | PoseBelief = model
    for row in rows[:-1].tolist():
        so_far = after(row, so_far)
    (took_ms,) = times_ms(lambda: after(rows[-1], so_far).next_view(), 1, process_time, first=False)
    return took_ms


def bench_describe(name: str, frame: ImageArray, empty: ImageArray | None) -> None:
    """Measure the segmentation, and each descriptor of the object."""
    background = None if empty is None else Background(empty)
    plain = times_ms(lambda: descriptor("cedd").describe(frame), REPEATS, process_time)
    row(name, "cedd of the whole frame (= 1)", plain, plain)
    found = times_ms(lambda: segment(frame, empty_table=background), REPEATS, process_time)
    row(name, "segmentation", found, plain)
    seen = segment(frame, empty_table=background)

    def describe(kind: str) -> object:
        # each call has to compute these again
        seen.__dict__.pop("alone", None)
        assert seen.frame is not None
        seen.frame.described.clear()
        return descriptor(kind).describe(seen)

    for kind in [name for name in names()[1:] if descriptor(name).can_describe]:
        took = times_ms(partial(describe, kind), REPEATS, process_time)
        row(name, f"{kind} of the object, {descriptor(kind).size_bytes} bytes", took, plain)


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    cv2.setNumThreads(1)
    print(f"{'views':>7} {'call':<58} {'min ms':>8} {'median ms':>10} {'ratio':>6}")
    for objects in (100, 1_000):
        bench_step(objects)
    table = Visit(DrawnBench.drawn(np.random.default_rng(0), plain=True), ENROLLMENT, np.random.default_rng(0)).empty()
    rng = np.random.default_rng(1)
    scene = table.copy()
    scene[60:190, 120:200] = cv2.resize(rng.integers(0, 256, (6, 4, 3), np.uint8), (80, 130))
    print(f"{'frame':>7} {'call':<58} {'min ms':>8} {'median ms':>10} {'ratio':>6}")
    for width in (320, 640):
        size = width, width * 3 // 4
        bench_describe(f"{width}", *(cv2.resize(image, size).astype(np.uint8) for image in (scene, table)))
    black = np.full((128, 128, 3), 20, np.uint8)
    black[10:118, 30:98] = cv2.resize(scene[60:190, 120:200], (68, 108))
    bench_describe("128", black, None)


if __name__ == "__main__":
    main()
