"""What a search asks for when it ends: the enrolled views of an object near some azimuths."""

from collections.abc import Callable, Generator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from hbr.core.angles import wrap180
from hbr.core.arrays import IndexArray
from hbr.dense.local_difference import NEAREST, LocalView

_Result = TypeVar("_Result")


class NeedEnrolledViews(NamedTuple):
    """A search needs the enrolled views of an object, by its index in the views' names, near some azimuths.

    The answer is None if they cannot be read: the search then ends without them.
    """

    object_index: int
    azimuths_deg: tuple[float, ...]


Asking = Generator[NeedEnrolledViews, Sequence[LocalView] | None, _Result]
"""A step of a search that asks for enrolled views, and returns its result."""
Queries = Callable[[int], Sequence[LocalView]]
"""Returns a view of a search by each of its segmentations, the likeliest first."""


def answered(
    step: Asking[_Result], enrolled: Callable[[int, Sequence[float]], Sequence[LocalView] | None] = lambda *_: None
) -> _Result:
    """Return the result of a step; ``enrolled`` returns the enrolled views of an object near some azimuths."""
    try:
        need = next(step)
        while True:
            need = step.send(enrolled(*need))
    except StopIteration as end:
        result: _Result = end.value
        return result


def near(own_deg: ArrayLike, azimuths_deg: Sequence[float]) -> IndexArray:
    """Return the indices of the views, at ``own_deg`` (n,), that a comparison near some azimuths needs, by azimuth.

    There is one more than `NEAREST` for each azimuth, because the comparison leaves one out.
    """
    own_deg = np.asarray(own_deg, np.float64)
    away_deg = np.abs(wrap180(own_deg - np.asarray(azimuths_deg)[:, None]))
    wanted = np.unique(np.argsort(away_deg, axis=1, kind="stable")[:, : NEAREST + 1])
    places: IndexArray = wanted[np.argsort(own_deg[wanted], kind="stable")]
    return places
