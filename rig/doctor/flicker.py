"""Recognise lamps that flicker with the mains, by the bands that they leave in the images of a rolling shutter."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MAINS_HZ = (50.0, 60.0)  # a lamp flickers at twice this rate
MIN_DEPTH = 0.01
"""Smallest amplitude, as a share of the mean level, that counts."""
_MIN_EXPLAINED = 0.6  # less: something else changes the light, such as a person who passes
_STANDS = 0.1
"""Variance of the lamp's phase from image to image below which bands stand still; 1 if all phases occur."""
_CYCLES = np.arange(0.0, 8.01, 0.125)
"""Bands in an image: at most 8, for a readout of 67 ms at 120 Hz."""
_BLOCKS = 48  # six for each band at most; more blocks are noisier
_STANDING_CYCLES = _CYCLES[_CYCLES >= 0.75]
"""Smallest number of bands; fewer look like a change of the scene from its top to its bottom."""


@dataclass(frozen=True, slots=True)
class MainsFlicker:
    """Flicker at twice the mains frequency; ``depth`` is its amplitude as a share of the mean level."""

    mains_hz: float
    depth: float

    def exposure_us(self, wanted_us: float) -> float:
        """Return the exposure time without bands that is nearest to ``wanted_us``: whole periods of the lamp."""
        return whole_periods_us(self.mains_hz, wanted_us)


def whole_periods_us(mains_hz: float, wanted_us: float) -> float:
    """Return the exposure time without bands that is nearest to ``wanted_us``."""
    period_us = 1e6 / (2 * mains_hz)
    return float(round(max(round(wanted_us / period_us), 1) * period_us))


def mains_flicker(row_levels: NDArray[np.float64], times_ns: NDArray[np.int64]) -> MainsFlicker | None:
    """Return the flicker of a still scene; None if there is none.

    The row at the share y of the height is exposed later by y times the readout. So a lamp with the frequency f adds
    cos(2π (f t + c y)) to the image at time t, with c bands. Both are fitted to the changes of each row. Bands that
    stand still, because f is a multiple of the frame rate, are not recognised: see `standing_flicker`.

    ``row_levels``, float64 (n, H), is the mean level of each row of n images at ``times_ns``, int64 (n,).
    """
    count, height = row_levels.shape
    if count < 4 or height < _BLOCKS:
        return None
    usable = _blocks(row_levels)
    mean = usable.mean(axis=0)
    changes = usable / np.maximum(mean, 1.0) - 1.0
    power = float((changes**2).mean())
    if power == 0.0:
        return None
    bands = np.exp(-2j * np.pi * np.outer(_MIDDLES, _CYCLES))
    best: tuple[float, float] = (0.0, 0.0)
    for mains_hz in MAINS_HZ:
        phases = _phases(mains_hz, times_ns)
        if (weight := float((np.abs(phases) ** 2).mean())) < _STANDS:
            continue
        fitted = np.abs(phases @ changes @ bands).max() / (count * _BLOCKS * weight)
        best = max(best, (2 * float(fitted), mains_hz))
    depth, mains_hz = best
    explained = depth**2 / 2 / power
    return MainsFlicker(mains_hz, depth) if depth >= MIN_DEPTH and explained >= _MIN_EXPLAINED else None


def standing_mains_hz(times_ns: NDArray[np.int64]) -> tuple[float, ...]:
    """Return the mains frequencies whose bands stand still in images of these times, int64 (n,)."""
    return tuple(hz for hz in MAINS_HZ if (np.abs(_phases(hz, times_ns)) ** 2).mean() < _STANDS)


def steady_levels(row_levels: NDArray[np.float64], times_ns: NDArray[np.int64], mains_hz: float) -> NDArray[np.float64]:
    """Return the level of each row without the bands of the other mains frequencies, which move from image to image.

    ``row_levels``, float64 (n, H), is the mean level of each row of n images, 4 or more, at ``times_ns``, int64 (n,).
    The bands of ``mains_hz`` stand still. Returns float64 (H,).
    """
    columns = [np.ones(len(times_ns))]
    for other_hz in MAINS_HZ:
        if other_hz != mains_hz:
            phases = _phases(other_hz, times_ns)
            columns += [phases.real, phases.imag]
    return np.asarray(np.linalg.lstsq(np.stack(columns, axis=1), row_levels, rcond=None)[0][0])


def standing_flicker(
    with_bands: NDArray[np.float64], without: NDArray[np.float64], mains_hz: float
) -> MainsFlicker | None:
    """Return the flicker whose bands stand still in the images of one exposure time; None if there is none.

    One exposure time does not separate bands from the scene. An exposure of whole periods of the lamp has no bands:
    the quotient of both is the bands, and a smooth function of the level if the camera's response is not linear.
    Decision: docs/decisions/0008.

    ``with_bands``, float64 (H,), is the mean level of each row at the exposure time in question, ``without`` the same
    at an exposure time of whole periods of the lamp.
    """
    if len(without) < _BLOCKS:
        return None
    one, other = _blocks(with_bands), _blocks(without)
    lit = (one > 1.0) & (other > 1.0)
    if lit.sum() < _BLOCKS / 2:
        return None
    quotient, y = np.log(one[lit] / other[lit]), _MIDDLES[lit]
    response = np.stack([np.ones(len(y)), np.log(other[lit])], axis=1)
    unexplained = _residual(response, quotient)[1]
    best: tuple[float, float] = (0.0, 0.0)
    for cycles in _STANDING_CYCLES:
        waves = np.stack([np.cos(2 * np.pi * cycles * y), np.sin(2 * np.pi * cycles * y)], axis=1)
        fitted, rest = _residual(np.hstack([response, waves]), quotient)
        best = max(best, (1.0 - rest / max(unexplained, 1e-12), float(np.hypot(*fitted[-2:]))))
    explained, depth = best
    return MainsFlicker(mains_hz, depth) if depth >= MIN_DEPTH and explained >= _MIN_EXPLAINED else None


_MIDDLES = (np.arange(_BLOCKS) + 0.5) / _BLOCKS


def _blocks(row_levels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of blocks of rows, float64 (..., `_BLOCKS`)."""
    height = row_levels.shape[-1]
    usable = row_levels[..., : height - height % _BLOCKS]
    return np.asarray(usable.reshape(*usable.shape[:-1], _BLOCKS, -1).mean(axis=-1))


def _phases(mains_hz: float, times_ns: NDArray[np.int64]) -> NDArray[np.complex128]:
    """Return the lamp's phase in each image as a complex number, without the mean, which is part of the scene."""
    phases = np.exp(-2j * np.pi * 2 * mains_hz * (times_ns - times_ns[0]) * 1e-9)
    return np.asarray(phases - phases.mean())


def _residual(design: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the coefficients of a fit by least squares, and the mean square of its residuals."""
    fitted = np.asarray(np.linalg.lstsq(design, values, rcond=None)[0], dtype=np.float64)
    return fitted, float(((values - design @ fitted) ** 2).mean())
