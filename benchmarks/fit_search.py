"""Fits what the search knows before an object is enrolled: ``prior.npz`` and ``evidence.json`` in hbr/dense.

`python -m benchmarks.fit_search DATASET [--objects 50] [--conditions NAME ...] [--out FOLDER]`, with COIL-100. The
weights of the network must be installed. It takes hours with all objects and conditions.

Objects 1-50 are searched for, among all that a condition enrolls. There are two steps:

- The prior: means, covariances and spreads of the enrolled views of objects 1-50.
- The evidence: each search, with its object enrolled and without it, gives the numbers of `hbr.dense.evidence` after
  each view, and the fit pixel by pixel. Logistic regression finds the weights. All conditions count the same, and in
  each of them the enrolled and the left-out objects.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray
from hbr.dense.evidence import COMMON, numbers
from hbr.dense.filter import Belief, update_belief
from hbr.dense.index import DenseIndex
from hbr.dense.local_difference import LocalView
from hbr.dense.session import answered, near, verify
from hbr.dense.space import MOST_PAIRED, PRIOR, Statistics, of_others, parts_of, unit_vectors, uses_of, whitening
from hbr.dense.stopping import WEIGHTS
from hbr.descriptors import descriptor
from hbr.descriptors.registry import FULL, LIGHT
from hbr.descriptors.together import ViewsTogether
from hbr.evaluation.changes import VIEWS, EnrolledViews, enroll_changed, is_enrolled, searches
from hbr.evaluation.experiment import Experiment
from hbr.evaluation.photographs import Dataset, load_coil
from hbr.model.views import Views
from rig.evaluation.experiments import load_experiment

#: The last object that is searched for.
_TRAINED: Final = 50
#: Experiments, and the noise of the queries.
CONDITIONS: Final = (
    *("photographs-8", "photographs-8 gn", "photographs-8 mb"),
    *("mild-change", "mild-change-no-picture", "hard-change-plain"),
    *("hard-change", "hard-change-no-picture", "hard-change-8"),
)
#: Directions of each covariance that the prior keeps; the rest is a variance for each entry.
_DIRECTIONS: Final = 96
#: Strength of the regularisation, which draws weights to 0.
_RIDGE: Final = 2e-3
_STEPS: Final = 60  # far more than Newton's method needs: only a bound, so that data without a minimum end too


class Row(NamedTuple):
    """A search after some views: the numbers, the fit and its differences, and whether the leader is the object."""

    views: int
    numbers: FloatArray
    fit: tuple[float, float, float]
    is_right: bool
    is_enrolled: bool


def experiment_of(condition: str, kind: str) -> Experiment:
    """Return the experiment of a condition, by one descriptor, with one search for each object."""
    name, _, noise = condition.partition(" ")
    found = load_experiment(name, descriptor=kind, noise=noise or None)
    return replace(found, protocol=replace(found.protocol, trials=1))


@lru_cache(maxsize=128)
def _enrolled(dataset: Dataset, experiment: Experiment, place: int) -> EnrolledViews:
    return enroll_changed(dataset.objects[place], experiment)


@lru_cache(maxsize=2)
def _views(dataset: Dataset, experiment: Experiment, objects: int) -> Views:
    kind = experiment.condition.descriptor
    parts = []
    for place, item in enumerate(dataset.objects[:objects]):
        if is_enrolled(place, experiment):
            own = _enrolled(dataset, experiment, place)
            parts.append(Views.of_object(item.name, own.levels, own.azimuth_deg, kind))
    return Views.concatenate(parts)


def prior(views: Sequence[Views]) -> dict[str, NDArray[np.generic]]:
    """Return the arrays of the prior, from views by the full descriptor."""
    found: dict[str, NDArray[np.generic]] = {}
    everything = Views.concatenate(views)
    paired = np.unique(np.linspace(0, len(everything) - 1, MOST_PAIRED).astype(int))
    is_other = everything.object_index[paired][:, None] != everything.object_index[paired]
    for part, columns in parts_of(descriptor(FULL)):
        entries = part.entries(everything.descriptors[:, columns])
        own = Statistics.of(entries)
        variance, directions = np.linalg.eigh(own.covariance)
        kept = directions[:, -_DIRECTIONS:] * np.sqrt(np.maximum(variance[-_DIRECTIONS:], 0))
        rest = np.maximum(np.diag(own.covariance) - (kept**2).sum(axis=1), 0)
        others = []
        for use in uses_of(part):
            mean, matrix = (own.mean, whitening(own)) if use.is_whitened else (None, None)
            others.append(of_others(unit_vectors(entries[paired], mean, matrix), is_other))
        found |= {
            f"{part.name}.mean": own.mean.astype(np.float32),
            f"{part.name}.directions": kept.astype(np.float16),
            f"{part.name}.rest": rest.astype(np.float32),
            f"{part.name}.others": np.array(others),
        }
    return found


def rows_of(dataset: Dataset, experiment: Experiment, objects: int, place: int) -> list[Row]:
    """Return the rows of the searches for an object, with it enrolled and without it."""
    views = _views(dataset, experiment, objects)
    item = dataset.objects[place]
    others = views.object_index != _index_of(views, item.name)
    indexes = [DenseIndex(views.select(others))]
    if not others.all():
        indexes.append(DenseIndex(views))
    places = {one.name: at for at, one in enumerate(dataset.objects)}

    def near_views(index: int, azimuths_deg: Sequence[float]) -> list[LocalView]:
        enrolled = _enrolled(dataset, experiment, places[views.object_names[index]])
        return [enrolled.cut_outs[at] for at in near(enrolled.azimuth_deg, azimuths_deg)]

    found: list[Row] = []
    for views_so_far in searches(item, experiment):
        azimuths_deg: list[float] = []
        for seen, azimuth_deg in views_so_far.views:
            azimuths_deg.append(azimuth_deg)

            def queries(n: int, seen: ViewsTogether = seen) -> list[LocalView]:
                return [LocalView(one.crop, one.mask, 0.0) for one in seen.segmentations[n]]

            for index in indexes:
                so_far: DenseIndex | Belief = index
                for levels, deg in zip(seen.levels, azimuths_deg, strict=True):
                    so_far = update_belief(levels, deg, so_far)
                assert isinstance(so_far, Belief)
                leader = int(so_far.probability().argmax())
                fit = answered(verify(so_far, queries), near_views)
                assert fit is not None
                own, other, expected = fit.fit
                name = views.object_names[int(index.object_index[leader])]
                found.append(
                    Row(
                        len(azimuths_deg),
                        numbers(so_far, leader),
                        (own, own - other, own - expected),
                        name == item.name,
                        len(index) > len(indexes[0]),
                    )
                )
    return found


def _index_of(views: Views, name: str) -> int:
    return views.object_names.index(name) if name in views.object_names else -1


def model(conditions: Sequence[Sequence[Row]], common_only: bool = False) -> dict[str, list[list[float]]]:
    """Return the weights of the numbers and of the fit, after 1, 2, ... views."""
    weights, fits = [], []
    for after in range(1, VIEWS + 1):
        some = [[row for row in rows if row.views == after] for rows in conditions]
        flat = [row for rows in some for row in rows]
        count = COMMON if common_only else None
        columns = np.array([row.numbers[:count] for row in flat])
        right = np.array([row.is_right for row in flat])
        share = np.concatenate([_shares(rows) for rows in some])
        found = _logistic(columns, right, share)
        odds = columns @ found[:-1] + found[-1]
        fits.append(_logistic(np.column_stack([odds, [row.fit for row in flat]]), right, share))
        weights.append(found)
    return {name: np.round(rows, 3).tolist() for name, rows in (("weights", weights), ("fit", fits))}


def _shares(rows: Sequence[Row]) -> FloatArray:
    """Return how much each row of a condition counts: enrolled and left-out objects the same, together 1."""
    enrolled = np.array([row.is_enrolled for row in rows])
    each: FloatArray = np.where(enrolled, 0.5 / max(1, enrolled.sum()), 0.5 / max(1, (~enrolled).sum()))
    return each


def _logistic(columns: FloatArray, right: NDArray[np.bool_], share: FloatArray) -> FloatArray:
    """Return the weights of the columns and an offset, by Newton's method."""
    middle, spread = columns.mean(axis=0), columns.std(axis=0) + 1e-9
    reduced = np.column_stack([(columns - middle) / spread, np.ones(len(columns))])
    share = share / share.sum()
    ridge = _RIDGE * np.eye(reduced.shape[1])
    ridge[-1, -1] = 0
    found = np.zeros(reduced.shape[1])
    for _ in range(_STEPS):
        likely = 1 / (1 + np.exp(-np.clip(reduced @ found, -30, 30)))
        gradient = reduced.T @ (share * (likely - right)) + ridge @ found
        curvature = (reduced * (share * likely * (1 - likely))[:, None]).T @ reduced + ridge
        step = np.linalg.solve(curvature + 1e-9 * np.eye(len(found)), gradient)
        found -= step
        if np.abs(step).max() < 1e-8:
            break
    weights = found[:-1] / spread
    return np.append(weights, found[-1] - weights @ middle)


