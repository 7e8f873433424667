"""The pose of a found object: its uncertainty, and the poses that its views do not distinguish.

The support of the object's azimuths is turned into a posterior, p(φ) ∝ exp(κ A(φ) / √n). The standard uncertainty is a
half-width of this posterior around the estimated azimuth. Two constants are fitted on objects 1-50 of COIL-100, so that
68 % and 95 % of the true azimuths lie within one and two standard uncertainties. If the posterior has n equal parts,
the object looks the same every 360° / n. If it is spread over most azimuths, the object looks the same from all sides.

Coverage: docs/results.md; `python -m benchmarks.pose_coverage`.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from hbr.core.angles import wrap180, wrap360
from hbr.core.arrays import FloatArray
from hbr.dense.filter import Belief
from hbr.dense.index import BIN_DEG, BINS

#: κ, and the uncertainty as a share of the posterior's half-width, because azimuths are estimated finer than its bins.
SHARPNESS: Final = 120.0
WIDTH: Final = 0.68
#: A pose with a larger uncertainty is not determined.
LARGEST_SIGMA_DEG: Final = 30.0
#: The largest uncertainty with an n-fold symmetry, as a share of the period.
_LARGEST_SHARE: Final = 1 / 9
#: Each equivalent pose has at least this share of the probability of an equal one.
_LEAST_PART: Final = 0.25
#: An object looks the same from all sides if the likeliest azimuths, 95 % together, are at least this share of all.
_FREE_SHARE: Final = 0.5
#: Poses of an object that a comparison tries: those of at least this probability, relative to the likeliest one.
_MOST_POSES: Final = 3
_LEAST_POSE: Final = 0.02
_POSES_APART_DEG: Final = 25.0
_ORDERS: Final = range(2, 13)
_ONE_SIGMA, _TWO_SIGMA = 0.683, 0.954


@dataclass(frozen=True, slots=True)
class Pose:
    """Orientation of the camera around an object at the last query, if the views determine it.

    Attributes
    ----------
    azimuth_deg : tuple of float
        All azimuths that are equally likely, the estimated one first: one without symmetry, n if the object looks the
        same every 360° / n, none if no azimuth is determined.
    sigma_deg : float, optional
        Standard uncertainty of each; None if no azimuth is determined.
    period_deg : float, optional
        360 without symmetry, 360 / n, 0 if the object looks the same from all sides; None if that is not known.
    """

    azimuth_deg: tuple[float, ...]
    sigma_deg: float | None
    period_deg: float | None


def pose(belief: Belief, object_index: int) -> Pose:
    """Return the pose of an object that the filter considers."""
    azimuth_deg, p = _likely_azimuths(belief, object_index)
    return pose_of(p / p.sum(), azimuth_deg, azimuth_deg - belief.rotated_deg)


def poses_of(belief: Belief, object_index: int) -> tuple[float, ...]:
    """Return the likely azimuths of an object at the last view, the likeliest first; symmetric objects have several."""
    best_deg, likely = _likely_azimuths(belief, object_index)
    found = [best_deg]
    for place in np.argsort(-likely, kind="stable").tolist():
        azimuth_deg = float(wrap360(place * BIN_DEG + belief.rotated_deg))
        if likely[place] < _LEAST_POSE or len(found) == _MOST_POSES:
            break
        if min(abs(wrap180(azimuth_deg - one)) for one in found) >= _POSES_APART_DEG:
            found.append(azimuth_deg)
    return tuple(found)


def _likely_azimuths(belief: Belief, object_index: int) -> tuple[float, FloatArray]:
    """Return an object's estimated azimuth at the last query, and how likely those at the first one are, (72,)."""
    ranking = belief.ranking()
    (support,) = belief.support[belief.index.object_index == object_index].astype(np.float64)
    p: FloatArray = np.exp(SHARPNESS * (support - support.max()) / np.sqrt(belief.queries))
    return float(ranking.pose_deg[ranking.object_index == object_index][0]), p


def pose_of(posterior: FloatArray, azimuth_deg: float, estimate_deg: float) -> Pose:
    """Return the pose by the posterior of one object's azimuths, float64 (72,), at the first query.

    The estimated azimuth is ``azimuth_deg`` at the last query, and ``estimate_deg`` at the first one.
    """
    away_deg: FloatArray = np.arange(BINS, dtype=np.float64) * BIN_DEG - estimate_deg
    sigma_deg = _sigma_deg(posterior, away_deg, 360.0)
    if sigma_deg <= LARGEST_SIGMA_DEG:
        return Pose((azimuth_deg,), sigma_deg, 360.0)
    ordered = np.cumsum(-np.sort(-posterior))
    if np.searchsorted(ordered, _TWO_SIGMA) >= _FREE_SHARE * BINS:
        return Pose((), None, 0.0)
    for order in _ORDERS:
        period_deg = 360 / order
        sigma_deg = _sigma_deg(posterior, away_deg, period_deg)
        part = np.rint(away_deg / period_deg).astype(int) % order
        least = np.bincount(part, posterior, order).min()
        if sigma_deg <= _LARGEST_SHARE * period_deg and least >= _LEAST_PART / order:
            poses = tuple(wrap360(azimuth_deg + k * period_deg) for k in range(order))
            return Pose(poses, sigma_deg, period_deg)
    return Pose((), None, None)


def _sigma_deg(posterior: FloatArray, away_deg: FloatArray, period_deg: float) -> float:
    """Return the uncertainty: 68 % of the posterior is within its half-width, 95 % within twice as much."""
    away_deg = np.abs((away_deg + period_deg / 2) % period_deg - period_deg / 2)
    order = np.argsort(away_deg, kind="stable")
    share = np.cumsum(posterior[order])
    one, two = np.interp([_ONE_SIGMA, _TWO_SIGMA], share, away_deg[order])
    return float(WIDTH * max(one, two / 2))
