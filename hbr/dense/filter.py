"""The dense Hough filter: the support of all views so far for every object at every azimuth.

The paper's voting (`hbr.retrieve`) follows the few views on its lists. This filter has a score for every hypothesis
(j, φ): object j with azimuth φ at the first query. A query i, rotated by r_i since the first, adds

    s_i(j, φ + r_i) = max_k [T(q_i, c_jk)^p - ω · away(φ + r_i, k) / 360]

where k runs over all views of the object and away is how far the azimuth lies outside the arc of view k, which reaches
half-way to its neighbours: an azimuth between two views is as good as one on a view, also if a view is missing.
The power p gives a query near an enrolled view more weight than one between two views.

Decision: docs/decisions/0025.
"""

from copy import copy
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap180, wrap360
from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.descriptors import descriptor
from hbr.model.views import Views

#: As for `Belief.posterior`: fits the similarities of the bench's own descriptor.
BETA: Final = 30.0
#: Number of azimuths at the first query.
BINS: Final = 72
_BIN_DEG: Final = 360 / BINS
#: Number of objects that are considered after the first view.
KEPT: Final = 500
#: How fast a bin's weight in the mean azimuth falls with its support.
_POSE_SHARPNESS: Final = 60.0
#: An azimuth leans to what lies so many degrees aside at most, and where the support falls by so much at least.
_FARTHEST_LEAN_DEG: Final = 90.0
_LEAST_FALL: Final = 1e-6
#: Degrees that no azimuth reaches.
_FAR_DEG: Final = 2000.0

Floats = NDArray[np.float32]


class DenseIndex:
    """Enrolled views, prepared for the dense filter.

    Parameters
    ----------
    views : Views
        Of any descriptor. Objects without views are left out.
    omega : float
        Weight ω of the orientation, per revolution.
    power : float
        p, of the similarities; 1 for the plain sum.
    """

    def __init__(self, views: Views, *, omega: float = 2.0, power: float = 4.0) -> None:
        if not (np.isfinite(omega) and omega >= 0):
            raise ValueError(f"omega is {omega}; a finite weight of at least 0 is needed, 2 by default")
        if not (np.isfinite(power) and power >= 1):
            raise ValueError(f"power is {power}; a finite one of at least 1 is needed, 4 by default")
        if not len(views):
            raise ValueError("there are no views; enroll at least one object first")
        self.views = views
        self.omega = omega
        self.power = power
        self.object_index: IndexArray = np.unique(views.object_index)
        self.compared = descriptor(views.descriptor).prepared(views.descriptors)
        rows, begin = views.of_each(self.object_index)
        count = np.diff(begin, append=len(rows))
        inside = np.arange(count.max()) < count[:, None]
        rows = rows[np.lexsort((views.azimuth_deg[rows], np.repeat(np.arange(len(count)), count)))]
        #: Rows of each object's views by rising azimuth, padded by the first of them.
        self.rows = np.repeat(rows[begin][:, None], count.max(), axis=1)
        self.rows[inside] = rows
        #: Where `rows` is padding, or a view that was left out.
        self.left_out = ~inside
        self.azimuth_deg: FloatArray = views.azimuth_deg[self.rows]
        #: The usual spacing of each object's views.
        self.spacing_deg: FloatArray = np.array(
            [_spacing(own[ok]) for own, ok in zip(self.azimuth_deg, inside, strict=True)]
        )
        self._arrange()

    def __len__(self) -> int:
        return len(self.object_index)

    def without(self, views: IndexArray) -> "DenseIndex":
        """Return an index that leaves out some views; each object must keep at least one."""
        fewer = copy(self)
        fewer.left_out = self.left_out | np.isin(self.rows, views)
        if fewer.left_out.all(axis=1).any():
            raise ValueError("an object would be left without any view; leave out fewer")
        fewer._arrange()
        return fewer

    def only(self, places: IndexArray) -> "DenseIndex":
        """Return an index of some objects alone, whose later steps do not look at the others."""
        fewer = copy(self)
        rows = np.unique(self.rows[places])
        fewer.views = self.views.select(rows)
        fewer.compared = self.compared.only(rows)
        fewer.object_index = self.object_index[places]
        fewer.rows = np.searchsorted(rows, self.rows[places])
        fewer.left_out, fewer.azimuth_deg = self.left_out[places], self.azimuth_deg[places]
        fewer.spacing_deg = self.spacing_deg[places]
        fewer._arrange()
        return fewer

    def _arrange(self) -> None:
        """Lay two turns of every object's views out in rows, each with the arc on which it is the nearest.

        From half a turn before 0 on: a copy of each view is within half a turn of any azimuth.
        """
        first_deg = np.where(self.azimuth_deg < 180, self.azimuth_deg, self.azimuth_deg - 360)
        first_deg = np.where(self.left_out, np.inf, first_deg)
        unrolled_deg = np.concatenate([first_deg, first_deg + 360], axis=1)
        places = np.argsort(unrolled_deg, axis=1, kind="stable")
        ring_deg = np.take_along_axis(unrolled_deg, places, axis=1)
        with np.errstate(invalid="ignore"):  # what was left out stands at infinity, behind all others
            middle_deg = (ring_deg[:, 1:] + ring_deg[:, :-1]) / 2
        count = 2 * (~self.left_out).sum(axis=1)
        own = np.arange(places.shape[1]) < count[:, None]
        #: The view at each place of the two turns; behind them one beyond all.
        self._ring = np.where(own, np.take_along_axis(self.rows, places % self.rows.shape[1], axis=1), len(self.views))
        #: Where the arc of each view ends and the next one's begins; far away behind the last.
        ends_deg = np.where(own[:, 1:], middle_deg, _FAR_DEG)
        self._keys = (ends_deg + 2 * _FAR_DEG * np.arange(len(self))[:, None]).ravel()
        self._penalty = (ends_deg * (self.omega / 360)).astype(np.float32)

    def support(self, similar: FloatArray, turned_deg: float) -> Floats:
        """Return what one query adds to every hypothesis.

        Parameters
        ----------
        similar : float array (n,)
            Similarity of the query to every view.
        turned_deg : float
            Orientation since the first query, counter-clockwise.

        Returns
        -------
        float32 array (k, 72)
            For azimuths 0, 5, 10, ... at the first query.
        """
        whole, part_deg = divmod(turned_deg % 360.0, _BIN_DEG)
        seen_deg = part_deg + np.arange(BINS) * _BIN_DEG  # in this order the search below is quicker
        slope_at = (seen_deg * (self.omega / 360)).astype(np.float32)
        levels = np.append(np.maximum(similar, 0) ** self.power, -np.inf).astype(np.float32)
        own, penalty = levels[self._ring], self._penalty
        place = np.arange(len(self))[:, None]
        # the view on whose arc the azimuth lies, among all objects' rows
        nearest = np.searchsorted(self._keys, seen_deg + 2 * _FAR_DEG * place) + place
        # of the views before and behind a running maximum knows the best: the penalty is a straight line from its arc
        before, behind = np.full((2, *own.shape), -np.inf, np.float32)
        np.maximum.accumulate(own[:, :-1] + penalty, axis=1, out=before[:, 1:])
        np.maximum.accumulate((own[:, 1:] - penalty)[:, ::-1], axis=1, out=behind[:, -2::-1])
        best: Floats = np.maximum(before.ravel()[nearest] - slope_at, behind.ravel()[nearest] + slope_at)
        np.maximum(best, own.ravel()[nearest], out=best)
        return np.roll(best, -int(whole), axis=1)


