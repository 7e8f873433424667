"""Exact search for the views most similar to a query."""

from copy import copy
from functools import cached_property
from typing import Final, Literal, Protocol, Self, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.descriptors.cedd import BINS
from hbr.descriptors.tanimoto import squares, tanimoto, tanimoto_of_dots
from hbr.kernels import library
from hbr.kernels.calls import ByteRows
from hbr.model.views import Views

Method = Literal["auto", "flat", "bound", "kdtree"]
_T = TypeVar("_T", np.float32, np.float64)

#: Below this number of views, one product over all 144 levels is as fast as the bound.
_SMALL: Final = 10_000
#: Principal components in the bound: more of them need more memory traffic, fewer leave more views to compare fully.
_COMPONENTS: Final = 15
#: Rows that share one maximum in the search for the first candidates.
_GROUP: Final = 64
#: Number of searches whose results are cached; then the cache is cleared.
_REMEMBERED: Final = 64
#: Rows that are converted to float at once.
_CHUNK: Final = 4_096


class ViewIndex:
    """Exact search for the most similar views, by the Tanimoto coefficient.

    Parameters
    ----------
    views : Views
        The model set; it is not copied.
    method : {"auto", "flat", "bound", "kdtree"}
        ``flat`` compares with every view. ``bound`` compares a few principal components with every view: with an
        orthonormal projection P, q·c <= Pq·Pc + |q - PᵀPq| |c - PᵀPc|, which bounds the similarity from above, and only
        views whose bound reaches the k-th best similarity found so far are compared in full. ``kdtree`` finds the k
        nearest views by Euclidean distance in a KD-tree, then all views in the ball that contains every view as similar
        as those. It needs SciPy and eight times the memory of the descriptors. ``auto`` uses ``flat`` for small sets
        and ``bound`` for others. All methods return the same result.
    """

    def __init__(self, views: Views, method: Method = "auto") -> None:
        if method not in get_args(Method):
            raise ValueError(f"method {method!r} is unknown; use one of {', '.join(get_args(Method))}")
        if views.descriptors.shape[1] != BINS:
            raise ValueError(
                f"the views are of {views.descriptor}; this search compares CEDD alone, use hbr.DenseIndex"
            )
        self.views = views
        self._method = method
        self._remembered: dict[tuple[bytes, int], tuple[IndexArray, FloatArray]] = {}

    def __len__(self) -> int:
        return len(self.views)

    @cached_property
    def _searcher(self) -> "_Searcher":
        return _searcher(self.views.descriptors, self._method)

    def extended(self, more: Views) -> "ViewIndex":
        """Return an index of these views followed by more; this index does not change.

        The new index reuses what was computed for these views, except with ``kdtree`` or if their number has doubled.

        Parameters
        ----------
        more : Views
            Objects of the same name are merged (`Views.concatenate`).
        """
        views = Views.concatenate([self.views, more])
        grown = copy(self)
        grown.views = views
        grown._searcher = _searcher(views.descriptors, self._method, self._searcher)
        grown._remembered = {}
        return grown

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
            Best first; equal similarities by rising index.
        similarities : float64 array (min(k, n),)
            As `hbr.tanimoto` computes them.

        Raises
        ------
        TypeError, ValueError
            The query is not a uint8 array of shape (144,) with levels 0..7, or `k` is below 1.
        """
        check_queries(np.asarray(query)[None])
        if k < 1:
            raise ValueError(f"k is {k}; ask for at least 1 view")
        k = min(k, len(self.views))
        if k == 0:
            return np.empty(0, np.intp), np.empty(0)
        # an active search repeats the searches of its earlier queries with every new query
        key = np.asarray(query).tobytes(), k
        found = self._remembered.get(key)
        if found is None:
            found = self._searcher.top(query, k)
            if len(self._remembered) >= _REMEMBERED:
                self._remembered.clear()
            self._remembered[key] = found
        return found[0].copy(), found[1].copy()

    def remember(self, query: LevelArray, view_indices: IndexArray, similarities: FloatArray) -> None:
        """Use a result that is known for `search`, for example from an index that has more views.

        Parameters
        ----------
        query : uint8 array (144,)
            The query.
        view_indices, similarities : arrays (k,)
            What `search` returns for this query and k.
        """
        self._remembered[np.asarray(query).tobytes(), len(view_indices)] = view_indices, similarities


def check_queries(queries: LevelArray) -> None:
    """Check that queries are a uint8 array (n, 144) of levels 0..7.

    Raises
    ------
    TypeError, ValueError
        They are not.
    """
    if queries.dtype != np.uint8:
        raise TypeError(f"the query is of {queries.dtype}; pass the uint8 levels that cedd or describe returns")
    if queries.ndim != 2 or queries.shape[1] != BINS:
        raise ValueError(f"the query has {queries.shape[1:]} levels, not ({BINS},); describe the image first")
    if queries.size and queries.max() > 7:
        raise ValueError(f"the query has a level of {queries.max()}; CEDD levels are 0..7, unpack packed bytes first")


class _Searcher(Protocol):
    def extended(self, descriptors: LevelArray, /) -> Self | None:
        """Return a searcher of these rows, which start with its own; None if a new one is better."""

    def top(self, query: LevelArray, k: int) -> tuple[IndexArray, FloatArray]: ...


def _searcher(descriptors: LevelArray, method: Method, known: _Searcher | None = None) -> _Searcher:
    if method == "auto":
        method = "flat" if len(descriptors) < _SMALL else "bound"
    flat = _Flat if library() is None else _Compiled
    kinds: dict[str, type[_Compiled | _Flat | _Bound | _Tree]] = {"flat": flat, "bound": _Bound, "kdtree": _Tree}
    kind = kinds[method]
    return (known.extended(descriptors) if isinstance(known, kind) else None) or kind(descriptors)


class _Compiled:
    """The compiled kernel: compares with every view without a copy; only the squared lengths are stored."""

    def __init__(self, descriptors: LevelArray, known: NDArray[np.int32] | None = None) -> None:
        self._rows = ByteRows(descriptors, known)

    def extended(self, descriptors: LevelArray, /) -> "_Compiled":
        return _Compiled(descriptors, self._rows.squares)

    def top(self, query: LevelArray, k: int) -> tuple[IndexArray, FloatArray]:
        return self._rows.top(query, k)


class _Flat:
    """Products with every view. They are exact in float32 (below 144 * 49)."""

    def __init__(self, descriptors: LevelArray) -> None:
        self._rows = descriptors.astype(np.float32)
        self._squares = squares(self._rows)

    def extended(self, descriptors: LevelArray, /) -> "_Flat":
        more = _Flat(descriptors[len(self._rows) :])
        more._rows = np.concatenate([self._rows, more._rows])
        more._squares = np.concatenate([self._squares, more._squares])
        return more

    def top(self, query: LevelArray, k: int) -> tuple[IndexArray, FloatArray]:
        q = query.astype(np.float32)
        dots = (self._rows @ q).astype(np.float64)
        return largest(tanimoto_of_dots(dots, squares(q[None]), self._squares), k)


class _Bound:
    """Bounds for every view, and products only for the views that can be among the best."""

    def __init__(self, descriptors: LevelArray) -> None:
        moments = np.zeros((BINS, BINS))
        for start in range(0, len(descriptors), _CHUNK):
            rows = descriptors[start : start + _CHUNK].astype(np.float32)
            moments += rows.T @ rows
        # eigh sorts ascending: the last components contain most of the length
        self._axes = np.ascontiguousarray(np.linalg.eigh(moments)[1][:, -_COMPONENTS:])
        self._fitted = len(descriptors)
        self._columns, self._squares = np.empty((_COMPONENTS + 1, 0), np.float32), np.empty(0, np.float32)
        self._add(descriptors)

    def extended(self, descriptors: LevelArray, /) -> "_Bound | None":
        if len(descriptors) > 2 * self._fitted:
            return None  # the axes may not fit the majority of the views any more
        grown = copy(self)
        grown._add(descriptors)
        return grown

    def _add(self, descriptors: LevelArray) -> None:
        """Project the new rows; the arrays are copied, because another index may share the old ones."""
        self._descriptors = descriptors
        known = len(self._squares)
        columns, lengths = self._columns, self._squares
        self._columns = np.empty((len(columns), len(descriptors)), np.float32)
        self._squares = np.empty(len(descriptors), np.float32)
        self._columns[:, :known], self._squares[:known] = columns, lengths
        for start in range(known, len(descriptors), _CHUNK):
            chunk = slice(start, start + _CHUNK)
            projected, self._squares[chunk] = self._project(descriptors[chunk])
            self._columns[:, chunk] = projected.T

    def _project(self, rows: LevelArray) -> tuple[FloatArray, FloatArray]:
        """Return components and length of the residual, (n, components + 1), and squared length of each row."""
        x = rows.astype(np.float64)
        inside = x @ self._axes
        residual = np.linalg.norm(x - inside @ self._axes.T, axis=1)
        return np.column_stack([inside, residual]), squares(x)

    def top(self, query: LevelArray, k: int) -> tuple[IndexArray, FloatArray]:
        columns, own_squares = self._project(query[None])
        own = float(own_squares[0])
        if own == 0:
            return np.arange(k), np.zeros(k)
        # the error of float32 is less than (components + 3) * 2**-24 of |q| |c|, and |c| <= 84
        dots = columns[0].astype(np.float32) @ self._columns + np.float32(1e-5 * 84 * own**0.5)
        bounds = dots / (self._squares + np.float32(own) - dots)
        promising = _promising(bounds, k)
        reached = np.sort(self._similarities(query, promising))[-k]
        rows = np.flatnonzero(bounds >= np.float32(reached * (1 - 1e-5)))
        best, similarities = largest(self._similarities(query, rows), k)
        return rows[best], similarities

    def _similarities(self, query: LevelArray, rows: IndexArray) -> FloatArray:
        parts = (rows[start : start + _CHUNK] for start in range(0, len(rows), _CHUNK))
        return np.concatenate([tanimoto(query, self._descriptors[part])[0] for part in parts])


class _Tree:
    """A KD-tree of Euclidean distances, and a ball that makes the result exact for the Tanimoto coefficient.

    With α = (1 + t) / 2t, T(q, c) >= t is equivalent to |c - αq| <= |q| √(α² - 1): complete the square.
    """

    def __init__(self, descriptors: LevelArray) -> None:
        from scipy.spatial import cKDTree

        self._descriptors = descriptors
        self._tree = cKDTree(descriptors.astype(np.float64)) if len(descriptors) else None

    def extended(self, _descriptors: LevelArray, /) -> None:
        return None

    def top(self, query: LevelArray, k: int) -> tuple[IndexArray, FloatArray]:
        assert self._tree is not None
        q = query.astype(np.float64)
        nearest = np.atleast_1d(self._tree.query(q, k)[1])
        reached = float(tanimoto(query, self._descriptors[nearest])[0].min())
        if reached == 0:
            rows = np.arange(len(self._descriptors))
        else:
            alpha = (1 + reached) / (2 * reached)
            # slightly larger: a view on the border can be as similar as the k-th
            radius = np.sqrt(q @ q * (alpha * alpha - 1)) * (1 + 1e-9) + 1e-6
            rows = np.sort(np.array(self._tree.query_ball_point(alpha * q, radius), np.intp))
        best, similarities = largest(tanimoto(query, self._descriptors[rows])[0], k)
        return rows[best], similarities


def largest(values: FloatArray, k: int) -> tuple[IndexArray, FloatArray]:
    """Return indices and values of the `k` largest values, best first; equal values by rising index."""
    rows = np.arange(len(values))
    if len(values) > 2 * k > 0:
        # k groups have a maximum of at least `limit`, therefore at least k values do
        candidates = _group_maxima(values) if len(values) >= k * _GROUP else values
        rows = np.flatnonzero(values >= np.partition(candidates, -k)[-k])
    chosen = rows[np.argsort(-values[rows], kind="stable")[:k]]
    return chosen, values[chosen]


def _promising(values: NDArray[np.float32], k: int) -> IndexArray:
    """Return at least `k` indices of large values."""
    wanted = 4 * k
    if len(values) < wanted * _GROUP:
        return np.arange(len(values))
    maxima = _group_maxima(values)
    groups = np.argpartition(maxima, -wanted)[-wanted:]
    in_group = groups + len(maxima) * np.arange(_GROUP)[:, None]
    rows: IndexArray = in_group[values[in_group].argmax(axis=0), np.arange(wanted)]
    return rows


def _group_maxima(values: NDArray[_T]) -> NDArray[_T]:
    """Return maxima over groups of every n-th value, so that views of one object are in different groups."""
    whole = len(values) // _GROUP * _GROUP
    maxima: NDArray[_T] = values[:whole].reshape(_GROUP, -1).max(axis=0)
    return maxima
