"""CPU time to segment and describe a view, in one thread.

First one view as it is enrolled, with all of its steps: the object is found, cut out and normalised, and both
descriptors are computed. Peer: OpenCV's resize of the same frame to 80 x 80. With the empty-table image, and without it
by a guess.

Then a view of a search, 320 x 240, compared with a view that is guessed and described. Without an
empty-table image each view of a search also improves the earlier ones, which are segmented again.
"""

from collections.abc import Callable
from dataclasses import replace
from time import process_time, thread_time

import cv2
import numpy as np

from benchmarks.record import record, times_ms
from hbr import Background, Segmentation, ViewsTogether, descriptor, segment
from hbr.core.arrays import ImageArray
from hbr.drawing.bench import HARD, DrawnBench, Visit
from hbr.segmentation import BoxMethod
from hbr.segmentation.background import SegmentedFrame, shrunk
from hbr.segmentation.silhouette import guess_object, shares

DESCRIPTORS = ("cedd", "edges+colours+cedd")
SEARCHED = ("edges+colours+cedd", "edges+colours+cedd+network")
BENCHES = 6
VIEWS = 4
REPEATS = 3
PEER = "a guess"


def printed_box(visit: Visit, side: int) -> ImageArray:
    """Return a view of a printed box, from one of four sides."""
    photograph = np.zeros((128, 128, 3), np.uint8)
    half = (26, 40, 30, 44)[side]
    photograph[20:110, 64 - half : 64 + half] = (40, 60, 210)
    photograph[30 : 50 + 10 * side, 64 - half : 56 + half] = (230, 220, 60)
    return visit.photograph(photograph, photograph.any(axis=2), 90.0 * side).image


def frames(seed: int) -> tuple[list[ImageArray], ImageArray]:
    """Return views of a printed box on a textured bench, and the empty table."""
    visit = Visit(DrawnBench.drawn(np.random.default_rng(1000 + seed)), HARD, np.random.default_rng(seed))
    return [printed_box(visit, side) for side in range(VIEWS)], visit.empty()


def one_view(size: tuple[int, int]) -> None:
    """Measure one view of this width and height, and its parts."""
    images, empty = frames(0)
    image, table_bgr = (cv2.resize(each, size, interpolation=cv2.INTER_CUBIC) for each in (images[0], empty))
    table = Background(table_bgr)
    kinds = [descriptor(name) for name in DESCRIPTORS]
    small, found = shrunk(image), segment(image, empty_table=table)
    if found.method is not BoxMethod.EMPTY_TABLE:
        raise RuntimeError("the object was not found by the empty-table image")

    def described(view: Segmentation) -> None:
        for each in kinds:
            each.describe(image if each.whole_image else view)

    peer = min(times_ms(lambda: cv2.resize(image, (80, 80), interpolation=cv2.INTER_AREA), 200, thread_time))
    parts: dict[str, tuple[Callable[[], object], int]] = {
        "whole view": (lambda: described(segment(image, empty_table=table)), 200),
        "- shrink the frame": (lambda: shrunk(image), 200),
        "- compare it with the empty table": (lambda: table.difference(small), 200),
        "- find, cut out, correct (with both above)": (lambda: segment(image, empty_table=table), 200),
        "- describe, cedd and edges+colours+cedd": (lambda: described(replace(found)), 200),
        "whole view, guessed": (lambda: described(segment(image)), 30),
        "- guess": (lambda: guess_object(small), 30),
        "network": (lambda: shares(SegmentedFrame(image)), 30),
    }
    for name, (work, repeats) in parts.items():
        record(f"{size[0]}x{size[1]}: {name}", min(times_ms(work, repeats, thread_time)), "cv2.resize to 80 x 80", peer)


def main() -> None:
    cv2.setNumThreads(1)
    for size in ((640, 480), (320, 240)):
        one_view(size)
    for name in SEARCHED:
        if descriptor(name).can_describe:
            views_of_a_search(name)


def views_of_a_search(name: str) -> None:
    """Measure views of searches by this descriptor."""
    kind = descriptor(name)
    times: dict[str, list[float]] = {}

    def timed(what: str, start: float) -> None:
        times.setdefault(what, []).append(1e3 * (process_time() - start))

    for seed in [0, *range(BENCHES)] * REPEATS:
        images, empty = frames(seed)
        for image in images:
            start = process_time()
            kind.describe(segment(image))
            timed(PEER, start)
        table = Background(empty)
        for what, known, revise in (
            ("with the empty-table image", table, True),
            ("no image, at rest", None, True),
            ("no image, in motion", None, False),
        ):
            views = ViewsTogether(name)
            for n, image in enumerate(images):
                start = process_time()
                views.add(image, known, revise=revise)
                timed(what, start)
                if revise and what.startswith("no"):
                    timed(f"no image, view {n + 1}", start)
    peer = float(np.median(times[PEER]))
    record(f"{name}: {PEER}", peer, PEER, peer)
    for what, each in times.items():
        if what != PEER:
            record(
                f"{name}: {what}", float(np.mean(each)) if "view" not in what else float(np.median(each)), PEER, peer
            )


if __name__ == "__main__":
    main()
