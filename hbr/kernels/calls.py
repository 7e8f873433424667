"""The kernels as functions of arrays. Each returns None without the compiled library: the caller has the reference."""

import ctypes
import threading
from functools import lru_cache
from itertools import pairwise
from math import ceil, floor
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray, IndexArray, LevelArray
from hbr.kernels.library import THREADS, address, library, run

_ROWS_OF_A_THREAD: Final = 100_000
"""Smallest number of rows for a thread: fewer take less time than its start."""
_MOST_ROWS: Final = 257
"""Largest number of bytes whose sum fits into 16 bits."""


class Addresses:
    """Addresses of arrays, for a kernel that reads a struct of them."""

    def __init__(self, *arrays: NDArray[Any]) -> None:
        self._arrays = arrays  # holds references to the arrays
        self._struct = (ctypes.c_void_p * len(arrays))(*map(address, arrays))
        self.address = ctypes.addressof(self._struct)


class _Workspace(threading.local):
    """Memory for short calls, one for each thread, because NumPy takes microseconds to return an array's address."""

    def __init__(self) -> None:
        self.array: FloatArray = np.empty(0)
        self.address = 0

    def grown(self, size: int) -> "_Workspace":
        if size > len(self.array):
            self.array = np.empty(size)
            self.address = address(self.array)
        return self


WORKSPACE = _Workspace()


def cedd(image: ImageArray, grid: tuple[int, int, int, int], tables: Addresses) -> LevelArray | None:
    """Return the CEDD levels of an image, (144,); ``grid`` and ``tables`` as in `hbr.descriptors.cedd`."""
    rows, columns, height, width = grid
    if height > 257 or height * width > 8000:
        return None
    if image.strides[1:] != (3, 1):
        image = np.ascontiguousarray(image)
    work = WORKSPACE.grown(18 + 16 * columns + 2 * columns * width)
    address, size = work.address, (rows, columns, height, width)
    if not run("hbr_cedd", image, image.strides[0], *size, tables.address, address + 144, address):
        return None
    return work.array[:18].view(np.uint8).copy()


def shrink(image: ImageArray, size: tuple[int, int]) -> ImageArray | None:
    """Return an image averaged to (width, height), as cv2.INTER_AREA does.

    That is a square image, or one whose size is a whole multiple above 2.
    """
    width, height = size
    factor = image.shape[1] // width
    if not 2 < factor <= _MOST_ROWS or image.shape[:2] != (height * factor, width * factor):
        return average(image, width) if width == height else None
    if image.strides[1:] != (3, 1):
        image = np.ascontiguousarray(image)
    sums, small = np.empty(3 * image.shape[1] + 1, np.uint16), np.empty((height, width, 3), np.uint8)
    return small if run("hbr_shrink", image, image.strides[0], height, width, factor, sums, small) else None


class _Taps:
    """The pixels, and their weights, of which each pixel of a shrunk row is the average."""

    def __init__(self, size: int, side: int) -> None:
        scale = size / side
        rows: list[tuple[int, list[float]]] = []
        for x in range(side):
            begin, end = x * scale, x * scale + scale
            width = min(scale, size - begin)
            last = min(floor(end), size - 1)
            whole = min(ceil(begin), last)
            weights = [1 / width] * (last - whole)
            first = whole
            if whole - begin > 1e-3:
                weights.insert(0, (whole - begin) / width)
                first -= 1
            if end - last > 1e-3:
                weights.append(min(min(end - last, 1.0), width) / width)
            rows.append((first, weights))
        self.most = max(len(weights) for _, weights in rows)
        self.first = np.array([min(first, size - self.most) for first, _ in rows], np.int64)
        self.weights = np.zeros((side, self.most), np.float32)
        for row, at, (first, weights) in zip(self.weights, self.first, rows, strict=True):
            row[first - at : first - at + len(weights)] = weights


_taps = lru_cache(maxsize=512)(_Taps)


