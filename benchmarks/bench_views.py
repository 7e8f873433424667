"""CPU time to segment and describe a view of a search, compared with one guess of the object; 320 x 240, one thread.

Without an empty-table image each view of a search also improves the earlier ones, which are segmented again.
"""

from time import process_time

import cv2
import numpy as np

from benchmarks.record import record
from hbr import Background, ViewsTogether, descriptor, segment
from hbr.core.arrays import ImageArray
from hbr.evaluation.changed_bench import HARD, Bench, Visit

DESCRIPTOR = "edges+colours"
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
    visit = Visit(Bench.drawn(np.random.default_rng(1000 + seed)), HARD, np.random.default_rng(seed))
    return [printed_box(visit, side) for side in range(VIEWS)], visit.empty()


def main() -> None:
    cv2.setNumThreads(1)
    kind = descriptor(DESCRIPTOR)
    times: dict[str, list[float]] = {}

    def timed(name: str, start: float) -> None:
        times.setdefault(name, []).append(1e3 * (process_time() - start))

    for seed in [0, *range(BENCHES)] * REPEATS:
        images, empty = frames(seed)
        for image in images:
            start = process_time()
            kind.describe(segment(image))
            timed(PEER, start)
        table = Background(empty)
        for name, views, revise in (
            ("with the empty-table image", ViewsTogether(DESCRIPTOR, empty_table=table), True),
            ("no image, at rest", ViewsTogether(DESCRIPTOR), True),
            ("no image, in motion", ViewsTogether(DESCRIPTOR), False),
        ):
            for n, image in enumerate(images):
                start = process_time()
                views.add(image, revise=revise)
                timed(name, start)
                if revise and name.startswith("no"):
                    timed(f"no image, view {n + 1}", start)
    peer = float(np.median(times[PEER]))
    record(PEER, peer, PEER, peer)
    for name, each in times.items():
        if name != PEER:
            record(name, float(np.mean(each)) if "view" not in name else float(np.median(each)), PEER, peer)


if __name__ == "__main__":
    main()