def _searched(dataset: Dataset, condition: str, kind: str, objects: int, pool: ProcessPoolExecutor) -> list[Row]:
    work = partial(rows_of, dataset, experiment_of(condition, kind), objects)
    return [row for rows in pool.map(work, range(min(objects, _TRAINED))) for row in rows]


def _enrolled_views(dataset: Dataset, conditions: Sequence[str], objects: int) -> Iterator[Views]:
    for condition in conditions:
        views = _views(dataset, experiment_of(condition, FULL), min(objects, _TRAINED))
        yield views.select(np.arange(0, len(views), 3))


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("dataset", type=Path)
    arguments.add_argument("--objects", type=int, default=100, help="number of objects of the data set that take part")
    arguments.add_argument("--conditions", nargs="+", default=CONDITIONS)
    arguments.add_argument("--out", type=Path, default=Path("hbr/dense"), help="where the two files are written")
    given = arguments.parse_args()
    dataset = load_coil(given.dataset)
    np.savez_compressed(given.out / PRIOR, **prior(list(_enrolled_views(dataset, given.conditions, given.objects))))
    models = {}
    with ProcessPoolExecutor() as pool:  # its processes read the new prior
        for kind in (LIGHT, FULL):
            rows = [_searched(dataset, condition, kind, given.objects, pool) for condition in given.conditions]
            models[kind] = model(rows)
            if kind == LIGHT:
                models[""] = model(rows, common_only=True)
    (given.out / WEIGHTS).write_text(json.dumps(models, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
