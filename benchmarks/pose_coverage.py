"""Coverage of the pose's uncertainty: shares of true rotations within one and two standard uncertainties.

`python -m benchmarks.pose_coverage FOLDER` searches for objects 51-100 of COIL-100 under Gaussian noise, and for
built-in objects on the simulated bench. An answer with several equivalent poses counts as right if one of them is. The
output is a table in Markdown.
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from hbr import DenseIndex, Views, describe, update_belief
from hbr.core.angles import wrap180
from hbr.core.arrays import FloatArray, LevelArray
from hbr.dense.filter import Belief, Pose, pose
from hbr.evaluation.condition import Condition
from hbr.evaluation.datasets import load_coil, read_photograph
from hbr.evaluation.draws import generator
from hbr.evaluation.noise import Noise
from rig.catalog import Catalog
from rig.config import load_config
from rig.events.events import Identified
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from rig.search.model import load_model
from sim.bench import ShelfOperator, open_sim_bench
from sim.objects.shelf import shelf
from sim.world import World

TRIALS, MOST_VIEWS = 4, 3
SMALL = ("camera.width=320", "camera.height=240", "view.roi=[40, 0, 240, 240]")
OBJECTS = ("mug-white", "mug-star", "teapot", "toy-car", "dice", "radio", "lamp", "vase-blue", "amphora", "tin-tea")

Found = tuple[Pose, float]


def coil(folder: Path, step: int) -> Iterator[Found]:
    """Yield poses and true azimuths of searches among every ``step``-th view of objects 51-100."""
    condition = Condition(descriptor="edges+colours", noise=Noise.parse("gn"))
    for item in load_coil(folder).objects[50:]:
        azimuth_deg = item.azimuth_deg
        kept = np.rint(azimuth_deg / 5).astype(int) % step == 0

        def levels(i: int, enrolled: bool, item=item) -> LevelArray:  # type: ignore[no-untyped-def]
            image = read_photograph(item.photographs[i].path, (128, 128))
            rng = generator(1, item.name, "photograph", i)
            captured = condition.enrolled(image) if enrolled else condition.query(image, rng)
            return describe(captured.image, descriptor=condition.descriptor, empty_table=captured.empty)

        views = np.stack([levels(int(i), True) for i in np.flatnonzero(kept)])
        index = DenseIndex(Views.of_object(item.name, views, azimuth_deg[kept], condition.descriptor))
        rng = generator(1, item.name, "trial", 0)
        for _ in range(TRIALS):
            belief: DenseIndex | Belief = index
            for i in rng.choice(np.flatnonzero(~kept), MOST_VIEWS, replace=False).tolist():
                belief = update_belief(levels(i, False), float(azimuth_deg[i]), belief)
                yield pose(belief, 0), float(azimuth_deg[i])


def built_in(views: int) -> Iterator[Found]:
    """Yield the rotations of objects on the simulated bench, and the true ones."""
    operator = ShelfOperator(World(seed=1), shelf())
    rng = np.random.default_rng(3)
    with (
        TemporaryDirectory() as folder,
        open_sim_bench(load_config(None, SMALL), operator) as bench,
        Catalog.open(Path(folder), clock=bench.clock) as catalog,
    ):
        for name in OBJECTS:
            list(enroll(bench, catalog, name, views=views))
        model = load_model(catalog)
        for name in OBJECTS * TRIALS:
            operator.next_object, operator.yaw_deg = name, float(rng.uniform(0, 360))
            *_, answer = identify(bench, model)
            assert isinstance(answer, Identified)
            if answer.name == name:
                yield Pose(answer.yaw_set_deg, answer.yaw_sigma_deg, answer.period_deg), operator.yaw_deg


def row(name: str, found: list[Found]) -> None:
    """Print the coverage of determined poses, and the number of poses that are not unique."""
    kinds = Counter(
        "unique" if one.period_deg == 360 else "free" if one.period_deg == 0 else "n-fold" if one.period_deg else "none"
        for one, _ in found
    )
    known = [(one, true_deg) for one, true_deg in found if one.sigma_deg is not None]
    sigma = np.array([one.sigma_deg for one, _ in known])
    error: FloatArray = np.array([min(abs(wrap180(a - true_deg)) for a in one.azimuth_deg) for one, true_deg in known])
    print(
        f"| {name} | {len(found)} | {kinds['unique']} | {kinds['n-fold']} | {kinds['free']} | {kinds['none']} "
        f"| {np.median(sigma):.1f}° "
        f"| {100 * np.mean(error <= sigma):.0f} % | {100 * np.mean(error <= 2 * sigma):.0f} % |",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="COIL-100.")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    print("| objects | answers | unique | n-fold | free | not determined | median σ | within σ | within 2 σ |")
    print("|---|--:|--:|--:|--:|--:|--:|--:|--:|")
    for step in (4, 6, 9):
        row(f"COIL-100, 51–100, {72 // step} views enrolled", list(coil(given.folder, step)))
    row("built-in, 12 views enrolled", list(built_in(12)))


if __name__ == "__main__":
    main()
