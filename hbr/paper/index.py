"""Exact search for the views most similar to a query."""

from copy import copy
from functools import cached_property
from typing import Final, Literal, get_args

import numpy as np

from hbr.core.arrays import FloatArray, IndexArray, LevelArray
from hbr.descriptors.cedd import BINS
from hbr.descriptors.similarity import squares, tanimoto, tanimoto_of_dots
from hbr.kernels import library
from hbr.kernels.calls import ByteRows
from hbr.model.views import Views

Method = Literal["flat", "kdtree"]

#: Rows that share one maximum in the search for the first candidates.
_GROUP: Final = 64
#: Number of searches whose results are cached; then the cache is cleared.
_REMEMBERED: Final = 64


class ViewIndex:
    """Exact search for the most similar views, by the Tanimoto coefficient.

    Parameters
    ----------
    views : Views
        The model set; it is not copied.
    method : {"flat", "kdtree"}
        ``flat`` compares with every view. ``kdtree``, the paper's index, finds the k nearest views by Euclidean
        distance in a KD-tree, then all views in the ball that contains every view as similar as those. It needs eight
        times the memory of the descriptors, and is slower. Both return the same result.
    """

    def __init__(self, views: Views, method: Method = "flat") -> None:
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
    def _searcher(self) -> "_Flat | _Tree":
        return _Tree(self.views.descriptors) if self._method == "kdtree" else _Flat(self.views.descriptors)

    def extended(self, more: Views) -> "ViewIndex":
        """Return an index of these views followed by more; this index does not change.

        The new index reuses what was computed for these views, except with ``kdtree``.

        Parameters
        ----------
        more : Views
            Objects of the same name are merged (`Views.concatenate`).
        """
        views = Views.concatenate([self.views, more])
        grown = copy(self)
        grown.views = views
        known = self._searcher
        grown._searcher = _Tree(views.descriptors) if isinstance(known, _Tree) else _Flat(views.descriptors, known)
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


class _Flat:
    """Compares with every view: by the kernel, without a copy, or by products, exact in float32 (below 144 * 49)."""

    def __init__(self, descriptors: LevelArray, known: "_Flat | None" = None) -> None:
        self._compiled = self._rows = None
        if library() is not None:
            known_squares = None if known is None or known._compiled is None else known._compiled.squares
            self._compiled = ByteRows(descriptors, known_squares)
        else:
            self._rows = descriptors.astype(np.float32)
            self._squares = squares(self._rows)

    def top(self, query: LevelArray, k: int) -> tuple[IndexArray, FloatArray]:
        if self._compiled is not None:
            return self._compiled.top(query, k)
        assert self._rows is not None
        q = query.astype(np.float32)
        dots = (self._rows @ q).astype(np.float64)
        return largest(tanimoto_of_dots(dots, squares(q[None]), self._squares), k)


class _Tree:
    """A KD-tree of Euclidean distances, and a ball that makes the result exact for the Tanimoto coefficient.

    With α = (1 + t) / 2t, T(q, c) >= t is equivalent to |c - αq| <= |q| √(α² - 1): complete the square.
    """

    def __init__(self, descriptors: LevelArray) -> None:
        from scipy.spatial import cKDTree

        self._descriptors = descriptors
        self._tree = cKDTree(descriptors.astype(np.float64)) if len(descriptors) else None

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


def _group_maxima(values: FloatArray) -> FloatArray:
    """Return maxima over groups of every n-th value, so that views of one object are in different groups."""
    whole = len(values) // _GROUP * _GROUP
    maxima: FloatArray = values[:whole].reshape(_GROUP, -1).max(axis=0)
    return maxima
