"""Fit the projection of the learned descriptor, and write ``hbr/descriptors/network.npz``.

    python -m benchmarks.fit_projection --data ../shared/data/coil-100

Objects 1-50 of COIL-100 are seen from 20 sides each: on drawn benches after mild and hard changes, with noise and
motion blur, 10° and 20° beside, and before black. Differences between these views of one object are what a search must
ignore. The projection whitens them (linear discriminant analysis), and keeps the 256 directions in which the objects
and their sides differ most. It takes five minutes on an idle core. The benches are others than those of `rig eval`.
"""

import argparse
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from hbr.descriptors import network
from hbr.drawing.bench import HARD, MILD, DrawnBench, Visit
from hbr.drawing.noise import Noise
from hbr.evaluation.changes import cut_out, nearest_photographs
from hbr.evaluation.photographs import PhotographedObject, load_coil

_BENCHES: Final = [DrawnBench.drawn(np.random.default_rng(5000 + k)) for k in range(16)]
_AZIMUTHS: Final = 20
_NOISE, _BLUR = Noise.parse("gn:0.012"), Noise.parse("mb:15")
#: Pairs of views whose difference is to be ignored, by kind, and how much each kind counts.
_KINDS: Final = (
    (1.0, (("bench", "noisy"), ("bench", "blurred"), ("black", "black-noisy"), ("black", "black-blurred"))),
    (1.0, (("bench", "hard"), ("hard", "other-hard"), ("bench", "other-hard"))),
    (1.0, (("bench", "black"), ("hard", "black"))),
    (4.0, (("bench", "beside"), ("black", "black-beside"))),
)
#: Share of the mean variance of the differences that is added to all of their variances.
_SHRINKAGE: Final = 1.0


def views(item: PhotographedObject, number: int) -> list[dict[str, NDArray[np.float32]]]:
    """Return the features of one object: for each azimuth those of each kind of view."""
    rng = np.random.default_rng([78, number])
    found = []
    for place in nearest_photographs(item, rng.uniform(0, 36) + np.arange(_AZIMUTHS) * 360 / _AZIMUTHS):
        azimuth_deg = item.photographs[place].azimuth_deg
        beside, farther = nearest_photographs(item, azimuth_deg + np.array([10.0, -20.0]))
        visit = Visit(_BENCHES[int(rng.integers(16))], MILD, rng)
        hard = [Visit(_BENCHES[int(rng.integers(16))], HARD, rng) for _ in range(2)]
        photo = cut_out(item, place)
        large = cv2.resize(photo[0], (240, 240)).astype(np.uint8)
        bench = visit.photograph(*photo, azimuth_deg).image
        images = {
            "bench": bench,
            "noisy": _NOISE.apply(bench, rng),
            "blurred": _BLUR.apply(bench, rng),
            "hard": hard[0].photograph(*photo, azimuth_deg).image,
            "other-hard": hard[1].photograph(*photo, azimuth_deg).image,
            "beside": visit.photograph(*cut_out(item, beside), item.photographs[beside].azimuth_deg).image,
            "black": photo[0],
            "black-noisy": _NOISE.apply(large, rng),
            "black-blurred": _BLUR.apply(large, rng),
            "black-beside": cut_out(item, farther)[0],
        }
        found.append({kind: network.features(image) for kind, image in images.items()})
    return found


def fitted(groups: list[dict[str, NDArray[np.float32]]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the matrix, (1792, 256), and the mean that is subtracted before."""
    every = np.stack([np.stack(list(group.values())) for group in groups])
    mean = every.mean(axis=(0, 1), dtype=np.float64)
    apart = every.mean(axis=1) - mean
    between = apart.T @ apart / len(apart)
    within = np.zeros_like(between)
    for weight, pairs in _KINDS:
        differences = np.concatenate([[group[a] - group[b] for group in groups] for a, b in pairs])
        within += weight * (differences.T @ differences).astype(np.float64) / len(differences) / 2
    size = len(within)
    spread, axes = np.linalg.eigh(within + _SHRINKAGE * np.trace(within) / size * np.eye(size))
    whitening = axes / np.sqrt(spread)
    _, axes = np.linalg.eigh(whitening.T @ between @ whitening)
    return whitening @ axes[:, ::-1][:, : network.LENGTH], mean


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of COIL-100")
    cv2.setNumThreads(1)
    objects = load_coil(parser.parse_args().data).subset(1, 50).objects
    matrix, mean = fitted([group for number, item in enumerate(objects) for group in views(item, number)])
    step = np.abs(matrix).max(axis=0) / 127
    np.savez_compressed(
        Path(network.__file__).with_name(network.PROJECTION),
        matrix=np.rint(matrix / step).astype(np.int8),
        step=step.astype(np.float32),
        mean=mean.astype(np.float32),
    )


if __name__ == "__main__":
    main()
