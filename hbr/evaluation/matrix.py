"""Hit rates of the dense filter under each perturbation alone, at three strengths."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap180
from hbr.core.arrays import LevelArray
from hbr.dense.filter import Belief, update_belief
from hbr.dense.index import DenseIndex
from hbr.descriptors.registry import describe
from hbr.evaluation.condition import Condition
from hbr.evaluation.datasets import Dataset, read_photograph
from hbr.evaluation.draws import generator
from hbr.evaluation.noise import Noise
from hbr.evaluation.perturb import STRENGTHS, Perturbations
from hbr.evaluation.protocol import Protocol, views_enrolled
from hbr.model.views import Views

#: Step between the queries of a trial.
_STEP_DEG: Final = 90.0
_NOISES: Final[Mapping[str, tuple[str, str, str]]] = {
    "gn": ("gn:0.004", "gn:0.012", "gn:0.03"),
    "mb": ("mb:8", "mb:15", "mb:25"),
}
_BACKGROUNDS: Final = ("bench", "textured", "other-bench")


@dataclass(frozen=True)
class Cell:
    """A perturbation, its strength (0: no perturbation), and the resulting condition."""

    kind: str
    strength: int
    condition: Condition


def cells(base: Condition) -> tuple[Cell, ...]:
    """Return `base` without a perturbation, and with each perturbation at each strength.

    The three strengths of the background are: a bench with an empty-table image, a pattern without one, and another
    bench than at enrollment. A shadow needs a bench.
    """
    found = [Cell("none", 0, base)]
    for i in range(3):
        found += [Cell(kind, i + 1, replace(base, noise=Noise.parse(texts[i]))) for kind, texts in _NOISES.items()]
        for kind in STRENGTHS:
            background = "bench" if kind == "shadow" else base.background
            one = replace(base, perturbations=Perturbations(((kind, i + 1),)), background=background)
            found.append(Cell(kind, i + 1, one))
        found.append(Cell("background", i + 1, replace(base, background=_BACKGROUNDS[i])))
    order = {kind: place for place, kind in enumerate(("none", *_NOISES, *STRENGTHS, "background"))}
    return tuple(sorted(found, key=lambda cell: (order[cell.kind], cell.strength)))


def enrolled_few(dataset: Dataset, j: int, condition: Condition, size: tuple[int, int], count: int) -> Views:
    """Return `count` enrolled views of object `j` at equal distances.

    Raises
    ------
    DatasetError
        A photograph cannot be used, or does not have the width and height `size`.
    """
    item = dataset.objects[j]
    kept = np.flatnonzero(views_enrolled(item.azimuth_deg, count))
    images = [
        condition.enrolled(read_photograph(item.photographs[i].path, size), generator(0, item.name, "enrolled", i))
        for i in kept.tolist()
    ]
    levels = np.stack([describe(image, descriptor=condition.descriptor, empty_table=empty) for image, empty in images])
    return Views.of_object(item.name, levels, item.azimuth_deg[kept], condition.descriptor)


def hits(
    dataset: Dataset, j: int, index: DenseIndex, condition: Condition, size: tuple[int, int], protocol: Protocol
) -> NDArray[np.bool_]:
    """Return whether object `j` was found, by trial and number of views, bool (trials, views).

    The first views and the orientation errors of a trial are the same under all conditions.

    Raises
    ------
    DatasetError, ValueError
        A photograph cannot be used, or too few photographs are not enrolled.
    """
    item = dataset.objects[j]
    azimuth_deg = item.azimuth_deg
    free = np.flatnonzero(~views_enrolled(azimuth_deg, protocol.enrolled or len(azimuth_deg)))
    if len(free) < protocol.max_views:
        raise ValueError(
            f"{item.name} has {len(free)} views that are not enrolled; for {protocol.max_views} queries enroll fewer"
        )
    own = index.views.object_names.index(item.name)
    described: dict[int, LevelArray] = {}
    found = np.zeros((protocol.trials, protocol.max_views), np.bool_)
    for t in range(protocol.trials):
        rng = generator(protocol.seed, item.name, "trial", t)
        seen = [int(rng.choice(free))]
        error_deg = rng.normal(0, protocol.sigma_deg, protocol.max_views)
        so_far: DenseIndex | Belief = index
        for n in range(protocol.max_views):
            i = seen[-1]
            if i not in described:
                image, empty = condition.query(
                    read_photograph(item.photographs[i].path, size),
                    generator(protocol.seed, item.name, "photograph", i),
                )
                described[i] = describe(image, descriptor=condition.descriptor, empty_table=empty)
            so_far = belief = update_belief(described[i], float(azimuth_deg[i] + error_deg[n]), so_far)
            found[t, n] = belief.ranking().object_index[0] == own
            away_deg = np.abs(wrap180(azimuth_deg[free] - azimuth_deg[i] - _STEP_DEG))
            away_deg[np.isin(free, seen)] = np.inf
            seen.append(int(free[away_deg.argmin()]))
    return found
