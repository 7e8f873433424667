"""Exposure of the rows of a rolling shutter: all rows are exposed equally long, one after the other."""

import numpy as np
from numpy.typing import NDArray


def row_weights(exposure: int, readout: int, steps: int, rows: int) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return times at which a frame is drawn, (n,), and the share of each image in each row, (n, rows).

    A row is the mean of images that are interpolated linearly between those of the times. So its mean time is exactly
    the middle of its exposure. Times in ns from the beginning of the first row; at least two.
    """
    times = np.linspace(0, exposure + readout, steps)
    begins = (np.arange(rows) + 0.5) / rows * readout
    weights = _below(begins + exposure, times) - _below(begins, times)
    return times, (weights / weights.sum(axis=0)).astype(np.float32)


def _below(until: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the integrals up to ``until`` (m,) of functions that are 1 at one of ``times`` and 0 at its neighbours."""
    away = np.clip((until - times[:, None]) / (times[1] - times[0]), -1, 1)
    below: NDArray[np.float64] = np.where(away < 0, np.square(1 + away) / 2, 1 - np.square(1 - away) / 2)
    return below


def bands(hz: float, depth: float, start: int, exposure: int, readout: int, rows: int) -> NDArray[np.float32]:
    """Return the light that each row receives from a flickering lamp during its exposure, (rows, 1, 1)."""
    begins_s = start * 1e-9 + np.arange(rows) / rows * readout * 1e-9
    middle_s = begins_s + exposure * 0.5e-9
    light = 1 + depth * np.sinc(hz * exposure * 1e-9) * np.cos(2 * np.pi * hz * middle_s)
    return light.astype(np.float32)[:, None, None]
