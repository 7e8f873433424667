"""What a new object looks like: itself from other sides, and other objects. Judged from the enrolled views alone."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap180, wrap360
from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.descriptors.tanimoto import tanimoto
from hbr.model.views import Views

Similarity = Callable[[LevelArray, LevelArray], FloatArray]

SLACK: Final = 0.01
"""Similarities that differ less are alike: two frames of the same view differ by as much."""
_FEWEST: Final = 18
"""Neighbours more than 20 degrees apart say nothing about how alike the same view is."""
_ORDERS: Final = range(2, 13)


@dataclass(frozen=True, slots=True)
class Symmetry:
    """After which turn an object looks the same, as far as its descriptors can tell.

    Attributes
    ----------
    period_deg
        The smallest such turn: 360 where there is none, 0 where the object looks alike from everywhere. The pose of an
        object is known up to so much.
    neighbours
        Mean similarity of neighbouring views.
    alike
        Mean similarity of views a period apart; of 0, of the views that are least alike; of 360, the largest beyond the
        neighbours' dip.
    """

    period_deg: float
    neighbours: float
    alike: float


@dataclass(frozen=True, slots=True)
class SimilarObject:
    """Another object that cannot be told from one, seen from some sides.

    Attributes
    ----------
    object_index
        The other object.
    arcs_deg
        Azimuths of the object, from and to, counter-clockwise, at which it looks like the other one; in [0, 360).
    share
        Share of its views that do.
    similarity
        The largest similarity of a view of one to a view of the other.
    """

    object_index: int
    arcs_deg: tuple[tuple[float, float], ...]
    share: float
    similarity: float


def symmetry(views: Views, object_index: int, *, similarity: Similarity = tanimoto) -> Symmetry | None:
    """Judge an object's rotational symmetry by how alike its own views are.

    A turn counts as a period when views that far apart are as alike as neighbours are, and less alike in between.

    Parameters
    ----------
    views : Views
        The model set.
    object_index : int
        The object.
    similarity : callable
        Of rows of descriptors, as `hbr.tanimoto`.

    Returns
    -------
    Symmetry or None
        None of fewer than 18 views.
    """
    descriptors, azimuth_deg = _ring(views, object_index)
    count = len(descriptors)
    if count < _FEWEST:
        return None
    pairwise = similarity(descriptors, descriptors)
    step_deg = 360.0 / count
    mean = np.array([_mean_at(pairwise, azimuth_deg, k * step_deg) for k in range(1, count // 2 + 1)])
    neighbours, floor = float(mean[0]), float(mean[0]) - SLACK
    if mean.min() >= floor:
        return Symmetry(0.0, neighbours, float(mean.min()))
    periods: dict[int, float] = {}
    for order in _ORDERS:
        # a period that is no whole number of steps lies between two shifts
        near = [k for k in {int(count / order), -int(-count // order)} if 2 < k <= len(mean)]
        for k in near:
            alike = float(mean[k - 1])
            if alike >= floor and mean[: k - 1].min() <= alike - SLACK:
                periods[order] = max(alike, periods.get(order, 0.0))
    if periods:  # of a quarter turn, half a turn is one too
        best = max(periods.values())
        order = max(order for order, alike in periods.items() if alike >= best - SLACK / 2)
        return Symmetry(360.0 / order, neighbours, periods[order])
    return Symmetry(360.0, neighbours, float(mean[int(mean.argmin()) :].max()))


def similar_objects(views: Views, object_index: int, *, similarity: Similarity = tanimoto) -> tuple[SimilarObject, ...]:
    """Find the objects that an object can be taken for, and from which sides.

    A view looks like another object when one of that object's views is as similar to it as the better one of its own
    neighbours, less `SLACK`.

    Returns
    -------
    tuple of SimilarObject
        The one with the largest share of views first; empty of an object with fewer than three views.
    """
    descriptors, azimuth_deg = _ring(views, object_index)
    others = np.setdiff1d(views.object_index, [object_index])
    if len(descriptors) < 3 or not len(others):
        return ()
    own = similarity(descriptors, descriptors)
    before, after = np.diagonal(np.roll(own, 1, axis=1)), np.diagonal(np.roll(own, -1, axis=1))
    enough = np.maximum(before, after) - SLACK
    rows, begin = views.of_each(others)
    model = views.descriptors[rows]
    reach = np.stack([np.maximum.reduceat(similarity(view, model)[0], begin) for view in descriptors])
    alike = reach >= enough[:, None]
    found = [
        SimilarObject(
            object_index=int(other),
            arcs_deg=_arcs(azimuth_deg, alike[:, column]),
            share=float(alike[:, column].mean()),
            similarity=float(reach[:, column].max()),
        )
        for column, other in enumerate(others)
        if alike[:, column].any()
    ]
    return tuple(sorted(found, key=lambda one: (-one.share, -one.similarity, one.object_index)))


def _ring(views: Views, object_index: int) -> tuple[LevelArray, FloatArray]:
    """Descriptors (n, 144) and azimuths (n,) of an object's views, by rising azimuth."""
    rows = views.of(object_index)
    rows = rows[np.argsort(views.azimuth_deg[rows], kind="stable")]
    return views.descriptors[rows], views.azimuth_deg[rows]


def _mean_at(pairwise: FloatArray, azimuth_deg: FloatArray, shift_deg: float) -> float:
    """Mean similarity of each view to the one nearest to ``shift_deg`` further on."""
    away_deg = np.abs(wrap180(azimuth_deg[None, :] - azimuth_deg[:, None] - shift_deg))
    partner: IndexArray = away_deg.argmin(axis=1)
    return float(pairwise[np.arange(len(partner)), partner].mean())


def _arcs(azimuth_deg: FloatArray, alike: NDArray[np.bool_]) -> tuple[tuple[float, float], ...]:
    """The stretches of the ring where ``alike`` holds; a single view that differs does not part them."""
    count = len(alike)
    if alike.all():
        return ((0.0, 360.0),)
    held = np.flatnonzero(alike)
    # from each view that is alike to the next: a gap of more than one view between them parts two stretches
    parted = [b for a, b in pairwise([*held.tolist(), int(held[0]) + count]) if b - a > 2]
    if not parted:
        return ((0.0, 360.0),)
    arcs = []
    for start, end in pairwise([*parted, parted[0] + count]):
        last = max(h for h in (*held.tolist(), *(held + count).tolist()) if h < end)
        arcs.append((wrap360(float(azimuth_deg[start % count])), wrap360(float(azimuth_deg[last % count]))))
    return tuple(sorted(arcs))
