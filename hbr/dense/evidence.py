"""The evidence that the leading candidate of a search is the object on the table, as a few numbers.

An absolute similarity means little after a change of the bench: it falls for an enrolled object, too. Therefore the
numbers compare the leader with other candidates under the same conditions, and with what its own enrolled views would
show: a view between two enrolled ones resembles both about as much as they resemble each other. An object that is not
enrolled, and looks like the leader, resembles them less.

Source for the comparison with a cohort: R. Auckenthaler, M. Carey and H. Lloyd-Thomas, "Score normalization for
text-independent speaker verification systems", Digital Signal Processing 10, 2000.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import size_deg
from hbr.core.arrays import FloatArray, IndexArray
from hbr.dense.filter import Belief
from hbr.dense.index import BIN_DEG, DenseIndex
from hbr.dense.space import Floats

#: Candidates that the leader is compared with.
_COHORT: Final = 10  # more: less noise, and less similar objects, whose similarities say less about the leader
#: Enrolled views next to the estimated pose that are compared.
_NEXT: Final = 3

#: The number of numbers that do not depend on the parts of the descriptor; they come first.
COMMON: Final = 8
#: No search had enrolled views nearer to each other, or more queries, when the weights were fitted.
_LEAST_APART_DEG: Final = 10.0
_MOST_QUERIES: Final = 4.0
#: A candidate is a near twin of the leader if its z of the leader's own view is at least this share of the leader's.
# twins on the simulated bench have 0.99 from the sides where they look the same; different cups, apples or cars 0.75
_TWIN_FROM: Final = 0.9
#: Smaller leads count as this one in ratios and logarithms: they are noise.
_LEAST_LEAD: Final = 0.5


def numbers(belief: Belief, leader: int) -> FloatArray:
    """Return the numbers for the object at a place of the belief's index, float64 (8 + 2 p,), of p uses of parts.

    A lead is by how much z exceeds the mean z of a cohort, the next candidates; it is a mean over the queries, by their
    weights. The numbers are:

    - the lead, and the share of it that the second candidate does not have,
    - the lead, relative to the lead that the two enrolled views beside the estimated azimuth have among each other,
    - the logarithms of the lead that is expected of a view between these two, and of the same over the best of the
      cohort instead of its mean: how different the leader is from the cohort,
    - the lead of the leader's most different side, relative to the same as the third number: how much the enrolled view
      that resembles those at the estimated poses least resembles them. An object that is not enrolled may differ there,
    - the logarithms of the mean distance of the leader's enrolled views in degrees, and of the number of queries,
    - the lead of each use of a part, and its z.

    A near twin of the leader, which looks the same from the sides that were seen, is no other candidate: it says
    nothing about objects that are not enrolled. Without another candidate, the others have z = 0.
    """
    index, space = belief.index, belief.index.space
    weights = np.ones(belief.queries) if belief.weights is None else belief.weights
    share = weights / weights.sum()
    best = belief.support.max(axis=1) / belief.amount
    order = np.argsort(-best, kind="stable")
    places: IndexArray = np.concatenate([[leader], order[order != leader][:_COHORT]])
    rows, away_deg = _views_at_pose(belief, places)
    uses = [_uses(query, index.vectors[rows[:, n]], space.begin) for n, query in enumerate(belief.vectors)]
    each: FloatArray = np.einsum("n,nmp->mp", share, uses) - space.usual
    profile, between = _profile(belief, share, rows, away_deg)
    is_other = profile < _TWIN_FROM * profile[0]
    is_other[0] = False
    if is_other.any():
        most, mean = best[places[is_other]].max(), best[places[is_other]].mean()
        expected_most, expected_mean = profile[is_other].max(), profile[is_other].mean()
        others = each[is_other].mean(axis=0)
    else:
        most = mean = expected_most = expected_mean = others = 0.0
    lead = best[leader] - mean
    expected = np.maximum(
        [between - expected_mean, profile[0] - expected_mean, profile[0] - expected_most], _LEAST_LEAD
    )
    apart_deg = max(360 / len(index.rows_of(leader)), _LEAST_APART_DEG)
    queries = min(max(belief.amount, 1.0), _MOST_QUERIES)
    unseen = max((_most_different(index, leader, rows[0, :, :2]) - expected_mean) / expected[0], -1.0)
    common = [lead, (best[leader] - most) / max(lead, _LEAST_LEAD), lead / expected[0], *np.log(expected[1:]), unseen]
    return np.array([*common, *np.log([apart_deg, queries]), *(each[0] - others), *each[0]])


def _most_different(index: DenseIndex, place: int, seen: IndexArray) -> float:
    """Return z of an object's view and the most similar of its ``seen`` views, of the view for which it is least."""
    vectors, space = index.vectors, index.space
    return float((vectors[seen.ravel()] @ vectors[index.rows_of(place)].T).max(axis=0).min() - space.usual.sum())


