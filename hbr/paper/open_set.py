"""Unknown objects in the paper's retrieval: the margin over all enrolled objects, and a threshold of the score.

Decision: docs/decisions/0018.
"""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.arrays import FloatArray, LevelArray
from hbr.descriptors import descriptor
from hbr.model.views import Views
from hbr.paper.hough import Ranking

#: Number of views of a typical retrieval, spread evenly around the object.
_QUERIES: Final = 4
#: Share of the averages of known objects that is below the threshold.
_QUANTILE: Final = 0.05


def score_margin(ranking: Ranking, queries: LevelArray | ArrayLike) -> float:
    """Return the best object's score minus the largest score that any other enrolled object can have.

    A score is a sum of similarities minus a penalty that is never negative (Eq. 3). Therefore no path of an object j
    has a score above Σ_i max_k T(q_i, c_jk). `Ranking.margin` knows only the listed objects: if the many similar views
    of a round object fill all lists, its twin is on none of them, and that margin is the whole score.

    Parameters
    ----------
    ranking : Ranking
        A result of `hbr.retrieve`.
    queries : uint8 array (N, length)
        The descriptors of that retrieval.

    Returns
    -------
    float
        Lower bound of the margin, in units of the score (at most N). Negative if another object may be the best one;
        the whole score if no other object has views.

    Raises
    ------
    ValueError
        The ranking has another number of queries.
    """
    levels = np.asarray(queries)
    if len(levels) != len(ranking.lists):
        raise ValueError(
            f"{len(levels)} queries for a ranking of {len(ranking.lists)}; pass the queries of that retrieval"
        )
    views = ranking.views
    others = np.setdiff1d(views.object_index, ranking.object_index[:1])
    best = float(ranking.scores[0])
    if not len(others):
        return best
    rows, begin = views.of_each(others)
    kind, reach = descriptor(views.descriptor), np.zeros(len(others))
    for query in levels:  # one query at a time, so that a million views take 8 MB and not N times as much
        reach += np.maximum.reduceat(kind.similarity(query[None], views.descriptors)[0][rows], begin)
    return best - float(reach.max())


def open_set_threshold(views: Views, *, repeatability: float = 0.97) -> float:
    """Return the mean score per view below which an object is probably unknown.

    Each enrolled view is a query and is compared with its two neighbours in azimuth, as if it were not enrolled itself.
    The larger similarity counts, averaged over four views 90° apart. A real query is at most half as far from an
    enrolled view, so that less than 5 % of the known objects fall below the threshold. The enrolled views do
    not show the differences between two sessions (placement by hand, other illumination). ``repeatability`` allows for
    them, which matters if all views of all objects are similar.

    Parameters
    ----------
    views : Views
        The model set.
    repeatability : float
        Upper limit of the result: a similarity that the same view has at least in two sessions.

    Returns
    -------
    float
        In [0, 1]. It is 0, so that no object is unknown, if no object has four views.

    Raises
    ------
    ValueError
        `repeatability` is outside [0, 1].
    """
    if not 0 <= repeatability <= 1:
        raise ValueError(f"repeatability is {repeatability}; a value between 0 and 1 is needed")
    order = np.lexsort((views.azimuth_deg, views.object_index))
    _, begin, count = np.unique(views.object_index[order], return_index=True, return_counts=True)
    averages = [
        _averages(views.descriptors[order[start : start + n]].astype(np.float64))
        for start, n in zip(begin, count, strict=True)
        if n >= _QUERIES
    ]
    return min(float(np.quantile(np.concatenate(averages), _QUANTILE)), repeatability) if averages else 0.0


def _averages(ring: FloatArray) -> FloatArray:
    """Return the mean similarity to the more similar neighbour over four views, for each first view."""
    following = np.roll(ring, -1, axis=0)
    dots = (ring * following).sum(axis=1)
    squares = (ring * ring).sum(axis=1)
    total = squares + np.roll(squares, -1) - dots
    similarity = np.divide(dots, total, out=np.zeros_like(dots), where=total > 0)
    better = np.maximum(similarity, np.roll(similarity, 1))
    steps = np.arange(_QUERIES) * len(ring) // _QUERIES
    averages: FloatArray = np.mean([np.roll(better, -step) for step in steps], axis=0)
    return averages
