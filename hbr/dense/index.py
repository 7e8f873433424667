"""Enrolled views, prepared for the dense Hough filter: the support that one query adds to every hypothesis.

A query i, rotated by r_i since the first, adds to the hypothesis (j, φ), object j with azimuth φ at the first query,

    s_i(j, φ + r_i) = max_k [T(q_i, c_jk)^p - ω · away(φ + r_i, k) / 360]

where k runs over all views of the object, and away is the distance of the azimuth from the arc of view k. This arc
reaches half-way to the neighbouring views, so an azimuth between two views has no penalty, even if a view is missing.
The power p gives a query near an enrolled view more weight than one between two views.

Whitened descriptions, in which the properties that distinguish the enrolled views count most, are for the open-set
score. Source: B. Hariharan, J. Malik and D. Ramanan, "Discriminative decorrelation for clustering and classification",
ECCV 2012.

Decision: docs/decisions/0014.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import size_deg
from hbr.core.arrays import FloatArray, IndexArray, LevelArray, lengths, ranges
from hbr.descriptors import Packed, descriptor
from hbr.kernels import calls
from hbr.model.views import Views

#: Share of the mean variance that is added to all variances before whitening.
_SHRINKAGE: Final = 0.3  # smaller: directions with little variance, which are mostly noise, count as much as all others
#: Largest number of views from which the whitening is computed.
_MOST: Final = 4096
#: Largest number of descriptions that are remembered, 18 MB.
_MOST_REMEMBERED: Final = 4096


class Whitening:
    """Whitening of the descriptions of a catalog; computed when it is first used."""

    def __init__(self, views: Views) -> None:
        self._views = views
        self._known: dict[bytes, FloatArray] = {}

    @cached_property
    def _rows(self) -> IndexArray:
        count = min(len(self._views), _MOST)
        rows: IndexArray = np.unique(np.linspace(0, len(self._views) - 1, count).astype(int))
        return rows

    @cached_property
    def _transform(self) -> tuple[FloatArray, FloatArray]:
        entries = descriptor(self._views.descriptor).entries(self._views.levels(self._rows))
        mean = entries.mean(axis=0)
        apart = entries - mean
        covariance = apart.T @ apart / max(1, len(apart) - 1)
        size = len(covariance)
        covariance += (_SHRINKAGE * np.trace(covariance) / size + 1e-12) * np.eye(size)
        # with C = L Lᵀ, products of L⁻¹ a and L⁻¹ b are those of any whitening
        return mean, np.linalg.inv(np.linalg.cholesky(covariance)).T

    def white(self, levels: LevelArray) -> FloatArray:
        """Return whitened descriptions, (n, d), of levels, uint8 (n, length)."""
        mean, transform = self._transform
        white: FloatArray = (descriptor(self._views.descriptor).entries(levels) - mean) @ transform
        return white

    def unit(self, levels: LevelArray) -> FloatArray:
        """Return whitened descriptions of unit length, (n, d), of levels, uint8 (n, length).

        A search needs the same few rows after each view; they are computed once.
        """
        if len(levels) > _MOST_REMEMBERED // 8:
            return unit_rows(self.white(levels))
        keys = [row.tobytes() for row in levels]
        if len(self._known) > _MOST_REMEMBERED:
            self._known = {}
        known = self._known  # this call uses one cache, even if another thread begins a new one
        missing = {key: i for i, key in enumerate(keys) if key not in known}
        if missing:
            known.update(zip(missing, unit_rows(self.white(levels[list(missing.values())])), strict=True))
        return np.array([known[key] for key in keys])

    def without(self, rows: IndexArray) -> Callable[[FloatArray], FloatArray]:
        """Return the whitening as if k views were not enrolled, without computing it again.

        If C is the covariance with these views and U has their distances from the mean as columns, the covariance
        without them is C - U Uᵀ (the mean stays). By the Woodbury identity its inverse is
        C⁻¹ + C⁻¹ U (I - Uᵀ C⁻¹ U)⁻¹ Uᵀ C⁻¹. The second part adds entries to each whitened description, one for each
        view that is left out.

        Returns
        -------
        callable
            Returns descriptions of unit length, (n, d + k), of those that `white` returns, (n, d).
        """
        used = rows[np.isin(rows, self._rows)]
        own = self.white(self._views.levels(used)) / np.sqrt(max(1, len(self._rows) - 1))
        more = own.T @ np.linalg.cholesky(np.linalg.inv(np.eye(len(own)) - own @ own.T))
        return lambda white: unit_rows(np.hstack([white, white @ more]))


def unit_rows(white: FloatArray) -> FloatArray:
    """Return rows of unit length; rows of zeros stay."""
    length = np.sqrt(np.einsum("ij,ij->i", white, white))[:, None]
    unit: FloatArray = np.divide(white, length, out=np.zeros_like(white), where=length > 0)
    return unit


#: Number of azimuths at the first query.
BINS: Final = 72
BIN_DEG: Final = 360 / BINS
#: p, of the similarities.
POWER: Final = 4.0  # the eighth is equally good, the second worse (decision 0014)
#: An angle in degrees that is larger than every azimuth.
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
    """

    def __init__(self, views: Views, *, omega: float = 2.0) -> None:
        if not (np.isfinite(omega) and omega >= 0):
            raise ValueError(f"omega is {omega}; a finite weight of at least 0 is needed, 2 by default")
        if not len(views):
            raise ValueError("there are no views; enroll at least one object first")
        self.views = views
        self.omega = omega
        self.object_index: IndexArray = np.flatnonzero(np.bincount(views.object_index))
        self._prepare()
        order, begin = views.of_each(self.object_index)
        count = lengths(begin, len(order))
        rising = np.diff(views.azimuth_deg[order], prepend=0) >= 0
        rising[begin] = True
        if not rising.all():
            order = order[np.lexsort((views.azimuth_deg[order], np.repeat(np.arange(len(count)), count)))]
        self._set_segments(order, begin, count)

    def __len__(self) -> int:
        return len(self.object_index)

    def _copied(self) -> "DenseIndex":
        copied = object.__new__(DenseIndex)
        copied.__dict__.update(self.__dict__)
        return copied

    def __getstate__(self) -> dict[str, object]:
        """Return what another process needs; it prepares the views for comparison itself."""
        return {name: self.__dict__[name] for name in ("views", "omega", "object_index", "_segments")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._prepare()

    def _prepare(self) -> None:
        self.compared = self.views.prepared()
        self.whitening = Whitening(self.views)

    def without(self, views: IndexArray) -> "DenseIndex":
        """Return an index that leaves out some views; each object must keep at least one."""
        fewer = self._copied()
        kept = ~np.isin(self._segments.order, views)
        count = np.add.reduceat(kept, self._segments.begin)
        if not count.all():
            raise ValueError("an object would be left without any view; leave out fewer")
        fewer._set_segments(self._segments.order[kept], np.cumsum(count) - count, count)
        return fewer

    def only(self, places: IndexArray) -> "DenseIndex":
        """Return an index of some objects alone; a search of it ignores the others."""
        fewer = self._copied()
        own, begin = ranges(self._segments.begin[places], self._segments.lengths[places])
        order = self._segments.order[own]
        rows = order if (np.diff(order) > 0).all() else np.sort(order)
        fewer.views = self.views.select(rows)
        fewer.compared = self.compared.only(rows)
        fewer.object_index = self.object_index[places]
        order = np.arange(len(rows)) if rows is order else np.searchsorted(rows, order)
        fewer._set_segments(order, begin, self._segments.lengths[places])
        return fewer

    def _set_segments(self, order: IndexArray, begin: IndexArray, count: IndexArray) -> None:
        """Set the views of each object: ``count`` of the rows ``order`` from ``begin`` on, by rising azimuth."""
        self._segments = calls.Segments(order, begin, count, bool((np.diff(order, prepend=-1) == 1).all()))
        for name in ("rows", "left_out", "azimuth_deg", "_ring"):
            self.__dict__.pop(name, None)  # cached values of the index that this one was copied from

    @cached_property
    def rows(self) -> IndexArray:
        """Rows of each object's views by rising azimuth, padded with the first of them."""
        columns = np.arange(self._segments.lengths.max())
        rows: IndexArray = self._segments.order[
            self._segments.begin[:, None] + np.where(columns < self._segments.lengths[:, None], columns, 0)
        ]
        return rows

    @cached_property
    def left_out(self) -> NDArray[np.bool_]:
        """Mask of the places at which `rows` has padding."""
        padding: NDArray[np.bool_] = np.arange(self._segments.lengths.max()) >= self._segments.lengths[:, None]
        return padding

    @cached_property
    def azimuth_deg(self) -> FloatArray:
        """Azimuths of `rows`."""
        return self.views.azimuth_deg[self.rows]

    def similarity(self, query: LevelArray) -> FloatArray:
        """Return the similarity of every view to a query, (n,): of several segmentations, (h, length), the largest."""
        similar = self.compared.similarity(np.atleast_2d(query))
        most: FloatArray = similar[0] if len(similar) == 1 else similar.max(axis=0)
        return most

    def best(self, query: LevelArray) -> FloatArray:
        """Return the largest similarity of each object's views to a query, (k,)."""
        similar = self.similarity(query)
        best: FloatArray = np.maximum.reduceat(similar[self._segments.order], self._segments.begin)
        return best

    def bounds(self, query: LevelArray) -> FloatArray:
        """Return a bound of the support that a query adds to each object at any azimuth, (k,)."""
        compared = self.compared
        if isinstance(compared, Packed):
            most = np.max([compared.bounds(row, self._segments) for row in np.atleast_2d(query)], axis=0)
        else:
            most = self.best(query)
        return raised(most).astype(np.float64)

    def nearest(self, query: LevelArray, kept: int) -> IndexArray:
        """Return the objects with the most similar views, ascending places (kept,); of equal ones, the first."""
        if not isinstance(self.compared, Packed):
            return np.sort(np.argsort(-self.best(query), kind="stable")[:kept])
        nearest = [self.compared.nearest(row, self._segments, kept) for row in np.atleast_2d(query)]
        if len(nearest) == 1:
            return nearest[0]
        # an object is among the best if the row with its largest similarity is
        places = np.unique(np.concatenate(nearest))
        return places[np.sort(np.argsort(-self.only(places).best(query), kind="stable")[:kept])]

    @property
    def view_counts(self) -> IndexArray:
        """Number of views of each object."""
        return self._segments.lengths

    def rows_of(self, place: int) -> IndexArray:
        """Return the rows of the views of the object at a place, by rising azimuth."""
        begin = self._segments.begin[place]
        return self._segments.order[begin : begin + self._segments.lengths[place]]

    def nearest_views(self, places: IndexArray, at_deg: FloatArray, count: int) -> IndexArray:
        """Return the rows of the views that are nearest to azimuths, (m, n, count), for objects (m,) and (m, n).

        Of equally near views, the one with the smaller azimuth comes first. If an object has fewer views, some are
        repeated.
        """
        away_deg = size_deg(self.azimuth_deg[places, None] - at_deg[..., None])
        away_deg[np.broadcast_to(self.left_out[places, None], away_deg.shape)] = np.inf
        nearest = np.empty((*at_deg.shape, count), np.intp)
        for n in range(count):  # faster than a sort: only a few are wanted
            nearest[..., n] = away_deg.argmin(axis=2)
            np.put_along_axis(away_deg, nearest[..., n : n + 1], np.inf, axis=2)
        again = np.arange(count) % self._segments.lengths[places, None]
        nearest = np.take_along_axis(nearest, np.broadcast_to(again[:, None], nearest.shape), axis=2)
        rows: IndexArray = self.rows[places[:, None, None], nearest]
        return rows

    def nearest_view(self, place: IndexArray, at_deg: FloatArray) -> tuple[IndexArray, FloatArray]:
        """Return the view of each object, (m,), that is nearest to an azimuth, (a, m), and its distance in degrees.

        Of equally near views, the one with the smaller azimuth is returned.
        """
        compiled = calls.nearest_view(self._segments, self.views.azimuth_deg, place, at_deg)
        if compiled is not None:
            return compiled
        rows = self.nearest_views(place, at_deg.T, 1)[:, :, 0].T
        return rows, size_deg(self.views.azimuth_deg[rows] - at_deg)

    @cached_property
    def _ring(self) -> tuple[IndexArray, FloatArray, Floats]:
        """Two revolutions of every object's views in rows, the ends of their arcs, and the penalty at these ends.

        They begin at -180°.
        """
        first_deg = np.where(self.azimuth_deg < 180, self.azimuth_deg, self.azimuth_deg - 360)
        first_deg = np.where(self.left_out, np.inf, first_deg)
        unrolled_deg = np.concatenate([first_deg, first_deg + 360], axis=1)
        places = np.argsort(unrolled_deg, axis=1, kind="stable")
        ring_deg = np.take_along_axis(unrolled_deg, places, axis=1)
        with np.errstate(invalid="ignore"):  # padding is at infinity, behind all views
            middle_deg = (ring_deg[:, 1:] + ring_deg[:, :-1]) / 2
        own = np.arange(places.shape[1]) < 2 * self._segments.lengths[:, None]
        # the view at each place of the two revolutions; behind them an index beyond all views
        ring = np.where(own, np.take_along_axis(self.rows, places % self.rows.shape[1], axis=1), len(self.views))
        # the end of each view's arc, where the next one begins; the last one is far away
        ends_deg = np.where(own[:, 1:], middle_deg, _FAR_DEG)
        keys = (ends_deg + 2 * _FAR_DEG * np.arange(len(self))[:, None]).ravel()
        return ring, keys, (ends_deg * (self.omega / 360)).astype(np.float32)

    def support(self, similar: FloatArray, rotated_deg: float) -> Floats:
        """Return the support that one query adds to every hypothesis.

        Parameters
        ----------
        similar : float array (n,)
            Similarity of the query to every view.
        rotated_deg : float
            Orientation since the first query in degrees, counter-clockwise.

        Returns
        -------
        float32 array (k, 72)
            For azimuths 0, 5, 10, ... at the first query.
        """
        whole, part_deg = divmod(rotated_deg % 360.0, BIN_DEG)
        levels = raised(similar)
        slope = self.omega / 360
        azimuth_deg = self.views.azimuth_deg
        compiled = calls.support(self._segments, azimuth_deg, levels, slope, part_deg, int(whole))
        if compiled is not None:
            return compiled
        ring, keys, penalty = self._ring
        seen_deg = part_deg + np.arange(BINS) * BIN_DEG  # in this order the search below is quicker
        slope_at = (seen_deg * slope).astype(np.float32)
        own = np.append(levels, np.float32(-np.inf))[ring]
        place = np.arange(len(self))[:, None]
        # the view on whose arc the azimuth lies, among all objects' rows
        nearest = np.searchsorted(keys, seen_deg + 2 * _FAR_DEG * place) + place
        # running maxima find the best views before and behind: outside of an arc, its penalty is a straight line
        before, behind = np.full((2, *own.shape), -np.inf, np.float32)
        np.maximum.accumulate(own[:, :-1] + penalty, axis=1, out=before[:, 1:])
        np.maximum.accumulate((own[:, 1:] - penalty)[:, ::-1], axis=1, out=behind[:, -2::-1])
        best: Floats = np.maximum(before.ravel()[nearest] - slope_at, behind.ravel()[nearest] + slope_at)
        np.maximum(best, own.ravel()[nearest], out=best)
        # a third revolution: beside a gap, the nearest end of an arc may belong to a view that is up to 270° away
        count, revolution = self._segments.lengths[:, None], np.float32(slope * 360)
        np.maximum(best, before[place, count] - revolution - slope_at, out=best)
        np.maximum(best, behind[place, count - 1] - revolution + slope_at, out=best)
        return np.roll(best, -int(whole), axis=1)


def raised(similar: FloatArray) -> Floats:
    """Return the similarities to the power p = 4, by products, which are the same on every computer."""
    raised = np.square(np.maximum(similar, 0))
    return np.square(raised, out=raised).astype(np.float32)