def near_twins(belief: Belief, leader: int, places: IndexArray) -> NDArray[np.bool_]:
    """Return which objects, at some places of the belief's index, look like the leader in the views so far."""
    share = np.full(belief.queries, 1 / belief.queries)
    profile, _ = _profile(belief, share, *_views_at_pose(belief, np.concatenate([[leader], places])))
    found: NDArray[np.bool_] = profile[1:] >= _TWIN_FROM * profile[0]
    return found


def _views_at_pose(belief: Belief, places: IndexArray) -> tuple[IndexArray, FloatArray]:
    """Return the enrolled views nearest to the likeliest pose of some objects, by query, (m, n, k).

    The distances of the first object's two nearest ones are (n, 2), in degrees.
    """
    index = belief.index
    seen_deg = belief.support[places].argmax(axis=1)[:, None] * BIN_DEG + (
        belief.orientation_deg - belief.orientation_deg[0]
    )
    rows = index.nearest_views(places, seen_deg, _NEXT)
    return rows, size_deg(index.views.azimuth_deg[rows[0, :, :2]] - seen_deg[0, :, None])


def _profile(belief: Belief, share: FloatArray, rows: IndexArray, away_deg: FloatArray) -> tuple[FloatArray, float]:
    """Return the means of `_expected` over the queries, by their shares."""
    usual, vectors = float(belief.index.space.usual.sum()), belief.index.vectors
    each = [_expected(vectors[rows[:, n]], away_deg[n], usual) for n in range(belief.queries)]
    profile: FloatArray = share @ [one for one, _ in each]
    return profile, float(share @ [between for _, between in each])


def _uses(query: Floats, near: Floats, begin: IndexArray) -> FloatArray:
    """Return what each use of a part adds to the best of the products of hypotheses (h, d) and views (m, k, d)."""
    products = np.einsum("hd,mkd->mhk", query, near).reshape(len(near), -1)
    hypothesis, view = np.divmod(products.argmax(axis=1), near.shape[1])
    chosen = query[hypothesis] * near[np.arange(len(near)), view]
    added: FloatArray = np.add.reduceat(chosen, begin, axis=1).astype(np.float64)
    return added


def _expected(near: Floats, away_deg: FloatArray, usual: float) -> tuple[FloatArray, float]:
    """Return z of candidates that a view of the leader would have, (m,), and z of its two nearest views to each other.

    ``near`` has the nearest views of the candidates, (m, k, d), the leader's first. The view lies between the leader's
    two nearest ones, at the distances ``away_deg`` from both.
    """
    z = np.einsum("td,mkd->tmk", near[0, :2], near).astype(np.float64) - usual
    whole = float(away_deg.sum())
    share = float(away_deg[0]) / whole if whole > 0 else 0.0
    profile: FloatArray = ((1 - share) * z[0] + share * z[1]).max(axis=1)
    return profile, float(z[0, 0, 1])
