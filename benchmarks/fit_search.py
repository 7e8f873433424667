"""Fits what the search knows before an object is enrolled: ``prior.npz`` and ``evidence.json`` in hbr/dense.

`python -m benchmarks.fit_search COIL-100 ETH-80 [--objects N] [--conditions NAME ...] [--keep-prior] [--out FOLDER]`

The weights of the network must be installed. It takes less than an hour on two cores with ``--keep-prior``, which made
the shipped ``evidence.json``, from rows that were collected one condition after the other. Objects 1-50 of COIL-100 and
every second one of ETH-80 are searched for, among all that a condition enrolls. There are two steps:

- The prior: means, covariances and spreads of the enrolled views of objects 1-50 of COIL-100.
- The evidence: each search, with its object enrolled and without it, in the whole catalog and in small ones, gives the
  numbers of `hbr.dense.evidence` after each view, and the fit pixel by pixel. The networks are fitted to them. All
  conditions count the same, and in each of them the enrolled and the left-out objects.
"""

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from hbr.core.arrays import FloatArray, LevelArray
from hbr.dense.evidence import COMMON, numbers
from hbr.dense.filter import Belief, update_belief
from hbr.dense.index import DenseIndex
from hbr.dense.pixel_fit import LocalView, PixelFit
from hbr.dense.session import Fits, answered, near, verify
from hbr.dense.space import MOST_PAIRED, PRIOR, Statistics, of_others, parts_of, unit_vectors, uses_of, whitening
from hbr.dense.stopping import WEIGHTS
from hbr.descriptors import descriptor
from hbr.descriptors.registry import FULL, LIGHT
from hbr.descriptors.together import ViewsTogether
from hbr.evaluation.changes import EnrolledViews, enroll_changed, is_enrolled, searches
from hbr.evaluation.experiment import Experiment
from hbr.evaluation.photographs import Dataset, PhotographedObject, load_coil
from hbr.model.views import Views
from rig.evaluation.experiments import load_experiment

#: Experiments, the noise of the queries, and the number of searches for each object.
# more: a better fit on objects that it has not seen; each takes a quarter as long as the enrollment of all objects
CONDITIONS: Final = {
    "coil-100 hard-change-no-picture": 3,
    "coil-100 hard-change-plain": 1,
    "coil-100 hard-change": 3,
    "coil-100 mild-change-no-picture": 1,
    "coil-100 photographs-8 gn": 1,
    "coil-100 photographs-8": 1,
    "eth-80 photographs-8 gn": 4,
    "eth-80 photographs-8": 4,
}
#: Sizes of small catalogs that are searched, too: each new catalog begins with one object.
_SMALL: Final = (1, 4)
#: Directions of each covariance that the prior keeps; the rest is a variance for each entry.
_DIRECTIONS: Final = 96
#: Views of each search that the shipped weights were fitted to; a search can take twice as many.
_VIEWS: Final = 4
#: Hidden units of each network, and how many networks from different starts are averaged.
_UNITS, _STARTS = 8, 3
_SPREAD: Final = 0.3  # of the first weights
#: Strength of the regularisation, which draws weights to 0.
# less: the object is found in one view more often, and more similar objects that are not enrolled are accepted
_RIDGE: Final = 5e-4


class Row(NamedTuple):
    """A search after some views.

    Attributes
    ----------
    alone, with_fit : (float64 array (numbers,), bool)
        The numbers of the leader, and whether it is the object; without a fit, and with one.
    is_enrolled : bool
    """

    alone: tuple[FloatArray, bool]
    with_fit: tuple[FloatArray, bool]
    is_enrolled: bool


def experiment_of(condition: str) -> Experiment:
    """Return the experiment of a condition, by the full descriptor."""
    _, name, *noise = condition.split()
    found = load_experiment(name, descriptor=FULL, noise=noise[0] if noise else None)
    return replace(found, protocol=replace(found.protocol, trials=CONDITIONS[condition]))


def is_trained(condition: str, name: str) -> bool:
    number = int(name.removeprefix("obj"))
    return number <= 50 if condition.startswith("coil") else number % 2 == 1


def _views(enrolled: Mapping[str, EnrolledViews], kind: str = FULL) -> Views:
    """Return enrolled views by one descriptor."""
    parts = [Views.of_object(name, _levels(own.levels, kind), own.azimuth_deg, kind) for name, own in enrolled.items()]
    return Views.concatenate(parts)


def _levels(levels: LevelArray, kind: str) -> LevelArray:
    """Return the part of the full description that a shorter descriptor has: its first columns."""
    return levels[:, : descriptor(kind).length]


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