@dataclass(frozen=True, eq=False)
class Belief:
    """The support of all views so far for every object at every azimuth.

    Attributes
    ----------
    index : DenseIndex
        The enrolled views of the objects that are still considered.
    support : float32 array (k, 72)
        A, the sum of what each query adds, at most their number; for azimuths 0, 5, ... at the first query.
    orientation_deg : float64 array (n,)
        Orientations of the camera around the object at the queries, from any zero.
    """

    index: DenseIndex
    support: Floats
    orientation_deg: FloatArray

    @property
    def queries(self) -> int:
        return len(self.orientation_deg)

    @property
    def turned_deg(self) -> float:
        """Orientation of the last query, from the first."""
        return float(self.orientation_deg[-1] - self.orientation_deg[0])

    def scores(self) -> FloatArray:
        """Score of every object considered: the power mean of the similarities at the best azimuth, 0..1."""
        mean = self.support.max(axis=1).astype(np.float64) / self.queries
        scores: FloatArray = np.maximum(mean, 0) ** (1 / self.index.power)
        return scores

    def ranking(self) -> "DenseRanking":
        """The objects considered, best first."""
        scores = self.scores()
        order = np.argsort(-scores, kind="stable")
        azimuth_deg = self._azimuth_deg(order) + self.turned_deg
        return DenseRanking(self.index.object_index[order], scores[order], wrap360(azimuth_deg))

    def _azimuth_deg(self, which: IndexArray) -> FloatArray:
        """Azimuth at the first query of these objects, finer than the bins and than the enrolled views.

        In the dead zone around an enrolled view all bins are equal: first their middle, the mean weighted by the
        support. Then the support a step to either side tells to which of the neighbours it leans, as if it fell off
        evenly on both sides of the true azimuth.
        """
        support = self.support[which].astype(np.float64)
        best = support.argmax(axis=1)
        step = np.minimum(self.index.spacing_deg[which], _FARTHEST_LEAN_DEG) / _BIN_DEG
        reach = np.maximum(1, np.rint(1.25 * self.index.spacing_deg[which] / _BIN_DEG)).astype(int)
        offset = np.arange(-BINS // 2, BINS // 2)
        near = np.take_along_axis(support, (best[:, None] + offset) % BINS, axis=1)
        weight = np.exp(_POSE_SHARPNESS * (near - near.max(axis=1, keepdims=True)))
        weight *= np.abs(offset) <= reach[:, None]
        middle = best + (weight * offset).sum(axis=1) / weight.sum(axis=1)
        before, here, behind = (_between(support, middle + side * step) for side in (-1, 0, 1))
        fall = here - np.minimum(before, behind)
        lean = np.divide(behind - before, fall, out=np.zeros_like(fall), where=fall > _LEAST_FALL)
        azimuth_deg: FloatArray = (middle + np.clip(lean, -1, 1) * step / 2) * _BIN_DEG
        return azimuth_deg

    def posterior(self, beta: float = BETA) -> FloatArray:
        """Return the probability of every hypothesis, (k, 72): proportional to exp(β A / √n).

        The root reduces it: views of one object are not independent, and each adds less than the one before.
        """
        exponent = self.support.astype(np.float64) * (beta / np.sqrt(self.queries))
        weights = np.exp(exponent - exponent.max())
        probability: FloatArray = weights / weights.sum()
        return probability


@dataclass(frozen=True, eq=False)
class DenseRanking:
    """The objects that the filter considers, best first.

    Attributes
    ----------
    object_index : integer array (k,)
        Equal scores by lower index.
    scores : float64 array (k,)
        As `Belief.scores`.
    pose_deg : float64 array (k,)
        Orientation of the camera around each object at the last query, in [0, 360).
    """

    object_index: IndexArray
    scores: FloatArray
    pose_deg: FloatArray


def update_belief(
    query: LevelArray, orientation_deg: float, so_far: DenseIndex | Belief, *, kept: int = KEPT
) -> Belief:
    """Add a query to the belief.

    Parameters
    ----------
    query : uint8 array (length,)
        The view, described as the enrolled ones are.
    orientation_deg : float
        Orientation of the camera around the object, counter-clockwise, from any zero that all queries share.
    so_far : DenseIndex or Belief
        The enrolled views for the first query, the belief so far for any other.
    kept : int
        Objects that are considered further after the first query: those with the most similar views.

    Raises
    ------
    TypeError, ValueError
        The query is no view of the index's descriptor, the orientation is not finite, or `kept` is below 1.
    """
    index = so_far.index if isinstance(so_far, Belief) else so_far
    query = np.asarray(query)
    length = index.views.descriptors.shape[1]
    if query.dtype != np.uint8 or query.shape != (length,):
        raise ValueError(
            f"the query is {query.dtype} of shape {query.shape}; {index.views.descriptor} has uint8 of ({length},)"
        )
    if not np.isfinite(orientation_deg):
        raise ValueError(f"orientation_deg is {orientation_deg}; a finite angle is needed")
    if kept < 1:
        raise ValueError(f"kept is {kept}; at least 1 object is needed")
    similar = index.compared.similarity(query[None])[0]
    if isinstance(so_far, Belief):
        turned_deg = float(wrap180(orientation_deg - so_far.orientation_deg[0]))
        support = so_far.support + index.support(similar, turned_deg)
        return Belief(index, support, np.append(so_far.orientation_deg, orientation_deg))
    if len(index) > kept:
        best = np.where(index.left_out, -np.inf, similar[index.rows]).max(axis=1)
        index = index.only(np.sort(np.argsort(-best, kind="stable")[:kept]))
        similar = index.compared.similarity(query[None])[0]
    return Belief(index, index.support(similar, 0.0), np.array([orientation_deg], np.float64))


def _between(support: FloatArray, bins: FloatArray) -> FloatArray:
    """Support of each object, a row, at its place between two bins."""
    rows, low = np.arange(len(support)), np.floor(bins)
    share = bins - low
    at = low.astype(int)
    value: FloatArray = support[rows, at % BINS] * (1 - share) + support[rows, (at + 1) % BINS] * share
    return value


def _spacing(azimuth_deg: FloatArray) -> float:
    """The usual step between neighbouring views; 360 of a single one."""
    ring = np.sort(azimuth_deg)
    return float(np.median(np.diff(ring, append=ring[0] + 360)))
