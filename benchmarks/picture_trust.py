"""Shares of accepted empty-table images: the search's own, one in another light, and one of another bench.

    python -m benchmarks.picture_trust

Drawn benches: with patterns of full contrast and of a third of it, and plain ones.
"""

import numpy as np

from benchmarks.bench_views import printed_box
from hbr import Background
from hbr.core.arrays import ImageArray
from hbr.evaluation.changed_bench import HARD, MILD, Bench, Change, Visit
from hbr.segmentation.background import shrunk

FRAMES = 120
BENCHES = 12
LIMITS = (0.65, 0.75, 0.83)


def agreement(frame: ImageArray, empty: ImageArray) -> float:
    return Background(empty).difference(shrunk(frame)).agreement


def main() -> None:
    print(f"{'trusted, %, if the border agrees by':<48}", *(f"{limit:>6}" for limit in LIMITS))
    for textured in (1.0, 0.35, 0.0):
        benches = [Bench.drawn(np.random.default_rng(3000 + k), textured=textured) for k in range(BENCHES)]

        def visit(bench: int, change: Change, seed: int, benches: list[Bench] = benches) -> Visit:
            return Visit(benches[bench % BENCHES], change, np.random.default_rng(seed))

        found: dict[str, list[float]] = {}
        for k in range(FRAMES):
            here, mild = visit(k, HARD, k), visit(k, MILD, k)
            frame = printed_box(here, k % 4)
            other = k + 1 + (k // BENCHES) % (BENCHES - 1)
            for name, value in (
                ("its own image", agreement(frame, here.empty())),
                (
                    "taken in the light of a mild change",
                    agreement(printed_box(mild, k % 4), visit(k, MILD, 30000 + k).empty()),
                ),
                ("taken in the light of a hard change", agreement(frame, visit(k, HARD, 20000 + k).empty())),
                ("of another bench", agreement(frame, visit(other, HARD, 10000 + k).empty())),
            ):
                found.setdefault(name, []).append(value)
        for name, values in found.items():
            shares = (100 * np.mean(np.array(values) >= limit) for limit in LIMITS)
            print(f"{f'contrast {textured}: {name}':<48}", *(f"{share:6.1f}" for share in shares))


if __name__ == "__main__":
    main()
