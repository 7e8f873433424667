"""Hough-based retrieval (HBR): scores of objects by paths of views that fit the queries and the rotations.

Source: Czúni and Rashad, "Lightweight Active Object Retrieval with Weak Classifiers", Sensors 2018, 18, 801, Eq. 2-4.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.angles import revolutions_between
from hbr.core.arrays import FloatArray, IndexArray, LevelArray, first_maximum, lengths, ranges
from hbr.kernels import calls
from hbr.model.views import Views
from hbr.paper.index import ViewIndex

Extension = Literal["visual", "orient", "orient_all"]
#: Indices of views for each query.
_Columns = list[IndexArray]


@dataclass(frozen=True, eq=False)
class Ranking:
    """The candidates of a retrieval, best first."""

    object_index: IndexArray
    """integer array (C,): the objects with a view on any retrieval list, by falling score; equal scores by rising
    index."""
    scores: FloatArray
    """float64 array (C,): Hough score H of each object; at most the number of queries."""
    pose_deg: FloatArray
    """float64 array (C,): orientation of the camera around each object at the last query, in [0, 360)."""
    paths: IndexArray
    """integer array (C, N): the view for each query on the best path of each object."""
    lists: tuple[IndexArray, ...]
    """Retrieval list of each query: view indices, best first."""
    orientation_deg: FloatArray
    """float64 array (N,): orientations of the queries, as passed."""
    views: Views
    """The model set that the indices refer to."""

    def __len__(self) -> int:
        return len(self.object_index)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the candidates, best first."""
        return tuple(self.views.object_names[j] for j in self.object_index)

    @property
    def margin(self) -> float:
        """Score of the best candidate minus that of the second; the whole score if there is only one."""
        return float(self.scores[0] - self.scores[1]) if len(self) > 1 else float(self.scores[0])


def retrieve(
    queries: LevelArray | Sequence[LevelArray],
    orientation_deg: ArrayLike,
    index: ViewIndex,
    *,
    omega: float = 0.5,
    list_length: int = 10,
    extension: Extension = "orient_all",
) -> Ranking:
    """Rank the enrolled objects by their Hough score over all queries so far.

    For each object, H = max over its paths of Σ T(q_i, c_i) - ω Σ Δ(o_i - o_{i+1}, o_{c_i} - o_{c_{i+1}}),
    Δ in revolutions, where a path takes one view of the object from every query's list. The maximum is exact (dynamic
    programming). Of equal paths, the one whose last view has the lowest index is taken, then by the view before, and so
    on.

    Parameters
    ----------
    queries : uint8 array (N, length)
        Descriptors of the views so far, in their order, as those of the enrolled views. N is at least 1.
    orientation_deg : array (N,)
        Orientation of the camera around the object at each query, in degrees, with any zero (e.g. the first query).
    index : ViewIndex
        The enrolled views.
    omega : float
        Weight ω of the orientation; 0 ignores it.
    list_length : int
        Number of views on the retrieval list of each query.
    extension : {"orient_all", "orient", "visual"}
        How an object that is missing from a list is added to it. ``visual``: by its view most similar to the query.
        ``orient``: each of its views on the neighbouring list adds the view that the rotation between the two queries
        leads to, starting from the first list that has the object. ``orient_all``: each of its views on any list adds
        such views to all other lists, even if the object is not missing there. Of equally close views, the one with the
        lower index is taken.

    Returns
    -------
    Ranking
        It is never empty.

    Raises
    ------
    TypeError, ValueError
        There is no query, a query has no finite orientation, the index is empty, or a setting is out of range.
    """
    queries, orientations = np.asarray(queries), np.array(orientation_deg, np.float64)
    _check(queries, orientations, index, omega, list_length, extension)
    views = index.views
    lists = [index.search(query, list_length)[0] for query in queries]
    match extension:
        case "visual":
            extended = _extend_visual(lists, queries, index)
        case "orient":
            extended = _extend_orient(lists, orientations, views)
        case "orient_all":
            extended = _extend_orient_all(lists, orientations, views)
    scores, paths = _best_paths(extended, queries, orientations, index, omega)

    order = np.argsort(-scores, kind="stable")
    paths = paths[order]
    last = paths[:, -1]
    return Ranking(
        object_index=views.object_index[last],
        scores=scores[order],
        pose_deg=views.azimuth_deg[last],
        paths=paths,
        lists=tuple(lists),
        orientation_deg=orientations,
        views=views,
    )


def _check(
    queries: LevelArray, orientations: FloatArray, index: ViewIndex, omega: float, list_length: int, extension: str
) -> None:
    if queries.ndim != 2 or not len(queries):
        raise ValueError(
            f"queries have shape {queries.shape}; stack one descriptor for each view, at least one: "
            f"(N, {index.descriptor.length})"
        )
    index.check_queries(queries)
    if orientations.shape != (len(queries),) or not np.isfinite(orientations).all():
        raise ValueError(
            f"orientation_deg is {orientations}; one finite angle for each of {len(queries)} queries is needed"
        )
    if not len(index):
        raise ValueError("the index is empty; enroll at least one object first")
    if not (np.isfinite(omega) and omega >= 0):
        raise ValueError(f"omega is {omega}; a finite weight of at least 0 is needed, 0.5 by default")
    if list_length < 1:
        raise ValueError(f"list_length is {list_length}; at least 1 is needed, 10 by default")
    if extension not in get_args(Extension):
        raise ValueError(f"extension {extension!r} is unknown; use one of {', '.join(get_args(Extension))}")


