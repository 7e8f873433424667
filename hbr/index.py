"""Exact search for the views most similar to a query."""

from typing import Final, Literal, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from hbr.arrays import FloatArray, IndexArray, LevelArray
from hbr.cedd import BINS
from hbr.tanimoto import squares, tanimoto, tanimoto_of_dots
from hbr.views import Views

Method = Literal["auto", "flat", "bound"]
_T = TypeVar("_T", np.float32, np.float64)

#: Below this many views one product over all 144 levels is as quick as the bound.
_SMALL: Final = 10_000
#: Principal components in the bound: more cost more memory traffic, fewer leave more views to refine.
_COMPONENTS: Final = 15
#: Rows that share one maximum when the first candidates are looked for.
_GROUP: Final = 64
_CHUNK: Final = 65_536


class ViewIndex:
    """Exact nearest views by Tanimoto.

    Parameters
    ----------
    views : Views
        The model set; not copied.
    method : {"auto", "flat", "bound"}
        ``flat`` compares with every view. ``bound`` compares a few principal components with every view: with an
        orthonormal projection P, q·c <= Pq·Pc + |q - PᵀPq| |c - PᵀPc|, which bounds the similarity from above, and only
        views whose bound reaches the k-th best similarity found so far are compared in full. ``auto`` takes ``flat``
        for small sets. The answers are the same.
    """

    def __init__(self, views: Views, method: Method = "auto") -> None:
        if method not in get_args(Method):
            raise ValueError(f"method {method!r} is unknown; use one of {', '.join(get_args(Method))}")
        self.views = views
        use_flat = method == "flat" or (method == "auto" and len(views) < _SMALL)
        self._search: _Flat | _Bound = _Flat(views.descriptors) if use_flat else _Bound(views.descriptors)

    def __len__(self) -> int:
        return len(self.views)

    def search(self, query: LevelArray, k: int) -> tuple[IndexArray, FloatArray]:
        """Find the `k` views with the largest Tanimoto similarity to the query.

        Parameters
        ----------
        query : uint8 array (144,)
            Levels 0..7.
        k : int
            At least 1; all views are returned if there are fewer.

        Returns
        -------
        view_indices : integer array (min(k, n),)
            Best first, equal similarities by lower index.
        similarities : float64 array (min(k, n),)
            As `hbr.tanimoto` computes them.

        Raises
        ------
        TypeError, ValueError
            The query is no uint8 array of shape (144,) with levels 0..7, or `k` is below 1.
        """
        check_queries(np.asarray(query)[None])
        if k < 1:
            raise ValueError(f"k is {k}; ask for at least 1 view")
        k = min(k, len(self.views))
        if k == 0:
            return np.empty(0, np.intp), np.empty(0)
        return self._search.top(query, k)


def check_queries(queries: LevelArray) -> None:
    """Refuse what is not a uint8 array (n, 144) of levels 0..7."""
    if queries.dtype != np.uint8:
        raise TypeError(f"the query is of {queries.dtype}; pass the uint8 levels that cedd or describe returns")
    if queries.ndim != 2 or queries.shape[1] != BINS:
        raise ValueError(f"the query has {queries.shape[1:]} levels, not ({BINS},); describe the image first")
    if queries.size and queries.max() > 7:
        raise ValueError(f"the query has a level of {queries.max()}; CEDD levels are 0..7, unpack packed bytes first")


class _Flat:
    """Products with every view; float32 holds them exactly (below 144 * 49)."""

    def __init__(self, descriptors: LevelArray) -> None:
        self._rows = descriptors.astype(np.float32)
        self._squares = squares(self._rows)

    def top(self, query: LevelArray, k: int) -> tuple[IndexArray, FloatArray]:
        q = query.astype(np.float32)
        dots = (self._rows @ q).astype(np.float64)
        return _best(tanimoto_of_dots(dots, squares(q[None]), self._squares), k)


class _Bound:
    """Bounds for every view, products for the few that can still be among the best."""

    def __init__(self, descriptors: LevelArray) -> None:
        self._descriptors = descriptors
        moments = np.zeros((BINS, BINS))
        for start in range(0, len(descriptors), _CHUNK):
            rows = descriptors[start : start + _CHUNK].astype(np.float32)
            moments += rows.T @ rows
        # eigh sorts ascending: the last components carry most of the length
        self._axes = np.ascontiguousarray(np.linalg.eigh(moments)[1][:, -_COMPONENTS:])
        self._squares = np.empty(len(descriptors), np.float32)
        self._columns = np.empty((_COMPONENTS + 1, len(descriptors)), np.float32)
        for start in range(0, len(descriptors), _CHUNK):
            chunk = slice(start, start + _CHUNK)
            columns, self._squares[chunk] = self._project(descriptors[chunk])
            self._columns[:, chunk] = columns.T

    def _project(self, rows: LevelArray) -> tuple[FloatArray, FloatArray]:
        """Components and length of the residual, (n, components + 1), and squared length of each row."""
        x = rows.astype(np.float64)
        inside = x @ self._axes
        residual = np.linalg.norm(x - inside @ self._axes.T, axis=1)
        return np.column_stack([inside, residual]), squares(x)

    def top(self, query: LevelArray, k: int) -> tuple[IndexArray, FloatArray]:
        columns, own_squares = self._project(query[None])
        own = float(own_squares[0])
        if own == 0:
            return np.arange(k), np.zeros(k)
        # float32 errs by less than (components + 3) * 2**-24 of |q| |c|, and |c| <= 84
        dots = columns[0].astype(np.float32) @ self._columns + np.float32(1e-5 * 84 * own**0.5)
        bounds = dots / (self._squares + np.float32(own) - dots)
        promising = _promising(bounds, k)
        reached = np.sort(self._similarities(query, promising))[-k]
        rows = np.flatnonzero(bounds >= np.float32(reached * (1 - 1e-5)))
        best, similarities = _best(self._similarities(query, rows), k)
        return rows[best], similarities

    def _similarities(self, query: LevelArray, rows: IndexArray) -> FloatArray:
        parts = (rows[start : start + _CHUNK] for start in range(0, len(rows), _CHUNK))
        return np.concatenate([tanimoto(query, self._descriptors[part])[0] for part in parts])


def _best(values: FloatArray, k: int) -> tuple[IndexArray, FloatArray]:
    """Indices and values of the `k` largest, best first, equal values by lower index."""
    rows = np.arange(len(values))
    if len(values) >= k * _GROUP:
        # k groups have a maximum of at least `limit`, so at least k values have
        limit = np.partition(_group_maxima(values), -k)[-k]
        rows = np.flatnonzero(values >= limit)
    best = rows[np.argsort(-values[rows], kind="stable")[:k]]
    return best, values[best]


def _promising(values: NDArray[np.float32], k: int) -> IndexArray:
    """Some `k` indices or more, of large values."""
    wanted = 4 * k
    if len(values) < wanted * _GROUP:
        return np.arange(len(values))
    maxima = _group_maxima(values)
    groups = np.argpartition(maxima, -wanted)[-wanted:]
    in_group = groups + len(maxima) * np.arange(_GROUP)[:, None]
    rows: IndexArray = in_group[values[in_group].argmax(axis=0), np.arange(wanted)]
    return rows


def _group_maxima(values: NDArray[_T]) -> NDArray[_T]:
    """Maxima over groups of every n-th value, so that neighbours (views of one object) fall into different groups."""
    whole = len(values) // _GROUP * _GROUP
    maxima: NDArray[_T] = values[:whole].reshape(_GROUP, -1).max(axis=0)
    return maxima
