"""Hit rate, time and bytes of SIFT with ratio test and geometric check, compared with a small descriptor; one view."""

import argparse
from pathlib import Path
from time import process_time

import cv2
import numpy as np

from hbr import descriptor
from hbr.core.arrays import FloatArray, ImageArray
from hbr.evaluation.condition import Condition
from hbr.evaluation.datasets import Dataset, load_coil, read_photograph
from hbr.evaluation.draws import generator
from hbr.evaluation.noise import Noise
from hbr.evaluation.protocol import views_enrolled
from hbr.evaluation.statistics import wilson

RATIO = 0.8
MIN_MATCHES = 4
ERROR_PX = 4.0

Features = tuple[FloatArray, FloatArray]


def features(sift: cv2.SIFT, image: ImageArray) -> Features:
    """Return positions and descriptors of keypoints in an image of twice the size: at 128 pixels SIFT finds few."""
    large = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    points, found = sift.detectAndCompute(large, None)
    return np.array([point.pt for point in points]).reshape(-1, 2), np.zeros((0, 128)) if found is None else found


def inliers(matcher: cv2.BFMatcher, query: Features, enrolled: Features) -> int:
    """Return the number of matches that pass the ratio test and agree with one similarity transform."""
    if min(len(query[0]), len(enrolled[0])) < MIN_MATCHES:
        return 0
    pairs = matcher.knnMatch(query[1], enrolled[1], k=2)
    good = [first for first, second in pairs if first.distance < RATIO * second.distance]
    if len(good) < MIN_MATCHES:
        return len(good)
    here, there = query[0][[m.queryIdx for m in good]], enrolled[0][[m.trainIdx for m in good]]
    _, kept = cv2.estimateAffinePartial2D(here, there, method=cv2.RANSAC, ransacReprojThreshold=ERROR_PX)
    return MIN_MATCHES + int(kept.sum()) if kept is not None else MIN_MATCHES


def chosen(
    dataset: Dataset, views: int, queries: int, seed: int
) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Return object and photograph of every enrolled view, and of every query."""
    enrolled, asked = [], []
    for j, item in enumerate(dataset.objects):
        kept = views_enrolled(item.azimuth_deg, views)
        enrolled += [(j, int(i)) for i in np.flatnonzero(kept)]
        rng = generator(seed, item.name, "trial", 0)
        asked += [(j, int(i)) for i in rng.choice(np.flatnonzero(~kept), queries, replace=False)]
    return enrolled, asked


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("../shared/data/coil-100"))
    parser.add_argument("--objects", default="51-100")
    parser.add_argument("--enrolled", type=int, default=18)
    parser.add_argument("--queries", type=int, default=2, help="of each object")
    given = parser.parse_args()
    if not given.folder.is_dir():
        print(f"Not measured: the comparison with SIFT needs photographs, and {given.folder} does not exist.")
        return
    cv2.setNumThreads(1)
    first, last = map(int, given.objects.split("-"))
    dataset = load_coil(given.folder).subset(first, last)
    size = read_photograph(dataset.objects[0].photographs[0].path).shape[1::-1]
    enrolled, asked = chosen(dataset, given.enrolled, given.queries, 0)
    sift, matcher, own = cv2.SIFT_create(), cv2.BFMatcher(cv2.NORM_L2), descriptor("edges+colours")

    def photograph(j: int, i: int) -> ImageArray:
        return read_photograph(dataset.objects[j].photographs[i].path, size)

    known = [features(sift, photograph(j, i)) for j, i in enrolled]
    levels = np.stack([own.describe(photograph(j, i)) for j, i in enrolled])
    compared = own.prepared(levels)
    labels = np.array([j for j, _ in enrolled])
    stored = np.mean([places.shape[0] * (128 + 8) for places, _ in known])
    print(
        f"{len(dataset.objects)} objects, {given.enrolled} views each, {len(asked)} queries; processor time per query"
    )
    print(f"{'noise':<6} {'method':<16} {'hit rate, % [95 %]':>22} {'bytes a view':>13} {'ms a query':>11}")
    for noise in ("none", "gn", "mb"):
        condition = Condition(noise=Noise.parse(noise))
        hits, times = np.zeros(2, int), np.zeros(2)
        for j, i in asked:
            image = condition.query(photograph(j, i), generator(0, dataset.objects[j].name, "photograph", i)).image
            cv2.setRNGSeed(0)
            start_s = process_time()
            query = features(sift, image)
            counts = [inliers(matcher, query, one) for one in known]
            between = process_time()
            similar = compared.similarity(own.describe(image)[None])[0]
            times += between - start_s, process_time() - between
            hits += labels[int(np.argmax(counts))] == j, labels[int(similar.argmax())] == j
        for name, hit, total, size_bytes in zip(
            ("SIFT", own.name), hits.tolist(), times.tolist(), (stored, own.size_bytes), strict=True
        ):
            low, high = wilson(hit, len(asked))
            rate = f"{100 * hit / len(asked):.1f} [{100 * low:.1f}, {100 * high:.1f}]"
            print(f"{noise:<6} {name:<16} {rate:>22} {size_bytes:>13.0f} {1e3 * total / len(asked):>11.1f}", flush=True)


if __name__ == "__main__":
    main()
