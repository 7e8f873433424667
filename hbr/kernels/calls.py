"""The kernels as functions of arrays. Each returns None without the compiled library: the caller has the reference."""

import ctypes
import threading
from functools import lru_cache
from math import ceil, floor
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray, IndexArray, LevelArray
from hbr.kernels.library import address, library, run

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


class Segments(NamedTuple):
    """The rows of each object, one object after the other: ``lengths`` of ``order`` from ``begin`` on; int64 arrays."""

    order: IndexArray
    begin: IndexArray
    lengths: IndexArray


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
    is_done = run("hbr_support", *segments, len(segments.lengths), azimuth_deg, levels, *of_bins)
    return added if is_done else None


def nearest_view(
    segments: Segments, azimuth_deg: FloatArray, places: IndexArray, at_deg: FloatArray
) -> tuple[IndexArray, FloatArray] | None:
    """Return the view of each object, (m,), that is nearest to azimuths, (a, m), and its distance in degrees."""
    places, at_deg = _whole(places), np.ascontiguousarray(at_deg)
    rows, away_deg = np.empty(at_deg.shape, np.int64), np.empty(at_deg.shape)
    asked = places, len(places), at_deg, len(at_deg)
    is_done = run("hbr_nearest_view", *segments, azimuth_deg, *asked, rows, away_deg)
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
