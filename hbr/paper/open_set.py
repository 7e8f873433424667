"""What score an enrolled object reaches when it is seen again, judged from the enrolled views alone."""

from typing import Final

import numpy as np

from hbr.core.arrays import FloatArray
from hbr.model.views import Views

_QUERIES: Final = 4
"""Views that a typical retrieval takes, spread evenly around the object."""


def open_set_threshold(views: Views, *, quantile: float = 0.05, repeatability: float = 0.97) -> float:
    """Return the score a view below which an object is probably none of those enrolled.

    Every enrolled view is taken for a query and compared with its two neighbours in azimuth, as if it were not enrolled
    itself; the better one counts, averaged over four views a quarter of a turn apart. A real query lies at most half as
    far from an enrolled view, so fewer known objects than ``quantile`` fall below. What a second sitting costs (placed
    by hand, other light) is not in the enrolled views; ``repeatability`` allows for it, which matters where all views
    of all objects are nearly alike.

    Parameters
    ----------
    views : Views
        The model set.
    quantile : float
        Share of these averages, over all objects and starting points, that lie below the result.
    repeatability : float
        The result is never above this similarity, which the same view of two sittings surely keeps.

    Returns
    -------
    float
        In [0, 1]; 0, so that nothing is unknown, where no object has four views.

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
    """Mean similarity to the better neighbour over four views, for each first view; ``ring`` by rising azimuth."""
    following = np.roll(ring, -1, axis=0)
    dots = (ring * following).sum(axis=1)
    squares = (ring * ring).sum(axis=1)
    total = squares + np.roll(squares, -1) - dots
    similarity = np.divide(dots, total, out=np.zeros_like(dots), where=total > 0)
    better = np.maximum(similarity, np.roll(similarity, 1))
    steps = np.arange(_QUERIES) * len(ring) // _QUERIES
    averages: FloatArray = np.mean([np.roll(better, -step) for step in steps], axis=0)
    return averages
