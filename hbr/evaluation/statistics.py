"""Confidence intervals of hit rates, and tests of two methods on the same trials."""

from math import comb, sqrt
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.arrays import FloatArray

Hits = NDArray[np.bool_]

_CONFIDENCE: Final = 0.95  # usual in the literature
_RESAMPLES: Final = 2000
"""Draws of all objects with replacement."""


def wilson(hits: int, trials: int) -> tuple[float, float]:
    """Return Wilson's 95 % score interval of a proportion, around ``hits / trials`` and within 0..1.

    Raises `ValueError`: there is no trial, or hits are not within 0..trials.

    Source: E. B. Wilson, "Probable Inference, the Law of Succession, and Statistical Inference", JASA 22 (1927) 209.
    """
    if trials < 1 or not 0 <= hits <= trials:
        raise ValueError(f"{hits} hits of {trials} trials; at least one trial and no more hits than trials are needed")
    z = NormalDist().inv_cdf((1 + _CONFIDENCE) / 2)
    rate = hits / trials
    shrink = 1 + z * z / trials
    centre = (rate + z * z / (2 * trials)) / shrink
    half = z / shrink * sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    # the limits 0 and 1 are exact if there is no hit or no miss; rounding must not change them
    return (0.0 if hits == 0 else centre - half), (1.0 if hits == trials else centre + half)


def mcnemar_exact(only_first: int, only_second: int) -> float:
    """Return the two-sided exact p-value of McNemar's test; 1 if the methods differ in no trial.

    The arguments count the trials that only the first, or only the second method hit.
    """
    if only_first < 0 or only_second < 0:
        raise ValueError(f"{only_first} and {only_second} discordant trials; counts cannot be negative")
    trials = only_first + only_second
    tail = sum(comb(trials, i) for i in range(min(only_first, only_second) + 1))
    p_value: float = 2 * tail / 2**trials
    return min(1.0, p_value)


def bootstrap_difference(first: Hits, second: Hits, rng: np.random.Generator) -> tuple[float, float]:
    """Return the 95 % percentile interval of the difference of two hit rates, by resampling complete objects.

    The trials of one object are similar: an interval for independent trials would be too narrow. ``first`` and
    ``second``, bool (objects, trials), are hits on the same trials; the interval is that of
    ``first.mean() - second.mean()``.
    """
    if first.shape != second.shape or first.ndim != 2 or not first.size:
        raise ValueError(f"hits of shapes {first.shape} and {second.shape}; one (objects, trials) for both is needed")
    return bootstrap_mean(first.mean(axis=1) - second.mean(axis=1), rng)


def bootstrap_mean(by_object: FloatArray, rng: np.random.Generator) -> tuple[float, float]:
    """Return the 95 % percentile interval of the mean of values of objects, (n,), by resampling them with ``rng``."""
    drawn = by_object[rng.integers(len(by_object), size=(_RESAMPLES, len(by_object)))].mean(axis=1)
    low, high = np.quantile(drawn, [(1 - _CONFIDENCE) / 2, (1 + _CONFIDENCE) / 2])
    return float(low), float(high)
