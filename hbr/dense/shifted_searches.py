"""Leave-one-out searches under changes of the bench: the sample from which the open-set score is fitted.

The queries are the enrolled views of an object, changed as another bench would change their description
(`hbr.descriptors.shift`), often by several segmentations. Each search is evaluated twice: among all objects, and as if
its object were not enrolled. Then the whitening leaves out its views, too: they would make it less similar to the
others than an unknown object is.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.dense.index import BINS, DenseIndex
from hbr.dense.leave_one_out import spread
from hbr.dense.open_set import NUMBERS, evidence
from hbr.dense.whitening import unit_rows
from hbr.descriptors import descriptor
from hbr.descriptors.shift import Shift

#: Strengths of the changes, in turn; 1 is a hard change of the bench.
STRENGTHS: Final = (0.0, 0.25, 0.5, 1.0, 1.3)
#: Probabilities of one, two and three segmentations of a view, as searches without an empty-table image have them.
_SEVERAL: Final = (0.45, 0.35, 0.2)
#: Strength of the change in further segmentations, which are worse: relative to the first one, and the smallest.
_WORSE: Final = 1.6
_LEAST_WORSE: Final = 0.7
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
        Whether the object is the leading candidate, if it is enrolled.
    """

    strength: FloatArray
    known: FloatArray
    unknown: FloatArray
    correct: NDArray[np.bool_]


def can_shift(index: DenseIndex) -> bool:
    """Return whether the descriptor can compute its levels on another bench."""
    kind = descriptor(index.views.descriptor)
    row = index.views.levels(np.array([0]))[0]
    hard = Shift.drawn(np.random.default_rng(_SEED), 2.0)
    return not np.array_equal(kind.shifted(row, hard), row)


def shifted_searches(index: DenseIndex, *, views: int, searches: int) -> ShiftedSearches:
    """Search for the objects of an index in turn, each time with the same number of views.

    Objects with fewer views are left out. Every object is searched for under each strength before one is repeated.

    Raises
    ------
    ValueError
        No object has enough views.
    """
    kind = descriptor(index.views.descriptor)
    rng = np.random.default_rng(_SEED)
    rows_of = [index.rows[place, :count] for place, count in enumerate(index.view_counts)]
    places = [place for place, rows in enumerate(rows_of) if len(rows) >= max(2, views)]
    if not places:
        raise ValueError(f"no object has {max(2, views)} views; enroll more of each, or search with fewer views")
    every = np.arange(len(index.views))
    white = index.whitening.white(index.views.levels(every)) if len(every) <= _MOST_VIEWS else None
    strength, known, unknown, correct = [], [], [], []
    for n in range(searches):
        place = places[n % len(places)]
        rows = rows_of[place]
        azimuth_deg = index.views.azimuth_deg[rows]
        chosen = spread(azimuth_deg, int(rng.integers(len(rows))), views)
        # a different strength in each round, and for neighbouring objects
        strength.append(STRENGTHS[(n // len(places) + n) % len(STRENGTHS)])
        pairs = [index.views.levels(rows[[i, (i + 1) % len(rows)]]) for i in chosen]
        queries = [_segmentations(kind.shifted, pair, strength[-1], rng) for pair in pairs]
        own, left_out, right = _numbers(index, place, rows, queries, azimuth_deg[chosen], white)
        known.append(own)
        unknown.append(left_out)
        correct.append(right)
    return ShiftedSearches(np.array(strength), np.array(known), np.array(unknown), np.array(correct))


def _segmentations(
    shifted: Callable[[LevelArray, Shift], LevelArray], pair: LevelArray, strength: float, rng: np.random.Generator
) -> LevelArray:
    """Return a view by one to three segmentations, a row for each."""
    more = int(rng.choice(len(_SEVERAL), p=_SEVERAL))
    strengths = [strength, *[max(_LEAST_WORSE, _WORSE * strength)] * more]
    return np.stack([_mixed_view(shifted, pair, one, rng) for one in strengths])


def _mixed_view(
    shifted: Callable[[LevelArray, Shift], LevelArray], pair: LevelArray, strength: float, rng: np.random.Generator
) -> LevelArray:
    """Return a view between two enrolled ones, on a changed bench: each entry comes from one of the two."""
    share = rng.uniform(0, 0.5)
    between = np.where(rng.random(pair.shape[1]) < share, pair[1], pair[0]).astype(np.uint8)
    return shifted(between, Shift.drawn(rng, strength))


def _numbers(
    index: DenseIndex,
    place: int,
    rows: IndexArray,
    queries: list[LevelArray],
    azimuth_deg: FloatArray,
    white: FloatArray | None,
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    def whitened(some: IndexArray) -> FloatArray:
        return index.whitening.white(index.views.levels(some)) if white is None else white[some]

    left_out = index.whitening.without(rows)
    in_white = [index.whitening.white(query) for query in queries]
    units, others = [unit_rows(one) for one in in_white], [left_out.unit(one) for one in in_white]
    support = np.zeros((len(index), BINS), np.float32)
    known, unknown = np.zeros((2, len(queries), len(NUMBERS)))
    correct = np.zeros(len(queries), np.bool_)
    for n, query in enumerate(queries):
        similar = index.compared.similarity(query).max(axis=0)
        support += index.support(similar, float(azimuth_deg[n] - azimuth_deg[0]))
        so_far = index, support, azimuth_deg[: n + 1], queries[: n + 1]
        best, known[n] = evidence(*so_far, units=units[: n + 1], enrolled=lambda some: unit_rows(whitened(some)))
        _, unknown[n] = evidence(
            *so_far, units=others[: n + 1], enrolled=lambda some: left_out.unit(whitened(some)), without=place
        )
        correct[n] = best == place
    return known, unknown, correct
