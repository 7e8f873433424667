"""What the rows of a rolling shutter collect: each row is exposed for as long, one after the other."""

import numpy as np
from numpy.typing import NDArray

from sim.objects.projection import HEIGHT


def row_weights(exposure: int, readout: int, steps: int) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Divide the time of a frame into steps: return their middles (n,), and the share of each in each row, (n, HEIGHT).

    A step counts as far as it lies within the row's exposure; times in ns from the beginning of the first row.
    """
    middles = (np.arange(steps) + 0.5) / steps * (exposure + readout)
    begins = (np.arange(HEIGHT) + 0.5) / HEIGHT * readout
    half = (exposure + readout) / steps / 2
    ends = np.minimum(middles[:, None] + half, begins + exposure)
    weights = np.clip(ends - np.maximum(middles[:, None] - half, begins), 0, None)
    return middles, (weights / weights.sum(axis=0)).astype(np.float32)


def bands(hz: float, depth: float, start: int, exposure: int, readout: int) -> NDArray[np.float32]:
    """Return the light that each row receives from a flickering lamp during its exposure, (HEIGHT, 1, 1)."""
    begins_s = start * 1e-9 + np.arange(HEIGHT) / HEIGHT * readout * 1e-9
    middle_s = begins_s + exposure * 0.5e-9
    light = 1 + depth * np.sinc(hz * exposure * 1e-9) * np.cos(2 * np.pi * hz * middle_s)
    return light.astype(np.float32)[:, None, None]
