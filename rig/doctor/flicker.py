"""Recognise lamps that flicker with the mains, by the bands that they leave in the images of a rolling shutter."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MAINS_HZ = (50.0, 60.0)
MIN_DEPTH = 0.01
"""Smallest amplitude, as a share of the mean level, that counts."""
_MIN_EXPLAINED = 0.6
_CYCLES = np.arange(0.0, 8.01, 0.125)
"""Bands in an image: at most 8, for a readout of 67 ms at 120 Hz."""
_BLOCKS = 48


@dataclass(frozen=True, slots=True)
class MainsFlicker:
    """Flicker at twice the mains frequency; ``depth`` is its amplitude as a share of the mean level."""

    mains_hz: float
    depth: float

    def exposure_us(self, wanted_us: float) -> float:
        """Return the exposure time without bands that is nearest to ``wanted_us``: whole periods of the lamp."""
        period_us = 1e6 / (2 * self.mains_hz)
        return float(round(max(round(wanted_us / period_us), 1) * period_us))


def mains_flicker(row_levels: NDArray[np.float64], times_ns: NDArray[np.int64]) -> MainsFlicker | None:
    """Return the flicker of a still scene; None if there is none.

    The row at the share y of the height is exposed later by y times the readout. So a lamp with the frequency f adds
    cos(2π (f t + c y)) to the image at time t, with c bands. Both are fitted to the changes of each row. Bands that
    stand still, because f is a multiple of the frame rate, are not recognised.

    Parameters
    ----------
    row_levels : float64 (n, H)
        Mean level of each row of n images.
    times_ns : int64 (n,)
        Time of each image.
    """
    count, height = row_levels.shape
    if count < 4 or height < _BLOCKS:
        return None
    usable = row_levels[:, : height - height % _BLOCKS].reshape(count, _BLOCKS, -1).mean(axis=2)
    mean = usable.mean(axis=0)
    changes = usable / np.maximum(mean, 1.0) - 1.0
    power = float((changes**2).mean())
    if power == 0.0:
        return None
    seconds = (times_ns - times_ns[0]) * 1e-9
    y = (np.arange(_BLOCKS) + 0.5) / _BLOCKS
    bands = np.exp(-2j * np.pi * np.outer(y, _CYCLES))
    best: tuple[float, float] = (0.0, 0.0)
    for mains_hz in MAINS_HZ:
        turns = np.exp(-2j * np.pi * 2 * mains_hz * seconds)
        turns -= turns.mean()  # what does not change from image to image is part of the scene
        if (weight := float((np.abs(turns) ** 2).mean())) < 0.1:
            continue
        fitted = np.abs(turns @ changes @ bands).max() / (count * _BLOCKS * weight)
        best = max(best, (2 * float(fitted), mains_hz))
    depth, mains_hz = best
    explained = depth**2 / 2 / power
    return MainsFlicker(mains_hz, depth) if depth >= MIN_DEPTH and explained >= _MIN_EXPLAINED else None
