"""Hit rates of the dense filter under each perturbation alone, at three strengths."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from hbr.core.angles import wrap180
from hbr.core.arrays import BoolArray, LevelArray
from hbr.dense.filter import Belief, update_belief
from hbr.dense.index import DenseIndex
from hbr.descriptors.registry import describe
from hbr.drawing.noise import Noise
from hbr.evaluation.condition import Condition, enrolled_levels
from hbr.evaluation.experiment import Experiment, Kind
from hbr.evaluation.perturb import STRENGTHS, Perturbations
from hbr.evaluation.photographs import Dataset
from hbr.evaluation.protocol import Protocol, generator, views_enrolled
from hbr.evaluation.statistics import wilson
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


def enrolled_few(dataset: Dataset, j: int, condition: Condition, count: int) -> Views:
    """Return `count` enrolled views of object `j` at equal distances."""
    item = dataset.objects[j]
    kept = np.flatnonzero(views_enrolled(item.azimuth_deg, count))
    levels = enrolled_levels(dataset, j, condition, kept.tolist())
    return Views.of_object(item.name, levels, item.azimuth_deg[kept], condition.descriptor)


def hits(dataset: Dataset, j: int, index: DenseIndex, condition: Condition, protocol: Protocol) -> BoolArray:
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
                rng_of_view = generator(protocol.seed, item.name, "photograph", i)
                image, empty = condition.query(dataset.image(j, i), rng_of_view)
                described[i] = describe(image, descriptor=condition.descriptor, empty_table=empty)
            so_far = belief = update_belief(described[i], float(azimuth_deg[i] + error_deg[n]), so_far)
            found[t, n] = belief.ranking().object_index[0] == own
            away_deg = np.abs(wrap180(azimuth_deg[free] - azimuth_deg[i] - _STEP_DEG))
            away_deg[np.isin(free, seen)] = np.inf
            seen.append(int(free[away_deg.argmin()]))
    return found


def _enroll(experiment: Experiment, dataset: Dataset, j: int) -> dict[bool, Views]:
    """Return the enrolled views with and without a drawn bench, as the cells need them."""
    base, count = experiment.condition, experiment.protocol.enrolled or 0
    kinds = sorted({cell.condition.on_bench for cell in cells(base)})
    return {on: enrolled_few(dataset, j, replace(base, background="bench" if on else "same"), count) for on in kinds}


def _model(_experiment: Experiment, _dataset: Dataset, enrolled: list[dict[bool, Views]]) -> dict[bool, Views]:
    return {on_bench: Views.concatenate([own[on_bench] for own in enrolled]) for on_bench in enrolled[0]}


def _search(
    experiment: Experiment, dataset: Dataset, model: dict[bool, Views], _now_ns: Callable[[], int], j: int
) -> BoolArray:
    index = {on_bench: DenseIndex(views) for on_bench, views in model.items()}
    conditions = [cell.condition for cell in cells(experiment.condition)]
    return np.stack([hits(dataset, j, index[one.on_bench], one, experiment.protocol) for one in conditions])


def _results(experiment: Experiment, dataset: Dataset, _model: object, found: list[BoolArray]) -> dict[str, Any]:
    together = np.stack(found)  # objects, cells, trials, views
    rows = []
    for c, cell in enumerate(cells(experiment.condition)):
        trials = together[:, c].reshape(-1, together.shape[-1])
        for n, count in enumerate(trials.sum(axis=0).tolist()):
            low, high = wilson(count, len(trials))
            rate = count / len(trials)
            rows.append(
                {"kind": cell.kind, "strength": cell.strength, "views": n + 1, "trials": len(trials)}
                | {"hit_rate": rate, "hit_rate_low": low, "hit_rate_high": high}
            )
    return {"settings": experiment.settings(dataset), "rows": rows}


MATRIX: Final = Kind(_enroll, _model, _search, _results)
