"""Rotational symmetry of enrolled objects, and objects that can be confused. Computed from the enrolled views."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap180, wrap360
from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.descriptors import Descriptor, descriptor
from hbr.model.views import Views

Arcs = tuple[tuple[float, float], ...]

SLACK: Final = 0.01
"""Largest difference of similarities that count as equal, because two frames of the same view differ by this much."""
_MIN_VIEWS: Final = 18  # with fewer views, neighbours are more than 20° apart and too different to compare with
_ORDERS: Final = range(2, 13)
_AT_ONCE: Final = 50  # objects whose views are compared at once: the memory does not grow with the catalog


@dataclass(frozen=True, slots=True)
class Symmetry:
    """Rotational symmetry of an object, as far as its descriptors show it."""

    period_deg: float
    """The smallest rotation after which the object looks the same: 360 without symmetry, 0 if it looks the same from
    everywhere. The pose of the object is ambiguous by multiples of it."""
    neighbours: float
    """Mean similarity of neighbouring views."""
    similarity: float
    """Mean similarity of views one period apart. For a period of 0, of the least similar views; for 360, the largest
    one after the minimum."""


@dataclass(frozen=True, slots=True)
class SimilarObject:
    """An enrolled object that looks like the new one from some sides."""

    name: str
    """Name of the other enrolled object."""
    arcs_deg: Arcs
    """Sides from which the new object looks like this one: pairs of azimuths (from, to), counter-clockwise."""
    differs_deg: Arcs
    """The other sides of the new object: it looks like no view of this one there."""
    other_differs_deg: Arcs
    """Sides of this object that look like no view of the new one."""
    share: float
    """Share of the new object's views that look like this object, from 0 to 1."""
    similarity: float
    """Largest similarity of a view of one object and a view of the other."""


