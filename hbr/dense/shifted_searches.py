"""Leave-one-out searches under changes of the bench: the sample from which the open-set score is fitted.

The queries are the enrolled views of an object, changed as another bench would change their description
(`hbr.descriptors.shift`). Each search is evaluated twice: among all objects, and as if its object were not enrolled.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, LevelArray
from hbr.dense.index import BINS, DenseIndex
from hbr.dense.leave_one_out import spread
from hbr.dense.open_set import NUMBERS, evidence
from hbr.descriptors import descriptor
from hbr.descriptors.shift import Shift

#: Strengths of the changes, in turn; 1 is a hard change of the bench.
STRENGTHS: Final = (0.0, 0.5, 1.0, 1.3)
#: With more views, the whitened descriptions of all of them would take too much memory.
_MOST_VIEWS: Final = 20_000
_SEED: Final = 20


@dataclass(frozen=True, eq=False)
class ShiftedSearches:
    """Searches under changes of the bench, one after the other.

    Attributes
    ----------
    strength : float64 array (searches,)
        Of the change, as an element of `STRENGTHS`.
    known, unknown : float64 arrays (searches, views, 7)
        The numbers of `hbr.dense.open_set.NUMBERS`, with the object enrolled, and without it.
    correct : bool array (searches, views)
        Whether the object leads, if it is enrolled.
    """

    strength: FloatArray
    known: FloatArray
    unknown: FloatArray
    correct: NDArray[np.bool_]


def can_shift(index: DenseIndex) -> bool:
    """Return whether the descriptor says how another bench changes it."""
    kind = descriptor(index.views.descriptor)
    row = index.views.levels(np.array([0]))[0]
    hard = Shift.drawn(np.random.default_rng(_SEED), 2.0)
    return not np.array_equal(kind.shifted(row, hard), row)


def shifted_searches(
    index: DenseIndex, *, views: int, searches: int, progress: Callable[[int, int], object] | None = None
) -> ShiftedSearches:
    """Search so many times for the objects of an index in turn, each time with so many views.

    Objects with fewer views are left out. Every object is searched for under each strength before one is repeated.

    Raises
    ------
    ValueError
        No object has enough views.
    """
    kind = descriptor(index.views.descriptor)
    rng = np.random.default_rng(_SEED)
    rows_of = [index.nearest_views(place, 0.0, int(count)) for place, count in enumerate(index.view_counts)]
    places = [place for place, rows in enumerate(rows_of) if len(rows) >= max(2, views)]
    if not places:
        raise ValueError(f"no object has {max(2, views)} views; enroll more of each, or search with fewer views")
    every = np.arange(len(index.views))
    enrolled = index.whitening.unit(index.views.levels(every)) if len(every) <= _MOST_VIEWS else None
    strength, known, unknown, correct = [], [], [], []
    for n in range(searches):
        if progress is not None:
            progress(n, searches)
        place = places[n % len(places)]
        rows = rows_of[place]
        rows = rows[np.argsort(index.views.azimuth_deg[rows], kind="stable")]
        azimuth_deg = index.views.azimuth_deg[rows]
        chosen = spread(azimuth_deg, int(rng.integers(len(rows))), views)
        # a different strength in each round, and for neighbouring objects
        strength.append(STRENGTHS[(n // len(places) + n) % len(STRENGTHS)])
        queries = [
            _beside(kind.shifted, index.views.levels(rows[[i, (i + 1) % len(rows)]]), strength[-1], rng) for i in chosen
        ]
        own, left_out, right = _numbers(index, place, queries, azimuth_deg[chosen], enrolled)
        known.append(own)
        unknown.append(left_out)
        correct.append(right)
    return ShiftedSearches(np.array(strength), np.array(known), np.array(unknown), np.array(correct))


def _beside(
    shifted: Callable[[LevelArray, Shift], LevelArray], pair: LevelArray, strength: float, rng: np.random.Generator
) -> LevelArray:
    """Return a view between two enrolled ones, on a changed bench: each entry is that of one of the two."""
    share = rng.uniform(0, 0.5)
    between = np.where(rng.random(pair.shape[1]) < share, pair[1], pair[0]).astype(np.uint8)
    return shifted(between, Shift.drawn(rng, strength))


def _numbers(
    index: DenseIndex, place: int, queries: list[LevelArray], azimuth_deg: FloatArray, enrolled: FloatArray | None
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    similar = index.compared.similarity(np.stack(queries))
    units = [index.whitening.unit(query[None]) for query in queries]
    support = np.zeros((len(index), BINS), np.float32)
    known, unknown = np.zeros((2, len(queries), len(NUMBERS)))
    correct = np.zeros(len(queries), np.bool_)
    for n in range(len(queries)):
        support += index.support(similar[n], float(azimuth_deg[n] - azimuth_deg[0]))
        so_far = index, support, azimuth_deg[: n + 1], queries[: n + 1]
        best, known[n] = evidence(*so_far, units=units[: n + 1], enrolled=enrolled)
        _, unknown[n] = evidence(*so_far, units=units[: n + 1], enrolled=enrolled, without=place)
        correct[n] = best == place
    return known, unknown, correct
