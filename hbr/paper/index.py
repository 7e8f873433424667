"""Exact search for the views most similar to a query."""

from copy import copy
from functools import cached_property
from typing import Final, Literal, get_args

import numpy as np

from hbr.core.arrays import FloatArray, IndexArray, LevelArray, ranges
from hbr.descriptors import Comparison, descriptor
from hbr.descriptors.similarity import squares, tanimoto, tanimoto_of_dots
from hbr.kernels import library
from hbr.kernels.calls import ByteRows
from hbr.model.views import Views

Method = Literal["flat", "tree"]

#: Rows that share one maximum in the search for the first candidates.
_GROUP: Final = 64
#: Rows of a leaf of the tree that is not split.
_LEAF: Final = 32
#: Number of searches whose results are cached; then the cache is cleared.
_REMEMBERED: Final = 64


class ViewIndex:
    """Exact search for the most similar views, by the similarity of their descriptor.

    Raises
    ------
    ValueError
        There is no such method, or the tree cannot compare the views.
    """

    def __init__(self, views: Views, method: Method = "flat") -> None:
        if method not in get_args(Method):
            raise ValueError(f"method {method!r} is unknown; use one of {', '.join(get_args(Method))}")
        self.views = views
        """The model set; it is not copied."""
        self.method = method
        """``flat`` compares with every view. ``tree``, the paper's index, compares with the views in some leaves of a
        KD-tree, for views that Tanimoto compares. Both return the same result."""
        self.descriptor = descriptor(views.descriptor)
        if method == "tree" and not self.descriptor.is_plain_cedd:
            raise ValueError(f"the tree compares plain CEDD, not {views.descriptor}; use flat")
        self._remembered: dict[tuple[bytes, int], tuple[IndexArray, FloatArray]] = {}

    def __len__(self) -> int:
        return len(self.views)

    @cached_property
    def _searcher(self) -> "_Flat | _Tree | _Compared":
        if not self.descriptor.is_plain_cedd:
            return _Compared(self.views.prepared())
        return _Tree(self.views.descriptors) if self.method == "tree" else _Flat(self.views.descriptors)

    def build(self) -> None:
        """Build the index now, and not by the first search."""
        _ = self._searcher

    def extended(self, more: Views) -> "ViewIndex":
        """Return an index of these views followed by more; this index does not change.

        The new index reuses what ``flat`` computed for views of CEDD.

        Parameters
        ----------
        more : Views
            Objects of the same name are merged (`Views.concatenate`).
        """
        views = Views.concatenate([self.views, more])
        grown = copy(self)
        grown.views = views
        grown.__dict__.pop("_searcher", None)
        if self.method == "flat" and self.descriptor.is_plain_cedd:
            known = self._searcher
            assert isinstance(known, _Flat)
            grown._searcher = _Flat(views.descriptors, known)
        grown._remembered = {}
        return grown

    def search(self, query: LevelArray, k: int) -> tuple[IndexArray, FloatArray]:
        """Find the `k` views with the largest Tanimoto similarity to the query.

        Parameters
        ----------
        query : uint8 array (length,)
            Levels of the descriptor of the views; for CEDD, 144 levels 0..7.
        k : int
            At least 1; all views are returned if there are fewer.

        Returns
        -------
        view_indices : integer array (min(k, n),)
            Best first; equal similarities by rising index.
        similarities : float64 array (min(k, n),)
            As the descriptor computes them, for CEDD by `hbr.tanimoto`.

        Raises
        ------
        TypeError, ValueError
            The query has no levels of this descriptor, or `k` is below 1.
        """
        self.check_queries(np.asarray(query)[None])
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
        query : uint8 array (length,)
            The query.
        view_indices, similarities : arrays (k,)
            What `search` returns for this query and k.
        """
        self._remembered[np.asarray(query).tobytes(), len(view_indices)] = view_indices, similarities

    def check_queries(self, queries: LevelArray) -> None:
        """Check that queries are levels of the descriptor of the views, uint8 (n, length).

        Raises
        ------
        TypeError, ValueError
            They are not.
        """
        if queries.ndim != 2:
            raise ValueError(f"queries have shape {queries.shape}; one row for each query is needed")
        self.descriptor.check_rows(queries)
        self.descriptor.check_levels(queries)


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


class _Compared:
    """Compares with every view, by any descriptor."""

    def __init__(self, compared: Comparison) -> None:
        self._compared = compared

    def top(self, query: LevelArray, k: int) -> tuple[IndexArray, FloatArray]:
        return largest(self._compared.similarity(query[None])[0], k)


class _Tree:
    """A KD-tree, split at the mean of the level with the largest variance (Bentley 1975, as the paper says).

    A search is exact for the Tanimoto coefficient. With α = (1 + t) / 2t, T(q, c) >= t is equivalent to
    |c - αq| <= |q| √(α² - 1): complete the square. Only leaves whose box meets that ball can have views as similar as
    t, which is the k-th similarity in the leaves that are nearest to the query.
    """

    def __init__(self, descriptors: LevelArray) -> None:
        leaves = []
        todo = [np.arange(len(descriptors))]
        while todo:
            rows = todo.pop()
            levels = descriptors[rows]
            mean = levels.mean(axis=0)
            variance = np.square(levels).mean(axis=0) - mean * mean  # squares of levels 0..7 fit into a byte
            split = int(variance.argmax())
            below = levels[:, split] <= mean[split]
            if len(rows) <= _LEAF or below.all():
                leaves.append(rows)
            else:
                todo += [rows[~below], rows[below]]
        self._rows = np.concatenate(leaves)
        self._begin = np.cumsum([0, *map(len, leaves)])
        self._levels = descriptors[self._rows]
        self._low = np.minimum.reduceat(self._levels, self._begin[:-1]).astype(np.float32)
        self._high = np.maximum.reduceat(self._levels, self._begin[:-1]).astype(np.float32)

    def top(self, query: LevelArray, k: int) -> tuple[IndexArray, FloatArray]:
        q = query.astype(np.float64)
        order = np.argsort(self._squared_distance(q), kind="stable")
        count = int(np.searchsorted(np.cumsum(np.diff(self._begin)[order]), k)) + 1
        reached = float(largest(self._similar(query, order[:count])[1], k)[1][-1])
        leaves = np.arange(len(order))
        if reached > 0:
            alpha = (1 + reached) / (2 * reached)
            # slightly larger: a view on the border can be as similar as the k-th
            radius = q @ q * (alpha * alpha - 1) * (1 + 1e-5) + 1e-3
            leaves = np.flatnonzero(self._squared_distance(alpha * q) <= radius)
        rows, similar = self._similar(query, leaves)
        ascending = np.argsort(rows)
        best, similarities = largest(similar[ascending], k)
        return rows[ascending[best]], similarities

    def _squared_distance(self, point: FloatArray) -> FloatArray:
        """Return the squared Euclidean distance of a point to the box of each leaf."""
        at = point.astype(np.float32)
        away = np.maximum(np.maximum(self._low - at, at - self._high), 0)
        return squares(away)

    def _similar(self, query: LevelArray, leaves: IndexArray) -> tuple[IndexArray, FloatArray]:
        places, _ = ranges(self._begin[leaves], np.diff(self._begin)[leaves])
        return self._rows[places], tanimoto(query, self._levels[places])[0]


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
