"""Kernels for parts of the descriptors of the object. Each returns None without the compiled library."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray, ImageArray
from hbr.kernels.library import address, library

Array = NDArray[Any]
Floats = NDArray[np.float32]

_DIRECTIONS = 8


def strongest(x: Array, y: Array) -> tuple[Floats, Floats] | None:
    """Return the gradient of the channel with the strongest edge at every pixel: (h, w, 3) -> (h, w)."""
    found = library()
    if found is None:
        return None
    x, y = np.ascontiguousarray(x, np.float32), np.ascontiguousarray(y, np.float32)
    own = np.empty((2, *x.shape[:2]), np.float32)
    found.hbr_strongest(address(x), address(y), own[0].size, address(own), address(own[1]))
    return own[0], own[1]


def votes(magnitude: Array, angle: Array, scale: np.float32) -> Floats | None:
    """Return the shares of each pixel's magnitude in eight directions: (h, w) -> (8, h, w)."""
    found = library()
    if found is None:
        return None
    magnitude, angle = np.ascontiguousarray(magnitude, np.float32), np.ascontiguousarray(angle, np.float32)
    shared = np.empty((_DIRECTIONS, *magnitude.shape), np.float32)
    found.hbr_votes(address(magnitude), address(angle), magnitude.size, scale, address(shared))
    return shared


def cell_means(image: ImageArray, weight: Floats, cells: int) -> tuple[FloatArray, FloatArray] | None:
    """Return the means of each cell's weighted colours and weights: (cells, cells, 3), (cells, cells)."""
    found = library()
    if found is None:
        return None
    image, weight = np.ascontiguousarray(image), np.ascontiguousarray(weight)
    means, covered = np.empty((cells, cells, 3)), np.empty((cells, cells))
    size = len(image) // cells
    found.hbr_cell_means(address(image), address(weight), cells, size, address(means), address(covered))
    return means, covered