class _Searches:
    """The enrolled objects of a condition, and the searches among them."""

    def __init__(self, condition: str, enrolled: Mapping[str, EnrolledViews]) -> None:
        self._experiment = experiment_of(condition)
        self._enrolled = enrolled
        self._views = {kind: _views(enrolled, kind) for kind in (LIGHT, FULL)}

    def _near(self, index: int, azimuths_deg: Sequence[float]) -> list[LocalView]:
        enrolled = self._enrolled[self._views[FULL].object_names[index]]
        return [enrolled.cut_outs[at] for at in near(enrolled.azimuth_deg, azimuths_deg)]

    def rows(self, item: PhotographedObject) -> dict[str, list[Row]]:
        """Return the rows of the searches for an object by each descriptor, with it enrolled and without it."""
        found: dict[str, list[Row]] = {LIGHT: [], FULL: []}
        catalogs = {kind: list(_catalogs(views, item.name)) for kind, views in self._views.items()}
        for search in searches(item, self._experiment):
            azimuths_deg: list[float] = []
            for seen, azimuth_deg in islice(search.views, _VIEWS):
                azimuths_deg.append(azimuth_deg)

                def queries(n: int, seen: ViewsTogether = seen) -> list[LocalView]:
                    return [LocalView(one.crop, one.mask, 0.0) for one in seen.segmentations[n]]

                fits = Fits()  # the same for all catalogs
                for kind, indexes in catalogs.items():
                    for index in indexes:
                        so_far: DenseIndex | Belief = index
                        for levels, deg in zip(seen.levels, azimuths_deg, strict=True):
                            so_far = update_belief(_levels(levels, kind), deg, so_far)
                        assert isinstance(so_far, Belief)
                        fit = answered(verify(so_far, queries, fits), self._near)
                        assert fit is not None
                        found[kind].append(_row(so_far, fit, item.name, other_bench=search.other_bench))
        return found


def _catalogs(views: Views, name: str) -> Iterator[DenseIndex]:
    """Yield the whole catalog and small ones, each with an object and as large without it."""
    number = views.object_names.index(name) if name in views.object_names else -1
    is_other = views.object_index != number
    others = np.unique(views.object_index[is_other])
    rng = np.random.default_rng(int(name.removeprefix("obj")))
    for size in (len(others) + 1, *_SMALL):
        some = rng.permutation(others)[:size]
        yield DenseIndex(views.select(np.isin(views.object_index, some)))
        if number >= 0:
            yield DenseIndex(views.select(np.isin(views.object_index, [number, *some[: size - 1]])))


def _row(belief: Belief, fit: PixelFit, name: str, *, other_bench: bool) -> Row:
    names, index = belief.index.views.object_names, belief.index.object_index
    first = int(belief.probability().argmax())
    leader = index.tolist().index(fit.object_index)
    alone = numbers(belief, first)
    with_fit = alone if leader == first else numbers(belief, leader)
    return Row(
        (np.append(alone, other_bench), names[int(index[first])] == name),
        (np.array([*with_fit, other_bench, *fit.numbers()]), names[fit.object_index] == name),
        name in {names[one] for one in index.tolist()},
    )


def model(conditions: Sequence[Sequence[Row]], kind: str) -> dict[str, object]:
    """Return the weights of the networks; for the descriptor "" only of the common numbers."""
    share = np.concatenate([_shares(rows) for rows in conditions])
    flat = [row for rows in conditions for row in rows]
    found: dict[str, object] = {}
    for part in ("alone", "with_fit"):
        columns = np.array([getattr(row, part)[0] for row in flat])
        if not kind:
            columns = np.delete(columns, np.s_[COMMON : len(flat[0].alone[0]) - 1], axis=1)
        found[part] = _network(columns, np.array([getattr(row, part)[1] for row in flat]), share)
    return found


def _shares(rows: Sequence[Row]) -> FloatArray:
    """Return how much each row of a condition counts: enrolled and left-out objects the same, together 1."""
    enrolled = np.array([row.is_enrolled for row in rows])
    each: FloatArray = np.where(enrolled, 0.5 / max(1, enrolled.sum()), 0.5 / max(1, (~enrolled).sum()))
    return each


