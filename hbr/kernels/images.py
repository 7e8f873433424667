"""Kernels for images, masks and descriptors as functions of arrays.

Each returns None without the compiled library: the caller has the reference.
"""

import ctypes
from functools import lru_cache
from math import ceil, floor
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray
from hbr.kernels.calls import WORKSPACE
from hbr.kernels.library import run

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

#: Largest number of bytes whose sum fits into 16 bits.
_MOST_ROWS: Final = 257
#: Margin of a mask in the kernels, in pixels.
_EDGE: Final = 16
#: Size of a run of pixels in the kernel for connected parts, and memory for each pixel of a cut, in float64 numbers.
_RUN: Final = 6
_CUT: Final = 18
_DIRECTIONS: Final = 8


def shrink(image: ImageArray, size: tuple[int, int]) -> ImageArray | None:
    """Return an image averaged to (width, height), as cv2.INTER_AREA does, if one whole number above 2 divides it."""
    width, height = size
    factor = image.shape[1] // width
    if not 2 < factor <= _MOST_ROWS or image.shape[:2] != (height * factor, width * factor):
        return None
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


def surround(crop: ImageArray, mask: Bytes, bright: float) -> ImageArray | None:
    """Return a square crop with an even grey around the object, like `Segmentation.alone`."""
    side = len(crop)
    if crop.shape != (side, side, 3) or mask.shape != (side, side):
        return None
    crop, mask = np.ascontiguousarray(crop), np.ascontiguousarray(mask)
    blurred, line, out = np.empty(side * side, np.uint16), np.empty(side + 14, np.uint8), np.empty_like(crop)
    return out if run("hbr_surround", crop, mask, side, bright, line, blurred, out) else None


def compare(
    small: ImageArray,
    table: ImageArray,
    logarithm: Floats,
    table_log: Floats,
    sides: tuple[Floats, Floats],
    noise: Floats,
    agrees_below: float,
) -> tuple[Floats, Floats, Bytes, Bytes, Bytes] | None:
    """Compare a small frame with an empty-table image, as `hbr.segmentation.background.Background.difference` does.

    ``logarithm`` (256,) is that of each level, ``table_log`` (h, w, 3) that of the table. Returns the planes ``evenly``
    and ``coloured``, and 0 or 1 for pixels that are certain, possible and in agreement.
    """
    height, width = small.shape[:2]
    own = [np.ascontiguousarray(one) for one in (small, table, logarithm, table_log, *sides, noise)]
    floats, masks = np.empty((2, height, width), np.float32), np.empty((3, height, width), np.uint8)
    line = np.empty(8 * width, np.float32)
    is_done = run("hbr_difference", *own[:4], height, width, *own[4:], agrees_below, line, *floats, *masks)
    return (floats[0], floats[1], masks[0], masks[1], masks[2]) if is_done else None


class Disc(NamedTuple):
    """A symmetric disc; ``reach`` (2 radius + 1) says how many pixels each of its rows reaches to both sides."""

    radius: int
    reach: NDArray[np.int64]


def cleaned(mask: Bytes, opens: Disc, closes: Disc) -> Bytes | None:
    """Return a mask (h, w) after morphological opening with one disc and closing with another one.

    The radii are below 16. Pixels outside the mask do not count, as in cv2.morphologyEx.
    """
    height, width = mask.shape
    mask, out, work = np.ascontiguousarray(mask), np.empty((height, width), np.uint8), _work(height, width)
    discs = opens.reach, opens.radius, closes.reach, closes.radius
    return out if run("hbr_cleaned", mask, height, width, *discs, work, out) else None


def filled(mask: Bytes, closes: Disc) -> Bytes | None:
    """Return a mask (h, w) after closing with a disc of a radius below 16, without holes."""
    height, width = mask.shape
    work = _work(height + 2 * _EDGE, width)
    mask, out = np.ascontiguousarray(mask), np.empty((height, width), np.uint8)
    return out if run("hbr_filled", mask, height, width, closes.reach, closes.radius, work, out) else None