def average(image: ImageArray, side: int) -> ImageArray | None:
    """Return a square image of more than ``side`` pixels averaged to ``side``, as cv2.INTER_AREA does."""
    size = image.shape[0]
    if image.shape[1] != size or not size > side or not size % side:
        return None
    if image.strides[1:] != (3, 1):
        image = np.ascontiguousarray(image)
    taps = _taps(size, side)
    floats, out = np.zeros(8 * side + 3 * size + 1, np.float32), np.empty((side, side, 3), np.uint8)
    is_done = run(
        "hbr_average", image, image.strides[0], size, side, taps.first, taps.weights, taps.most,
        floats[8 * side :], floats, floats[4 * side :], out,
    )  # fmt: skip
    return out if is_done else None


class _Measure(ctypes.Structure):
    _fields_ = (
        ("edges_at", ctypes.c_int64),
        ("colours_at", ctypes.c_int64),
        ("edges_share", ctypes.c_double),
        ("colours_share", ctypes.c_double),
        ("edge_values", ctypes.c_void_p),
        ("colour_weights", ctypes.c_void_p),
        ("far", ctypes.c_void_p),
        ("near", ctypes.c_void_p),
    )


class Measure(NamedTuple):
    """Settings of the comparison of packed rows of edges, colours, or both.

    Attributes
    ----------
    edges_at, colours_at
        First byte of each part in a row; -1 without it.
    edges_share, colours_share
        Weights of the two similarities, if there are both.
    edge_values : int32 array (4,)
        Value of each level of the edges.
    colour_weights : int32 array (32,)
        Weight of the squared difference of each level of the colours.
    far, near : float64 arrays
        Similarity of colours at distances 4096 i, and at distances i below 4096.
    """

    edges_at: int = -1
    colours_at: int = -1
    edges_share: float = 1.0
    colours_share: float = 1.0
    edge_values: NDArray[np.int32] = np.zeros(4, np.int32)
    colour_weights: NDArray[np.int32] = np.zeros(32, np.int32)
    far: FloatArray = np.ones(1)
    near: FloatArray = np.ones(1)

    def struct(self) -> ctypes.Structure:
        """Return the struct that the kernels read; the arrays must live as long as it."""
        return _Measure(*self[:4], *(address(array) for array in self[4:]))


class _Segments(ctypes.Structure):
    _fields_ = (
        ("places", ctypes.c_void_p),
        ("order", ctypes.c_void_p),
        ("begin", ctypes.c_void_p),
        ("count", ctypes.c_void_p),
        ("objects", ctypes.c_int64),
    )


class Segments(NamedTuple):
    """The rows of each object, one object after the other: ``lengths`` of ``order`` from ``begin`` on; int64 arrays."""

    order: IndexArray
    begin: IndexArray
    lengths: IndexArray
    is_whole: bool = False
    """Whether ``order`` is 0, 1, 2, ..."""