def _network(columns: FloatArray, right: NDArray[np.bool_], share: FloatArray) -> list[list[list[float]] | list[float]]:
    """Return the layers of networks from several starts as those of one network."""
    middle, spread = columns.mean(axis=0), columns.std(axis=0) + 1e-9
    given = np.column_stack([(columns - middle) / spread, np.ones(len(columns))])
    share, sign = share / share.sum(), np.where(right, 1.0, -1.0)
    count = given.shape[1]
    ends = count * _UNITS, (count + 1) * _UNITS

    def loss(weights: FloatArray) -> tuple[float, FloatArray]:
        inner, outer, direct = np.split(weights, ends)
        hidden = np.tanh(given @ inner.reshape(count, _UNITS))
        odds = sign * (hidden @ outer + given @ direct)
        slope = -sign * share / (1 + np.exp(np.clip(odds, -30, 30)))
        back = np.outer(slope, outer) * (1 - hidden**2)
        gradient = np.concatenate([(given.T @ back).ravel(), hidden.T @ slope, given.T @ slope])
        penalty = _RIDGE * weights
        penalty[-1] = 0  # the offset is free
        return float(share @ np.logaddexp(0, -odds) + penalty @ weights), gradient + 2 * penalty

    inners, outers, directs = [], [], []
    for start in range(_STARTS):
        first = np.random.default_rng(start).normal(0, _SPREAD, ends[1] + count)
        end = minimize(loss, first, jac=True, method="L-BFGS-B", options={"maxiter": 1000}).x
        inner, outer, direct = np.split(end, ends)
        inners.append(_unscaled(inner.reshape(count, _UNITS), middle, spread))
        outers.append(outer / _STARTS)
        directs.append(_unscaled(direct / _STARTS, middle, spread))
    layers = np.concatenate(inners, axis=1), np.concatenate(outers), np.sum(directs, axis=0)
    return [np.round(layer, 4).tolist() for layer in layers]


def _unscaled(weights: FloatArray, middle: FloatArray, spread: FloatArray) -> FloatArray:
    """Return weights of numbers instead of standardised ones; the last one is the offset."""
    own = (weights[:-1].T / spread).T
    return np.concatenate([own, (weights[-1] - middle @ own)[None]])


def _enroll(dataset: Dataset, condition: str, objects: int) -> dict[str, EnrolledViews]:
    experiment = experiment_of(condition)
    items = [one for at, one in enumerate(dataset.objects[:objects]) if is_enrolled(at, experiment)]
    with ProcessPoolExecutor() as pool:
        enrolled = pool.map(partial(enroll_changed, experiment=experiment), items)
        return {item.name: views for item, views in zip(items, enrolled, strict=True)}


def _searched(dataset: Dataset, condition: str, objects: int) -> dict[str, list[Row]]:
    work = _Searches(condition, _enroll(dataset, condition, objects))
    items = [item for item in dataset.objects[:objects] if is_trained(condition, item.name)]
    found: dict[str, list[Row]] = {LIGHT: [], FULL: []}
    # forked processes share the enrolled images
    with ProcessPoolExecutor(mp_context=get_context("fork"), initializer=_take, initargs=(work,)) as pool:
        for rows in pool.map(_rows, items):
            for kind, own in rows.items():
                found[kind] += own
    print(f"{condition}: {len(items)} objects", flush=True)
    return found


_taken: list[_Searches] = []


def _take(work: _Searches) -> None:
    _taken[:] = [work]


def _rows(item: PhotographedObject) -> dict[str, list[Row]]:
    return _taken[0].rows(item)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("datasets", type=Path, nargs=2, help="folders with COIL-100 and ETH-80")
    arguments.add_argument("--objects", type=int, default=100, help="number of objects of each data set that take part")
    arguments.add_argument("--conditions", nargs="+", default=CONDITIONS)
    arguments.add_argument("--keep-prior", action="store_true", help="use the present prior")
    arguments.add_argument("--out", type=Path, default=Path("hbr/dense"), help="where the two files are written")
    given = arguments.parse_args()
    datasets = {name: load_coil(folder) for name, folder in zip(("coil-100", "eth-80"), given.datasets, strict=True)}
    if not given.keep_prior:
        of_coil = [one for one in given.conditions if one.startswith("coil")]
        enrolled = (_views(_enroll(datasets["coil-100"], one, min(given.objects, 50))) for one in of_coil)
        arrays = prior([views.select(np.arange(0, len(views), 3)) for views in enrolled])
        np.savez_compressed(given.out / PRIOR, **arrays)
    # the processes read the new prior
    found = [_searched(datasets[one.split()[0]], one, given.objects) for one in given.conditions]
    models = {kind: model([rows[kind or LIGHT] for rows in found], kind) for kind in (LIGHT, FULL, "")}
    (given.out / WEIGHTS).write_text(json.dumps(models) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