def symmetry(views: Views, object_index: int) -> Symmetry | None:
    """Return an object's rotational symmetry, by the similarity of its own views.

    A rotation is a period if views that far apart are as similar as neighbours are, and views in between are less
    similar.

    Parameters
    ----------
    views : Views
        The model set.
    object_index : int
        The object.

    Returns
    -------
    Symmetry or None
        None if the object has fewer than 18 views.
    """
    descriptors, azimuth_deg = _ring(views, object_index)
    count = len(descriptors)
    if count < _MIN_VIEWS:
        return None
    pairwise = descriptor(views.descriptor).similarity(descriptors, descriptors)
    step_deg = 360.0 / count
    mean = np.array([_mean_at(pairwise, azimuth_deg, k * step_deg) for k in range(1, count // 2 + 1)])
    neighbours, floor = float(mean[0]), float(mean[0]) - SLACK
    if mean.min() >= floor:
        return Symmetry(0.0, neighbours, float(mean.min()))
    periods: dict[int, float] = {}
    for order in _ORDERS:
        # a period that is not a multiple of the step lies between two shifts
        near = [k for k in {int(count / order), -int(-count // order)} if 2 < k <= len(mean)]
        for k in near:
            value = float(mean[k - 1])
            if value >= floor and mean[: k - 1].min() <= value - SLACK:
                periods[order] = max(value, periods.get(order, 0.0))
    if periods:  # if 90° is a period, 180° is one too: take the smallest
        best = max(periods.values())
        order = max(order for order, value in periods.items() if value >= best - SLACK / 2)
        return Symmetry(360.0 / order, neighbours, periods[order])
    return Symmetry(360.0, neighbours, float(mean[int(mean.argmin()) :].max()))


def similar_objects(views: Views, object_index: int, most: int) -> tuple[SimilarObject, ...]:
    """Find the objects that an object can be confused with, and from which sides.

    A view looks like another object if one of that object's views is as similar to it as the more similar one of its
    own neighbours, minus `SLACK`.

    Returns
    -------
    tuple of SimilarObject
        At most ``most``, the object with the largest share first. Empty if the object has fewer than three views.
    """
    descriptors, azimuth_deg = _ring(views, object_index)
    others = np.setdiff1d(views.object_index, [object_index])
    if len(descriptors) < 3 or not len(others):
        return ()
    kind = descriptor(views.descriptor)
    parts = []
    for start in range(0, len(others), _AT_ONCE):
        rows, begin = views.of_each(others[start : start + _AT_ONCE])
        parts.append(np.maximum.reduceat(kind.similarity(descriptors, views.levels(rows)), begin, axis=1))
    reach = np.concatenate(parts, axis=1)
    confused = reach >= _enough(kind, descriptors)[:, None]
    share, similarity = confused.mean(axis=0), reach.max(axis=0)
    found = []
    for column in np.lexsort((others, -similarity, -share))[: min(most, int((share > 0).sum()))].tolist():
        theirs, their_azimuth_deg = _ring(views, int(others[column]))
        unlike = kind.similarity(theirs, descriptors).max(axis=1) < _enough(kind, theirs)
        one = SimilarObject(
            name=views.object_names[others[column]],
            arcs_deg=_arcs(azimuth_deg, confused[:, column]),
            differs_deg=_arcs(azimuth_deg, ~confused[:, column]),
            other_differs_deg=_arcs(their_azimuth_deg, unlike),
            share=float(share[column]),
            similarity=float(similarity[column]),
        )
        found.append(one)
    return tuple(found)


def extreme_pairs(views: Views, object_index: int, other: int) -> list[tuple[int, int, float]]:
    """Return where two objects look most alike, and where they differ most.

    They differ most where the object looks least like the other one for how little it looks like its own neighbours
    there, as in `similar_objects`: seen along its handle, a cup looks like no view but that one.

    Returns
    -------
    list of (int, int, float)
        For each of the two: the place among the object's views, the place among the other one's of the view that looks
        most like it, and their similarity.
    """
    rows = views.of(object_index)
    order = np.argsort(views.azimuth_deg[rows], kind="stable")
    kind, own = descriptor(views.descriptor), views.levels(rows[order])
    similar = kind.similarity(own, views.levels(views.of(other)))
    reach = similar.max(axis=1)
    places = reach.argmax(), (reach - _enough(kind, own)).argmin()
    return [(int(order[at]), int(similar[at].argmax()), float(reach[at])) for at in places]


def _enough(kind: Descriptor, descriptors: LevelArray) -> FloatArray:
    """Return the similarity from which each view, in their order around the object, looks like another object."""
    own = kind.similarity(descriptors, descriptors)
    before, after = np.diagonal(np.roll(own, 1, axis=1)), np.diagonal(np.roll(own, -1, axis=1))
    return np.maximum(before, after) - SLACK


def _ring(views: Views, object_index: int) -> tuple[LevelArray, FloatArray]:
    """Return descriptors (n, length) and azimuths (n,) of an object's views, by rising azimuth."""
    rows = views.of(object_index)
    rows = rows[np.argsort(views.azimuth_deg[rows], kind="stable")]
    return views.levels(rows), views.azimuth_deg[rows]


def _mean_at(pairwise: FloatArray, azimuth_deg: FloatArray, shift_deg: float) -> float:
    """Return the mean similarity of each view to the one nearest to ``shift_deg`` further on."""
    away_deg = np.abs(wrap180(azimuth_deg[None, :] - azimuth_deg[:, None] - shift_deg))
    partner: IndexArray = away_deg.argmin(axis=1)
    return float(pairwise[np.arange(len(partner)), partner].mean())


def _arcs(azimuth_deg: FloatArray, held: NDArray[np.bool_]) -> Arcs:
    """Return the ranges of azimuth in which ``held`` is true for every view."""
    if held.all():
        return ((0.0, 360.0),)
    begins, ends = held & ~np.roll(held, 1), held & ~np.roll(held, -1)
    first, last = (wrap360(azimuth_deg[at]).tolist() for at in (begins, ends))
    if held[0] and held[-1]:  # the last range leads past 0°
        last = [*last[1:], last[0]]
    return tuple(zip(first, last, strict=True))