def _work(rows: int, width: int) -> NDArray[np.uint64]:
    """Return zeros for four masks of a bit for each pixel."""
    return np.zeros(4 * rows * ((width + 2 * _EDGE + 63) // 64) + 4, np.uint64)


def largest_parts(mask: Bytes, framed: bool, near: int, least: float, of_border: float, share: float) -> Bytes | None:
    """Return the largest part of a mask of 0 and 1, and those that have this share of its area.

    Parameters
    ----------
    mask : uint8 array (h, w)
    framed : bool
        Whether parts that touch the border are left out, and only parts nearer than ``near`` pixels count.
    near : int
    least : float
        Smallest area of the largest part; also a share ``of_border`` of the largest part at the border.
    of_border, share : float

    Returns
    -------
    uint8 array (h, w)
        Without elements, (0,), if the largest part is too small.
    """
    height, width = mask.shape
    mask, out, done = np.ascontiguousarray(mask), np.empty((height, width), np.uint8), ctypes.c_int64()
    work = WORKSPACE.grown(_RUN * height * (width + 1) // 2)
    limits = framed, near, least, of_border, share
    if not run("hbr_largest_parts", mask, height, width, *limits, work.address, out, ctypes.byref(done)):
        return None
    return out if done.value else np.empty(0, np.uint8)


def likely_parts(mask: Bytes, prior: NDArray[np.float32], near: int, share: float, mean: float) -> Bytes | None:
    """Return the part of a mask of 0 and 1 with the largest sum of ``prior``, and those that belong to it.

    Parameters
    ----------
    mask : uint8 array (h, w)
    prior : float32 array (h, w)
    near : int
        Smallest distance, in pixels, of parts that do not belong to the main part.
    share : float
        Smallest share of the main part's area for another part.
    mean : float
        Smallest mean of ``prior`` for another part.

    Returns
    -------
    uint8 array (h, w)
        Without elements, (0,), if the mask is empty.
    """
    height, width = mask.shape
    mask, prior = np.ascontiguousarray(mask), np.ascontiguousarray(prior)
    out, done = np.empty((height, width), np.uint8), ctypes.c_int64()
    work = WORKSPACE.grown(_RUN * height * (width + 1) // 2)
    limits = near, share, mean
    if not run("hbr_likely_parts", mask, height, width, prior, *limits, work.address, out, ctypes.byref(done)):
        return None
    return out if done.value else np.empty(0, np.uint8)


def samples(
    small: ImageArray, useful: NDArray[np.bool_], logarithm: Floats, table_log: Floats, plane: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return every fifth pixel in both directions that is neither black nor overexposed in both images.

    Parameters
    ----------
    small : uint8 array (h, w, 3)
        An image,
    useful : bool array (h, w)
        Which pixels of the other image are useful.
    logarithm : float32 array (256,)
        The logarithm of each level of ``small``.
    table_log : float32 array (h, w, 3)
        The logarithms of the other image.
    plane : float64 array (rows, columns, 3)
        The basis of the fit at these pixels.

    Returns
    -------
    basis, difference : float64 arrays (n, 3)
    median : float64 array (3,)
        Of the differences.
    """
    own = [np.ascontiguousarray(one) for one in (small, useful, logarithm, table_log, plane)]
    most = plane.shape[0] * plane.shape[1]
    taken, median, count = np.empty((2, most, 3)), np.zeros(3), ctypes.c_int64()
    work = WORKSPACE.grown(3 * most)
    is_done = run("hbr_samples", *own[:4], *useful.shape, own[4], work.address, *taken, median, ctypes.byref(count))
    return (taken[0, : count.value], taken[1, : count.value], median) if is_done else None


def inliers(
    values: FloatArray, fitted: FloatArray, basis: FloatArray, tolerance: float, quarter: int
) -> tuple[FloatArray, FloatArray] | None:
    """Return the rows of ``basis`` and ``values`` (n, 3) that are near what is fitted: at least ``quarter`` + 1.

    Raises
    ------
    ValueError
        The arrays are not contiguous.
    """
    if not values.flags.c_contiguous or not fitted.flags.c_contiguous or not basis.flags.c_contiguous:
        raise ValueError("the rows of a fit have gaps")
    count = len(values)
    near, kept = np.empty((2, count, 3)), ctypes.c_int64()
    work = WORKSPACE.grown(2 * count)
    given = values, fitted, basis, count, tolerance, quarter
    if not run("hbr_inliers", *given, work.address, *near, ctypes.byref(kept)):
        return None
    return near[0, : kept.value], near[1, : kept.value]


def strongest(x: NDArray[Any], y: NDArray[Any]) -> tuple[Floats, Floats] | None:
    """Return the gradient of the channel with the strongest edge at every pixel: (h, w, 3) -> (h, w)."""
    x, y = np.ascontiguousarray(x, np.float32), np.ascontiguousarray(y, np.float32)
    own = np.empty((2, *x.shape[:2]), np.float32)
    return (own[0], own[1]) if run("hbr_strongest", x, y, own[0].size, *own) else None


def votes(magnitude: NDArray[Any], angle: NDArray[Any], scale: np.float32) -> Floats | None:
    """Return the shares of each pixel's magnitude in eight directions: (h, w) -> (8, h, w)."""
    magnitude, angle = np.ascontiguousarray(magnitude, np.float32), np.ascontiguousarray(angle, np.float32)
    shared = np.empty((_DIRECTIONS, *magnitude.shape), np.float32)
    return shared if run("hbr_votes", magnitude, angle, magnitude.size, scale, shared) else None


def cell_means(image: ImageArray, weight: Floats, cells: int) -> tuple[FloatArray, FloatArray] | None:
    """Return the means of each cell's weighted colours and weights: (cells, cells, 3), (cells, cells)."""
    image, weight = np.ascontiguousarray(image), np.ascontiguousarray(weight)
    means, covered = np.empty((cells, cells, 3)), np.empty((cells, cells))
    is_done = run("hbr_cell_means", image, weight, cells, len(image) // cells, means, covered)
    return (means, covered) if is_done else None


@lru_cache(maxsize=1)
def _functions() -> tuple[int, int] | None:
    """Return the addresses of exp and log of the C library, which OpenCV calls, too; None if there is none."""
    for name in ("libm.so.6", None):
        try:
            found = ctypes.CDLL(name)
            exponential, logarithm = (ctypes.cast(each, ctypes.c_void_p).value for each in (found.exp, found.log))
        except (OSError, AttributeError):
            continue
        if exponential and logarithm:
            return exponential, logarithm
    return None


def grab_cut(image: ImageArray, start: NDArray[np.bool_], inner: tuple[int, int, int, int]) -> NDArray[np.uint8] | None:
    """Return the mask of one iteration of `cv2.grabCut` with the seed 0 of its random numbers, 0 or 1 (h, w).

    Pixels outside of the rectangle ``inner`` (left, top, right, bottom), which is not at the frame's border, are
    background. Inside, ``start`` (h, w) marks the pixels that probably show the object. Also returns None for images
    whose colours OpenCV cannot separate, or with too many pixels.

    The mask is that of OpenCV 5.0.0 on x86-64, bit by bit.
    """
    functions = _functions()
    if functions is None:
        return None
    height, width = start.shape
    image, start = np.ascontiguousarray(image), np.ascontiguousarray(start)
    mask, done = np.empty((height, width), np.uint8), ctypes.c_int64()
    work = WORKSPACE.grown(_CUT * height * width)
    rectangle = (ctypes.c_int64 * 4)(*inner)
    run("hbr_grab_cut", image, height, width, rectangle, start, *functions, work.address, mask, ctypes.byref(done))
    return mask if done.value else None
