"""Hit rates with the empty-table image of the query bench, with that of the enrollment, and without an image.

    python -m benchmarks.bench_segmentation FOLDER --objects 1-50

Objects are enrolled on a plain bench with its empty-table image, by 18 views. The dense filter identifies them by four
views 90° apart: on the same bench in another illumination, and on another bench with all perturbations.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time

import cv2
import numpy as np

from hbr import DenseIndex, Views
from hbr.core.arrays import ImageArray
from hbr.evaluation.condition import Condition, EvaluationImage
from hbr.evaluation.datasets import load_coil, read_photograph
from hbr.evaluation.matrix import enrolled_few, hits
from hbr.evaluation.perturb import Perturbations
from hbr.evaluation.protocol import Protocol

OTHER_ILLUMINATION = "gain:2+white-balance:2+gradient:2+shift:2+scale:1+shadow:1"
EVERYTHING = (
    "shift:3+scale:3+elevation:2+occlusion:2+shadow:2+specular:2+gain:2+white-balance:3+gradient:2+gamma:2+defocus:2"
)


@dataclass(frozen=True)
class TableCondition(Condition):
    """A condition with one of three empty-table images for the queries.

    Attributes
    ----------
    shown : {"own", "enrollment", "none"}
        The image of the query bench in the query's illumination, that of the enrollment bench, or none.
    """

    shown: str = "own"

    def query(self, image_bgr: ImageArray, rng: np.random.Generator) -> EvaluationImage:
        image, own = super().query(image_bgr, rng)
        if self.shown == "none":
            return EvaluationImage(image)
        return EvaluationImage(image, own if self.shown == "own" else self.enrolled(image_bgr).empty)


def cases(descriptor: str) -> Iterator[tuple[str, TableCondition]]:
    """Yield benches and empty-table images by name."""
    for bench, condition in (
        (
            "other illumination",
            TableCondition(background="bench", perturbations=Perturbations.parse(OTHER_ILLUMINATION)),
        ),
        ("another bench", TableCondition(background="other-bench", perturbations=Perturbations.parse(EVERYTHING))),
    ):
        for shown in ("own", "enrollment", "none"):
            yield f"{bench}, {shown}", replace(condition, descriptor=descriptor, shown=shown)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("../shared/data/coil-100"), help="Photographs.")
    parser.add_argument("--objects", default="1-50", metavar="FIRST-LAST")
    parser.add_argument("--trials", type=int, default=6)
    parser.add_argument("--descriptor", default="edges+colours")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    first, last = (int(number) for number in arguments.objects.split("-"))
    if not arguments.folder.is_dir():
        print(f"Not measured: the segmentation needs photographs, and {arguments.folder} does not exist.")
        return
    dataset = load_coil(arguments.folder).subset(first, last)
    size = read_photograph(dataset.objects[0].photographs[0].path).shape[1::-1]
    protocol = Protocol(trials=arguments.trials, max_views=4, enrolled=18)
    numbers = range(len(dataset.objects))
    plain = Condition(background="bench", descriptor=arguments.descriptor)
    index = DenseIndex(Views.concatenate([enrolled_few(dataset, j, plain, size, 18) for j in numbers]))
    print(f"{'hit rate, %, at N =':<28}     1     2     3     4  s CPU")
    for name, condition in cases(arguments.descriptor):
        start_s = process_time()
        found = np.concatenate([hits(dataset, j, index, condition, size, protocol) for j in numbers])
        rates = " ".join(f"{rate:5.1f}" for rate in 100 * found.mean(axis=0))
        print(f"{name:<28} {rates} {process_time() - start_s:6.0f}", flush=True)


if __name__ == "__main__":
    main()
