"""Open-set threshold of the paper's retrieval, computed from the enrolled views.

Decision: docs/decisions/0007.
"""

from typing import Final

import numpy as np

from hbr.core.arrays import FloatArray
from hbr.model.views import Views

_QUERIES: Final = 4  # number of views of a typical retrieval, spread evenly around the object


def open_set_threshold(views: Views, *, quantile: float = 0.05, repeatability: float = 0.97) -> float:
    """Return the mean score per view below which an object is probably unknown.

    Each enrolled view is a query and is compared with its two neighbours in azimuth, as if it were not enrolled itself.
    The larger similarity counts, averaged over four views 90° apart. A real query is at most half as far from an
    enrolled view, so that less than ``quantile`` of the known objects fall below the threshold. The enrolled views do
    not show the differences between two sessions (placement by hand, other illumination). ``repeatability`` allows for
    them, which matters if all views of all objects are similar.

    Parameters
    ----------
    views : Views
        The model set.
    quantile : float
        Share of these averages, over all objects and starting points, that is below the result.
    repeatability : float
        Upper limit of the result: a similarity that the same view has at least in two sessions.

    Returns
    -------
    float
        In [0, 1]. It is 0, so that no object is unknown, if no object has four views.

    Raises
    ------
    ValueError
        `quantile` or `repeatability` is outside [0, 1].
    """
    for name, share in (("quantile", quantile), ("repeatability", repeatability)):
        if not 0 <= share <= 1:
            raise ValueError(f"{name} is {share}; a value between 0 and 1 is needed")
    order = np.lexsort((views.azimuth_deg, views.object_index))
    _, begin, count = np.unique(views.object_index[order], return_index=True, return_counts=True)
    averages = [
        _averages(views.descriptors[order[start : start + n]].astype(np.float64))
        for start, n in zip(begin, count, strict=True)
        if n >= _QUERIES
    ]
    return min(float(np.quantile(np.concatenate(averages), quantile)), repeatability) if averages else 0.0


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
