"""Enrolled views, prepared for the dense Hough filter: the support that one query adds to every hypothesis.

A query i, rotated by r_i since the first, adds to the hypothesis (j, φ), object j with azimuth φ at the first query,

    s_i(j, φ + r_i) = max_k [z(q_i, c_jk) - ω · away(φ + r_i, k) / 360]

where k runs over all views of the object, z is the standardised similarity (`hbr.dense.space`), and away is the
distance of the azimuth from the arc of view k. This arc reaches half-way to the neighbouring views, so an azimuth
between two views has no penalty, even if a view is missing.

Decision: docs/decisions/0014.
"""

from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import size_deg
from hbr.core.arrays import FloatArray, IndexArray, LevelArray, lengths, ranges
from hbr.dense.space import Floats, Space
from hbr.descriptors import Comparison
from hbr.kernels import calls
from hbr.model.views import Views

#: Number of azimuths at the first query.
BINS: Final = 72
BIN_DEG: Final = 360 / BINS
#: ω, per revolution.
OMEGA: Final = 13.0
#: An angle in degrees that is larger than every azimuth.
_FAR_DEG: Final = 2000.0


class DenseIndex:
    """Enrolled views, prepared for the dense filter."""

    def __init__(self, views: Views, *, omega: float = OMEGA) -> None:
        if not (np.isfinite(omega) and omega >= 0):
            raise ValueError(f"omega is {omega}; a finite weight of at least 0 is needed, {OMEGA} by default")
        if not len(views):
            raise ValueError("there are no views; enroll at least one object first")
        self.views = views
        """Of any descriptor. Objects without views are left out."""
        self.omega = omega
        """Weight ω of the orientation, per revolution."""
        self.space = Space(views)
        """The space in which views are compared; an index of a part of the views has the space of all."""
        self.object_index: IndexArray = np.flatnonzero(np.bincount(views.object_index))
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

    @cached_property
    def vectors(self) -> Floats:
        """The views as vectors of the space, (n, d)."""
        return self.space.vectors(self.views.descriptors)

    def without(self, views: IndexArray) -> "DenseIndex":
        """Return an index that leaves out some views; each object must keep at least one."""
        fewer = self._copied()
        kept = ~np.isin(self._segments.order, views)
        count = np.add.reduceat(kept, self._segments.begin)
        if not count.all():
            raise ValueError("an object would be left without any view; leave out fewer")
        fewer._set_segments(self._segments.order[kept], np.cumsum(count) - count, count)
        return fewer

    def only(self, places: IndexArray, known: "DenseIndex | None" = None) -> "DenseIndex":
        """Return an index of some objects alone; a search of it ignores the others.

        The vectors of objects that are in another such index, ``known``, are not computed again.
        """
        fewer = self._copied()
        own, begin = ranges(self._segments.begin[places], self._segments.lengths[places])
        order = self._segments.order[own]
        rows = order if (np.diff(order) > 0).all() else np.sort(order)
        fewer.views = self.views.select(rows)
        for name in ("vectors", "_packed"):
            fewer.__dict__.pop(name, None)
        if "vectors" in self.__dict__:
            fewer.__dict__["vectors"] = self.vectors[rows]
        fewer.object_index = self.object_index[places]
        order = np.arange(len(rows)) if rows is order else np.searchsorted(rows, order)
        fewer._set_segments(order, begin, self._segments.lengths[places])
        if known is not None:
            fewer._take_vectors(known)
        return fewer

    def _take_vectors(self, known: "DenseIndex") -> None:
        is_known = np.isin(self.views.object_index, known.object_index)
        vectors = np.empty((len(self.views), known.vectors.shape[1]), np.float32)
        # both have the views of all their objects in the order of the whole catalog
        vectors[is_known] = known.vectors[np.isin(known.views.object_index, self.object_index)]
        vectors[~is_known] = self.space.vectors(self.views.levels(np.flatnonzero(~is_known)))
        self.__dict__["vectors"] = vectors

    def _set_segments(self, order: IndexArray, begin: IndexArray, count: IndexArray) -> None:
        """Set the views of each object: ``count`` of the rows ``order`` from ``begin`` on, by rising azimuth."""
        self._segments = calls.Segments(order, begin, count)
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

    def z(self, query: Floats) -> Floats:
        """Return z of every view and a query, (n,): of several segmentations, vectors (h, d), the largest."""
        most: Floats = (query @ self.vectors.T).max(axis=0)
        return self.space.standardised(most)

    def among(self, rows: IndexArray) -> FloatArray:
        """Return the similarity of views to each other within groups, rows (g, k), as float64 (g, k, k), at most 1."""
        near = self.vectors[rows]
        similar: FloatArray = (near @ near.transpose(0, 2, 1)).astype(np.float64) / self.space.largest.sum()
        return similar

    def closest(self, query: LevelArray) -> FloatArray:
        """Return the largest similarity of each object's views to a query, (k,), without the space.

        This needs no vectors, which take too much memory for all views of a large catalog.
        """
        similar = self._packed.similarity(np.atleast_2d(query)).max(axis=0)
        closest: FloatArray = np.maximum.reduceat(similar[self._segments.order], self._segments.begin)
        return closest

    @cached_property
    def _packed(self) -> Comparison:
        return self.views.prepared()

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

    def support(self, levels: Floats, rotated_deg: float) -> Floats:
        """Return the support that one query adds to every hypothesis.

        Parameters
        ----------
        levels : float32 array (n,)
            z of the query and every view.
        rotated_deg : float
            Orientation since the first query in degrees, counter-clockwise.

        Returns
        -------
        float32 array (k, 72)
            For azimuths 0, 5, 10, ... at the first query.
        """
        whole, part_deg = divmod(rotated_deg % 360.0, BIN_DEG)
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