class PackedRows:
    """Packed rows, prepared for the kernels.

    Parameters
    ----------
    measure : Measure
        How they are compared.
    rows : uint8 array (n, bytes)
        The bytes of a row lie side by side.
    squares : float64 array (n,), optional
        Squared lengths of their edges, if they are known.
    places : integer array (m,), optional
        Only these of the rows, in this order.
    """

    def __init__(
        self, measure: Measure, rows: LevelArray, squares: FloatArray | None = None, places: IndexArray | None = None
    ) -> None:
        found = library()
        assert found is not None
        self._library, self._measure, self._struct = found, measure, measure.struct()
        self._by_address = ctypes.addressof(self._struct)
        self.rows = rows if rows.strides[1:] == (1,) else np.ascontiguousarray(rows)
        self._at = address(self.rows), self.rows.strides[0]
        self._places = places
        if squares is None:
            squares = np.zeros(len(rows))
            if measure.edges_at >= 0:
                found.hbr_squares(self._by_address, *self._at, len(rows), address(squares))
        self.squares = squares

    def __len__(self) -> int:
        return len(self.rows) if self._places is None else len(self._places)

    def similarity(self, queries: LevelArray) -> FloatArray:
        """Return the similarity of packed queries, (n, bytes), to all rows, (n, m)."""
        queries = np.ascontiguousarray(queries)
        similar = np.empty((len(queries), len(self)))
        places = 0 if self._places is None else address(self._places)
        self._library.hbr_similarity(
            self._by_address, address(queries), queries.strides[0], len(queries),
            *self._at, address(self.squares), places, len(self), address(similar),
        )  # fmt: skip
        return similar

    def pairs(self, rows: IndexArray, first: IndexArray, second: IndexArray) -> FloatArray:
        """Return the similarity of two rows of each group, (g, p): indices (g, k), and which two of them, (p,) each.

        Pairs with the same first one follow each other.
        """
        places = _whole(rows if self._places is None else self._places[rows])
        first, second = _whole(first), _whole(second)
        similar = np.empty((len(places), len(first)))
        self._library.hbr_pairs(
            self._by_address, *self._at, address(self.squares), address(places), *places.shape,
            address(first), address(second), len(first), address(similar),
        )  # fmt: skip
        return similar

    def among(self, rows: IndexArray) -> FloatArray:
        """Return the similarity of rows to each other within groups, indices (g, k), as (g, k, k)."""
        first, second = np.triu_indices(rows.shape[1])
        similar = np.empty((*rows.shape, rows.shape[1]))
        similar[:, first, second] = similar[:, second, first] = self.pairs(rows, first, second)
        return similar

    def bounds(self, query: LevelArray, segments: Segments) -> FloatArray:
        """Return an upper bound of the similarity of each object's rows to a packed query, (k,)."""
        bounds = np.empty(len(segments.lengths))
        threads = max(1, min(THREADS, len(self) // _ROWS_OF_A_THREAD))
        limits = [len(bounds) * i // threads for i in range(threads + 1)]
        parts = [(query, segments, bounds, *part) for part in pairwise(limits)]
        others = [threading.Thread(target=self._store_bounds, args=part) for part in parts[1:]]
        for thread in others:
            thread.start()
        self._store_bounds(*parts[0])
        for thread in others:
            thread.join()
        return bounds

    def _store_bounds(self, query: LevelArray, segments: Segments, bounds: FloatArray, first: int, last: int) -> None:
        """Store the bounds of the objects from the first to the last; the interpreter is free meanwhile."""
        some = segments._replace(begin=segments.begin[first:last], lengths=segments.lengths[first:last])
        struct = self._segments(some)
        self._library.hbr_bounds(
            self._by_address,
            address(query),
            *self._at,
            address(self.squares),
            ctypes.addressof(struct),
            address(bounds[first:last]),
        )

    def nearest(self, query: LevelArray, segments: Segments, kept: int) -> IndexArray:
        """Return the objects with the most similar views, ascending (kept,); of equal ones, the first."""
        bounds = self.bounds(query, segments)
        by_bound = np.argsort(-bounds).astype(np.int64, copy=False)
        nearest, similar = np.empty(kept, np.int64), np.empty(kept)
        struct = self._segments(segments)
        self._library.hbr_nearest(
            self._by_address, address(query), *self._at, address(self.squares), ctypes.addressof(struct),
            address(by_bound), address(bounds), kept, address(nearest), address(similar),
        )  # fmt: skip
        return np.sort(nearest)

    def _segments(self, segments: Segments) -> ctypes.Structure:
        places = 0 if self._places is None else address(self._places)
        order = 0 if segments.is_whole else address(segments.order)
        return _Segments(places, order, address(segments.begin), address(segments.lengths), len(segments.lengths))

    def only(self, rows: IndexArray) -> "PackedRows":
        """Return some of the rows, in this order; nothing is copied."""
        places = np.ascontiguousarray(rows if self._places is None else self._places[rows], np.int64)
        return PackedRows(self._measure, self.rows, self.squares, places)


class ByteRows:
    """Rows of at most 4096 bytes, prepared for comparison by the Tanimoto coefficient.

    Parameters
    ----------
    rows : uint8 array (n, length)
    squares : int32 array (n,), optional
        Squared lengths of the first rows, if they are known.
    """

    LONGEST: Final = 4096  # as in tanimoto.c: the sum of so many products of two bytes is below 2**31

    def __init__(self, rows: LevelArray, squares: NDArray[np.int32] | None = None) -> None:
        found = library()
        assert found is not None
        self._library = found
        self._rows = rows if rows.strides[1:] == (1,) else np.ascontiguousarray(rows)
        self._at = address(self._rows), self._rows.strides[0]
        known = 0 if squares is None else len(squares)
        self.squares = np.empty(len(rows), np.int32)
        if squares is not None:
            self.squares[:known] = squares
        if len(rows) > known:
            rest = self._at[0] + known * self._at[1]
            missing = address(self.squares) + known * self.squares.itemsize
            found.hbr_byte_squares(rest, self._at[1], rows.shape[1], len(rows) - known, missing)

    def similarity(self, queries: LevelArray) -> FloatArray:
        """Return the coefficient of queries, (n, length), with all rows, (n, m)."""
        queries = np.ascontiguousarray(queries)
        similar = np.empty((len(queries), len(self._rows)))
        self._library.hbr_tanimoto(
            address(queries), queries.strides[0], len(queries), *self._at,
            address(self.squares), len(self._rows), queries.shape[1], address(similar),
        )  # fmt: skip
        return similar

    def top(self, query: LevelArray, kept: int) -> tuple[IndexArray, FloatArray]:
        """Return the rows with the largest coefficients, best first, of equal ones the first; and the coefficients."""
        query = np.ascontiguousarray(query)
        best, similar = np.empty(kept, np.int64), np.empty(kept)
        self._library.hbr_tanimoto_top(
            address(query), *self._at, len(query), address(self.squares), len(self._rows), kept,
            address(best), address(similar),
        )  # fmt: skip
        return best, similar


def support(
    segments: Segments,
    azimuth_deg: FloatArray,
    levels: NDArray[np.float32],
    slope: float,
    part_deg: float,
    whole: int,
) -> NDArray[np.float32] | None:
    """Return the support that one query adds to every azimuth of each object, (objects, 72); see `hbr.dense.index`."""
    room = 2 * int(segments.lengths.max())
    scratch = np.empty(4 * room)
    added = np.empty((len(segments.lengths), 72), np.float32)
    of_bins = slope, part_deg, whole, scratch, room, added
    is_done = run("hbr_support", *segments[:3], len(segments.lengths), azimuth_deg, levels, *of_bins)
    return added if is_done else None


def nearest_view(
    segments: Segments, azimuth_deg: FloatArray, places: IndexArray, at_deg: FloatArray
) -> tuple[IndexArray, FloatArray] | None:
    """Return the view of each object, (m,), that is nearest to azimuths, (a, m), and its distance in degrees."""
    places, at_deg = _whole(places), np.ascontiguousarray(at_deg)
    rows, away_deg = np.empty(at_deg.shape, np.int64), np.empty(at_deg.shape)
    asked = places, len(places), at_deg, len(at_deg)
    is_done = run("hbr_nearest_view", *segments[:3], azimuth_deg, *asked, rows, away_deg)
    return (rows, away_deg) if is_done else None


def paths(
    columns: list[IndexArray],
    queries: LevelArray,
    orientation_deg: FloatArray,
    descriptors: LevelArray,
    object_index: IndexArray,
    azimuth_deg: FloatArray,
    omega: float,
) -> tuple[FloatArray, IndexArray] | None:
    """Return score (C,) and path (C, N) of every object, by rising object; see `hbr.paper.hough`."""
    if queries.shape[1] > ByteRows.LONGEST:
        return None
    queries, orientation_deg = np.ascontiguousarray(queries), np.ascontiguousarray(orientation_deg)
    object_index, azimuth_deg = _whole(object_index), np.ascontiguousarray(azimuth_deg)
    if descriptors.strides[1:] != (1,):
        descriptors = np.ascontiguousarray(descriptors)
    rows = np.concatenate(columns).astype(np.int64, copy=False)
    begin = np.zeros(len(columns) + 1, np.int64)
    np.cumsum([len(column) for column in columns], out=begin[1:])
    most = len(columns[-1])
    value, predecessor = np.empty(len(rows)), np.empty(len(rows), np.int64)
    scores, taken, count = np.empty(most), np.empty((most, len(columns)), np.int64), np.empty(1, np.int64)
    is_done = run(
        "hbr_paths", queries, queries.strides[0], *queries.shape, descriptors, descriptors.strides[0],
        object_index, azimuth_deg, orientation_deg, omega, begin, rows, value, predecessor, scores, taken, count,
    )  # fmt: skip
    return (scores[: count[0]], taken[: count[0]]) if is_done else None


def _whole(array: IndexArray) -> NDArray[np.int64]:
    return np.ascontiguousarray(array, np.int64)