def _extend_visual(lists: _Columns, queries: LevelArray, index: ViewIndex) -> _Columns:
    """Add each missing object to a list by its view most similar to the query."""
    views, kind = index.views, index.descriptor
    candidates = np.unique(views.object_index[np.concatenate(lists)])
    extended = []
    for rows, query in zip(lists, queries, strict=True):
        missing, begin = views.of_each(np.setdiff1d(candidates, views.object_index[rows]))
        if len(missing):
            best = first_maximum(kind.similarity(query[None], views.levels(missing))[0], begin)
            rows = np.concatenate([rows, missing[best]])
        extended.append(rows)
    return extended


def _extend_orient(lists: _Columns, orientations: FloatArray, views: Views) -> _Columns:
    """Add each missing object to a list by its views on the neighbouring list, rotated like the camera."""
    columns = list(lists)
    forward = [(i, i - 1) for i in range(1, len(lists))]
    backward = [(i, i + 1) for i in reversed(range(len(lists) - 1))]
    for here, neighbour in forward + backward:
        objects = views.object_index[columns[neighbour]]
        is_here = (objects[:, None] == views.object_index[columns[here]]).any(axis=1)
        anchors = columns[neighbour][~is_here]
        rotation_deg = np.full(len(anchors), orientations[here] - orientations[neighbour])
        columns[here] = np.concatenate([columns[here], _rotated(anchors, rotation_deg, views)])
    return columns


def _extend_orient_all(lists: _Columns, orientations: FloatArray, views: Views) -> _Columns:
    """Add every view on a list to all other lists, rotated like the camera."""
    anchors, listed = np.concatenate(lists), np.repeat(np.arange(len(lists)), [len(rows) for rows in lists])
    here, anchor = np.nonzero(np.arange(len(lists))[:, None] != listed)
    rotated = _rotated(anchors[anchor], orientations[here] - orientations[listed[anchor]], views)
    added = np.split(rotated, np.searchsorted(here, np.arange(1, len(lists))))
    return [np.concatenate(column) for column in zip(lists, added, strict=True)]


def _rotated(anchors: IndexArray, rotation_deg: FloatArray, views: Views) -> IndexArray:
    """Return for each view the view of its object whose azimuth is closest to rotation_deg further on (ρ)."""
    if not len(anchors):
        return anchors
    rows, begin = views.of_each(views.object_index[anchors])
    count = lengths(begin, len(rows))
    rotated_deg = views.azimuth_deg[rows] - np.repeat(views.azimuth_deg[anchors], count)
    return rows[first_maximum(-revolutions_between(rotated_deg, np.repeat(rotation_deg, count)), begin)]


def _by_object(rows: IndexArray, views: Views) -> IndexArray:
    """Return the distinct views, by rising object, then by rising index."""
    rows = np.unique(rows)
    return rows[np.argsort(views.object_index[rows], kind="stable")]


def _best_paths(
    extended: _Columns, queries: LevelArray, orientations: FloatArray, index: ViewIndex, omega: float
) -> tuple[FloatArray, IndexArray]:
    """Return score (C,) and path (C, N) of every object, by rising object. Every object is in every list."""
    views, kind = index.views, index.descriptor
    azimuth_deg = views.azimuth_deg
    if kind.is_plain_cedd:
        of_views = views.descriptors, views.object_index, azimuth_deg
        compiled = calls.paths(extended, queries, orientations, *of_views, omega)
        if compiled is not None:
            return compiled
    columns = [_by_object(rows, views) for rows in extended]
    # forward: the best value of a path that ends at each view, and its predecessor on that path
    value = kind.similarity(queries[:1], views.levels(columns[0]))[0]
    predecessors = []
    for i in range(1, len(columns)):
        before, here = columns[i - 1], columns[i]
        objects_before, objects_here = views.object_index[before], views.object_index[here]
        start = np.searchsorted(objects_before, objects_here, side="left")
        count = np.searchsorted(objects_before, objects_here, side="right") - start
        tails, begin = ranges(start, count)
        rotated_deg = azimuth_deg[before[tails]] - np.repeat(azimuth_deg[here], count)
        penalty = omega * revolutions_between(rotated_deg, orientations[i - 1] - orientations[i])
        through = value[tails] - penalty
        best = first_maximum(through, begin)
        value = through[best] + kind.similarity(queries[i : i + 1], views.levels(here))[0]
        predecessors.append(tails[best])

    # backward: follow the predecessors from the best last view of each object
    _, begin = np.unique(views.object_index[columns[-1]], return_index=True)
    node = first_maximum(value, begin)
    scores = value[node]
    path = [columns[-1][node]]
    for rows, predecessor in zip(reversed(columns[:-1]), reversed(predecessors), strict=True):
        node = predecessor[node]
        path.append(rows[node])
    return scores, np.stack(path[::-1], axis=1)
