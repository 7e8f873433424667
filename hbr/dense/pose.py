"""The pose of an object: the orientation of the camera around it at the last view, its uncertainty and its symmetry.

The support of `hbr.dense.filter` is flat around each enrolled view. To estimate azimuths between enrolled views, the
similarities of a query to all m views of the object are compared with those that a view at each azimuth φ would have:
between two enrolled views, these change linearly. ρ(φ) is the correlation of both. With the support A(φ) of the query,

    log p(φ) = κ A(φ) - ν/2 (1 - 2/m) log(v (1 - ρ(φ)²) + σ²)

where v is the variance of its similarities. If all views look alike, they differ by noise, and p is flat. The
logarithms of n queries are added, and divided by √n as in `Belief.posterior`. κ, ν and σ are those with the most
probability at the true azimuths on objects 1-50 of COIL-100, after mild and hard changes of a drawn bench, with views
10° to 45° apart.

These logarithms promise too much if the bench changed, or if the views of an object do not predict those between them.
So they are divided by a doubt before a pose counts as determined. It is a product of two factors, each at least 1:

- Half of the object's views are queries among the other half. The factor is the mean distance of log p at the true
  azimuth from its maximum.
- The mean support of the best hypothesis is at most 1. The other factor is the root of what is missing to 1, relative
  to what is usually missing on the bench of the enrollment.

Coverage: docs/results.md; `rig eval mild-change`. Decision: docs/decisions/0014.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from hbr.core.angles import size_deg, wrap180, wrap360
from hbr.core.arrays import FloatArray
from hbr.dense.filter import Belief
from hbr.dense.index import BIN_DEG, BINS, DenseIndex, raised, unit_rows

#: κ, ν and σ.
_SHARPNESS: Final = 70.0
_FREEDOM: Final = 4.0
_NOISE: Final = 5e-3
#: The uncertainty, relative to the mean distance of the azimuths from the estimated one.
_WIDTH: Final = 1.1
#: What is usually missing from a mean support of 1 on the bench of the enrollment.
_USUALLY_MISSING: Final = 0.1
#: Probability with which an azimuth, or one of several equivalent ones, is right within a sixth of the period.
_SURE: Final = 0.95  # more: fewer answers state a rotation; less: more of these are wrong
#: Each equivalent azimuth has at least this share of the probability of an equal one.
_LEAST_PART: Final = 0.25
#: An object looks the same from all sides if its likeliest azimuths, 95 % together, are at least this share of all.
_FREE_SHARE: Final = 0.5  # a symmetry of two, three or more parts leaves most azimuths unlikely
_ORDERS: Final = range(1, 13)  # up to 30°: finer symmetries are hardly visible with views 10° apart
#: Poses of an object that a comparison tries: those of at least this probability, relative to the likeliest one.
# more poses, or less likely ones: the right one is missed less often; each is registered again, which takes time
_MOST_POSES: Final = 3
_LEAST_POSE: Final = 0.02
_POSES_APART_DEG: Final = 25.0
_DEGREES: Final = np.arange(360.0)


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
    alone = _alone(belief, object_index)
    missing = 1 - float(belief.support[belief.index.object_index == object_index].max()) / belief.amount
    return pose_of(_log_p(belief, alone), _doubt(alone) * max(1.0, missing / _USUALLY_MISSING) ** 0.5)


def poses_of(belief: Belief, object_index: int) -> tuple[float, ...]:
    """Return the likely azimuths of an object at the last view, the likeliest first; symmetric objects have several."""
    log_p = _log_p(belief, _alone(belief, object_index))
    found = [_estimated_deg(log_p)]
    for azimuth_deg in np.argsort(-log_p, kind="stable").tolist():
        if log_p[azimuth_deg] < log_p.max() + np.log(_LEAST_POSE) or len(found) == _MOST_POSES:
            break
        if min(size_deg(azimuth_deg - np.array(found))) >= _POSES_APART_DEG:
            found.append(float(azimuth_deg))
    return tuple(found)


def pose_of(log_p: FloatArray, doubt: float = 1.0) -> Pose:
    """Return the pose by the log-probability of 0, 1, ... 359° at the last query, (360,), and the divisor of it."""
    azimuth_deg = _estimated_deg(log_p)
    p = _probability(log_p / doubt)
    for order in _ORDERS:
        period_deg = 360 / order
        away_deg = (_DEGREES - azimuth_deg + period_deg / 2) % period_deg - period_deg / 2
        part = np.rint((_DEGREES - azimuth_deg - away_deg) / period_deg).astype(int) % order
        near = p * (np.abs(away_deg) <= period_deg / 6)
        share = float(near.sum())
        if share >= _SURE and np.bincount(part, near, order).min() >= _LEAST_PART / order:
            poses_deg = tuple(float(wrap360(azimuth_deg + k * period_deg)) for k in range(order))
            return Pose(poses_deg, float(_WIDTH * near @ np.abs(away_deg) / share), period_deg)
    likely = np.searchsorted(np.cumsum(-np.sort(-_probability(log_p))), _SURE)
    return Pose((), None, 0.0 if likely >= _FREE_SHARE * 360 else None)


def _estimated_deg(log_p: FloatArray) -> float:
    """Return the mean of the azimuths around the likeliest one."""
    away_deg = wrap180(_DEGREES - log_p.argmax())
    near = _probability(log_p) * (np.abs(away_deg) <= _POSES_APART_DEG)
    return float(wrap360(log_p.argmax() + near @ away_deg / near.sum()))


def _probability(log_p: FloatArray) -> FloatArray:
    p: FloatArray = np.exp(log_p - log_p.max())
    p /= p.sum()
    return p


def _alone(belief: Belief, object_index: int) -> DenseIndex:
    return belief.index.only(np.flatnonzero(belief.index.object_index == object_index))


def _log_p(belief: Belief, alone: DenseIndex) -> FloatArray:
    """Return the log-probability of 0, 1, ... 359° at the last query, (360,), for the only object of an index."""
    each = _log_p_of_each(alone, np.array([alone.similarity(query) for query in belief.levels]))
    weights = np.full(belief.queries, belief.queries**-0.5) if belief.weights is None else belief.weights
    seen_deg = _DEGREES + (belief.orientation_deg - belief.orientation_deg[-1])[:, None]
    log_p: FloatArray = weights @ np.array([_at(*one) for one in zip(seen_deg, each, strict=True)])
    return log_p


def _log_p_of_each(alone: DenseIndex, similar: FloatArray) -> FloatArray:
    """Return the log-probability of 0, 1, ... 359° for each query, (n, 360), by its similarities to all views."""
    rows = alone.rows_of(0)
    mutual = raised(alone.compared.among(rows[None])[0]).astype(np.float64)
    expected = np.stack([np.interp(_DEGREES, alone.views.azimuth_deg[rows], one, period=360) for one in mutual], axis=1)
    own, alike = _centred(raised(similar[:, rows]).astype(np.float64)), unit_rows(_centred(expected))
    unlike = np.mean(own**2, axis=1, keepdims=True) - np.maximum(own @ alike.T, 0) ** 2 / len(rows)
    bins_deg = np.arange(BINS) * BIN_DEG
    support = np.array([np.interp(_DEGREES, bins_deg, alone.support(one, 0.0)[0], period=360) for one in similar])
    freedom = _FREEDOM * max(0.0, 1 - 2 / len(rows))
    log_p: FloatArray = _SHARPNESS * support - freedom / 2 * np.log(unlike + _NOISE**2)
    return log_p


def _centred(rows: FloatArray) -> FloatArray:
    centred: FloatArray = rows - rows.mean(axis=1, keepdims=True)
    return centred


def _at(azimuth_deg: FloatArray, log_p: FloatArray) -> FloatArray:
    at: FloatArray = np.interp(azimuth_deg, _DEGREES, log_p, period=360)
    return at


def _doubt(alone: DenseIndex) -> float:
    """Return how far log p is below its maximum at the true azimuth, the mean of an object's views, at least 1.

    Each half of the views are queries among the other half.
    """
    rows = alone.rows_of(0)
    if len(rows) < 3:
        return 1.0
    # every second view, and so that views 180° apart are in the same half: one would show the other's azimuth
    half = np.arange(len(rows)) % -(-len(rows) // 2) % 2
    below = []
    for queries in (rows[half == 0], rows[half == 1]):
        log_p = _log_p_of_each(alone.without(queries), alone.compared.similarity(alone.views.levels(queries)))
        true_deg = alone.views.azimuth_deg[queries]
        below += [one.max() - _at(deg, one) for deg, one in zip(true_deg, log_p, strict=True)]
    return max(1.0, float(np.mean(below)))
