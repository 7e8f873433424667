"""Overlap of the boxes and silhouettes of enrolled views and of searches with the true ones.

`python -m benchmarks.boxes DATASET [--masks FOLDER] [--objects 20] [--views 12] [--seed 0]`

Photographed objects stand on drawn benches, whose silhouettes are known: a plain backdrop, or clutter; a plain platter,
or one with marks. With ``--masks`` the photographs themselves are segmented; the folder has a mask of the same name for
each of them. *enrolled*: all views together; *search*: the last of 1, 2 or 4 views, by the likeliest segmentation and
by the best of all.
"""

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.descriptors.together import ViewsTogether
from hbr.drawing.bench import ENROLLMENT, HARD, DrawnBench, DrawnFrame, Visit
from hbr.evaluation.photographs import PhotographedObject, load_coil, object_mask, read_photograph, without_specks
from hbr.segmentation import Segmentation

BENCHES = 6


class Overlap(NamedTuple):
    """Intersection over union of the box, and of the silhouette."""

    box: float
    mask: float


def overlap(found: Segmentation, truth: NDArray[np.bool_]) -> Overlap:
    height, width = truth.shape
    boxes = []
    for box in (found.box or (0, 0, 0, 0), cv2.boundingRect(truth.astype(np.uint8))):
        x, y, w, h = box
        boxes.append(np.zeros(truth.shape, bool))
        boxes[-1][y : y + h, x : x + w] = True
    pairs = (boxes, (found.frame_mask(width, height), truth))
    return Overlap(*(float((a & b).sum() / max(1, (a | b).sum())) for a, b in pairs))


def benches(backdrop: str, platter: str) -> list[DrawnBench]:
    """Return benches with a plain or cluttered backdrop, and a plain or marked platter."""
    made: list[DrawnBench] = []
    for number in range(BENCHES):
        bench = DrawnBench.drawn(np.random.default_rng(number), plain=backdrop == "plain")
        top = np.full_like(bench.top, np.median(bench.top, axis=(0, 1)))
        if platter == "marks":
            rng = np.random.default_rng(100 + number)
            top += cv2.resize(rng.normal(0, 5, (48, 48, 1)).astype(np.float32), (192, 192))[:, :, None]
            for _ in range(6):
                ends = (96 + 96 * rng.uniform(-1, 1, 4)).astype(int).tolist()
                cv2.line(top, tuple(ends[:2]), tuple(ends[2:]), rng.uniform(20, 230, 3).tolist(), 3)
        made.append(replace(bench, top=top))
    return made


def drawn(item: PhotographedObject, visit: Visit, first_deg: float, count: int) -> Iterator[DrawnFrame]:
    for angle_deg in first_deg + np.arange(count) * 360 / count:
        photograph = min(item.photographs, key=lambda one: abs((one.azimuth_deg - angle_deg + 180) % 360 - 180))
        image = read_photograph(photograph.path)
        yield visit.photograph(image, without_specks(object_mask(image)), photograph.azimuth_deg)


def real(item: PhotographedObject, masks: Path, step: int) -> Iterator[DrawnFrame]:
    for photograph in item.photographs[::step]:
        mask = masks / f"{photograph.path.stem}.png"
        if mask.exists():
            image = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)
            assert image is not None
            yield DrawnFrame(read_photograph(photograph.path), image > 127)


def enrolled(frames: Iterable[DrawnFrame], empty: NDArray[np.uint8] | None) -> list[tuple[Overlap, str]]:
    views = ViewsTogether("edges+colours+cedd", several=False)
    truths = []
    for frame in frames:
        views.learn(frame.image, empty)
        truths.append(frame.mask)
    views.revise()
    return [
        (overlap(one[0], truth), one[0].method.value) for one, truth in zip(views.segmentations, truths, strict=True)
    ]


def searched(frames: Iterable[DrawnFrame], empty: NDArray[np.uint8] | None) -> Iterator[tuple[Overlap, Overlap]]:
    """Yield the overlap of the newest view by the first segmentation, and by the best one."""
    views = ViewsTogether("edges+colours+cedd")
    for frame in frames:
        found = [overlap(one, frame.mask) for one in views.add(frame.image, empty)]
        yield found[0], max(found)


def row(name: str, found: list[Overlap]) -> None:
    box, mask = np.array(found).T
    print(
        f"{name:56s} {np.median(box):5.2f} {np.mean(box < 0.8):6.1%} {np.median(mask):5.2f} {np.mean(mask < 0.8):6.1%}",
        flush=True,
    )


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("dataset", type=Path)
    options.add_argument("--masks", type=Path)
    options.add_argument("--objects", type=int, default=20)
    options.add_argument("--views", type=int, default=12)
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args()
    dataset = load_coil(given.dataset)
    things = dataset.objects[:: max(1, len(dataset.objects) // given.objects)][: given.objects]
    print(f"{'':56s} {'box':>5s} {'<0.8':>6s} {'mask':>5s} {'<0.8':>6s}")
    if given.masks:
        report(
            "photographs",
            [(list(real(item, given.masks, 2)), list(real(item, given.masks, 4)), None) for item in things],
        )
        return
    for backdrop in ("plain", "clutter"):
        for platter in ("plain", "marks"):
            where = benches(backdrop, platter)
            rng = np.random.default_rng(given.seed)
            for change, words in ((ENROLLMENT, "same"), (HARD, "hard")):
                scenes = []
                for number, item in enumerate(things):
                    visit = Visit(where[number % BENCHES], change, rng)
                    empty = visit.empty()
                    first_deg = rng.uniform(0, 360)
                    scenes.append(
                        (
                            list(drawn(item, visit, first_deg, given.views)),
                            list(drawn(item, visit, first_deg, 4)),
                            empty,
                        )
                    )
                name = f"{backdrop} backdrop, {platter} platter, {words}"
                report(f"{name}, no image", [(a, b, None) for a, b, _ in scenes])
                report(f"{name}, image", scenes)


def report(name: str, scenes: list[tuple[list[DrawnFrame], list[DrawnFrame], NDArray[np.uint8] | None]]) -> None:
    row(f"{name}: enrolled", [one for many, _, empty in scenes for one, _ in enrolled(many, empty)])
    steps = [list(searched(few, empty)) for _, few, empty in scenes]
    for n in (0, 1, 3):
        some = [one[n] for one in steps if len(one) > n]
        row(f"  search, view {n + 1}: first", [first for first, _ in some])
        row(f"  search, view {n + 1}: best", [best for _, best in some])


if __name__ == "__main__":
    main()
