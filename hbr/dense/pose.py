"""The pose of an object: the orientation of the camera around it at the last view, its uncertainty and its symmetry.

The support of `hbr.dense.filter` is flat around each enrolled view. To estimate azimuths between enrolled views, the
similarities of a query to all m views of the object are compared with those that a view at each azimuth φ would have:
between two enrolled views, these change linearly. ρ(φ) is the correlation of both. With the support A(φ) of the query,

    log p(φ) = κ s(φ) - ν/2 (1 - 2/m) log(v (1 - ρ(φ)²) + σ²)

where s(φ) is the mean similarity of A(φ), and v is the variance of its similarities. If all views look alike, they
differ by noise, and p is flat. The logarithms of n queries are added, and divided by √n as in `Belief.posterior`. κ, ν
and σ are those with the most probability at the true azimuths on objects 1-50 of COIL-100, after mild and hard changes
of a drawn bench and in the photographs as they are, with views 10° and 45° apart. κ and ν are divided by 1.2, because
other photographs fit less.

Coverage: docs/results.md; `rig eval mild-change`. Decision: docs/decisions/0014.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from hbr.core.angles import wrap180, wrap360
from hbr.core.arrays import FloatArray
from hbr.dense.filter import Belief
from hbr.dense.index import BIN_DEG, BINS, DenseIndex
from hbr.dense.space import Floats
from hbr.descriptors.registry import FULL

#: κ, ν and σ.
_SHARPNESS: Final = 25.0
_FREEDOM: Final = 6.7
_NOISE: Final = 0.04
#: The uncertainty, relative to the mean distance of the azimuths from the estimated one: 95 % of the poses of objects
#: 1-50 of COIL-100 and odd ones of ETH-80 are within 2 σ. It depends on the number of views, at most four in the data,
#: on the distance of the enrolled ones from each other, and on the network's part.
_WIDTH, _OF_VIEWS, _OF_DISTANCE, _OF_NETWORK = 0.88, -0.4, 0.5, 0.8
#: Probability with which an azimuth, or one of several equivalent ones, is right within a sixth of the period.
_SURE: Final = 0.95  # more: fewer answers state a rotation; less: more of these are wrong
#: Each equivalent azimuth has at least this share of the probability of an equal one.
_LEAST_PART: Final = 0.25
#: An object looks the same from all sides if its likeliest azimuths, 95 % together, are at least this share of all.
_FREE_SHARE: Final = 0.2  # a symmetry of two, three or more parts leaves most azimuths unlikely
_ORDERS: Final = range(1, 13)  # up to 30°: finer symmetries are hardly visible with views 10° apart
#: Azimuths this near to the likeliest one count for the estimate.
_AROUND_DEG: Final = 25.0
_DEGREES: Final = np.arange(360.0)


@dataclass(frozen=True, slots=True)
class Pose:
    """Orientation of the camera around an object at the last query, if the views determine it."""

    azimuth_deg: tuple[float, ...]
    """All azimuths that are equally likely, the estimated one first: one without symmetry, n if the object looks the
    same every 360° / n, none if no azimuth is determined."""
    sigma_deg: float | None
    """Standard uncertainty of each; None if no azimuth is determined."""
    period_deg: float | None
    """360 without symmetry, 360 / n, 0 if the object looks the same from all sides; None if that is not known."""


def pose(belief: Belief, object_index: int) -> Pose:
    """Return the pose of an object that the filter considers."""
    alone = _alone(belief, object_index)
    apart = max(360 / len(alone.views) / 10, 1.0)
    width = _WIDTH * min(max(belief.amount, 1.0), 4.0) ** _OF_VIEWS * apart**_OF_DISTANCE
    return pose_of(_log_p(belief, alone), width * (_OF_NETWORK if alone.views.descriptor == FULL else 1.0))


def azimuth_of(belief: Belief, object_index: int) -> float:
    """Return the likeliest azimuth of an object at the last view."""
    return _estimated_deg(_log_p(belief, _alone(belief, object_index)))


def pose_of(log_p: FloatArray, width: float = _WIDTH) -> Pose:
    """Return the pose by the log-probability of 0, 1, ... 359° at the last query, (360,)."""
    azimuth_deg = _estimated_deg(log_p)
    p = _probability(log_p)
    for order in _ORDERS:
        period_deg = 360 / order
        away_deg = (_DEGREES - azimuth_deg + period_deg / 2) % period_deg - period_deg / 2
        part = np.rint((_DEGREES - azimuth_deg - away_deg) / period_deg).astype(int) % order
        near = p * (np.abs(away_deg) <= period_deg / 6)
        share = float(near.sum())
        if share >= _SURE and np.bincount(part, near, order).min() >= _LEAST_PART / order:
            poses_deg = tuple(float(wrap360(azimuth_deg + k * period_deg)) for k in range(order))
            return Pose(poses_deg, float(width * near @ np.abs(away_deg) / share), period_deg)
    likely = np.searchsorted(np.cumsum(-np.sort(-_probability(log_p))), _SURE)
    return Pose((), None, 0.0 if likely >= _FREE_SHARE * 360 else None)


def _estimated_deg(log_p: FloatArray) -> float:
    """Return the mean of the azimuths around the likeliest one."""
    away_deg = wrap180(_DEGREES - log_p.argmax())
    near = _probability(log_p) * (np.abs(away_deg) <= _AROUND_DEG)
    return float(wrap360(log_p.argmax() + near @ away_deg / near.sum()))


def _probability(log_p: FloatArray) -> FloatArray:
    p: FloatArray = np.exp(log_p - log_p.max())
    p /= p.sum()
    return p


def _alone(belief: Belief, object_index: int) -> DenseIndex:
    return belief.index.only(np.flatnonzero(belief.index.object_index == object_index))


def _log_p(belief: Belief, alone: DenseIndex) -> FloatArray:
    """Return the log-probability of 0, 1, ... 359° at the last query, (360,), for the only object of an index."""
    each = _log_p_of_each(alone, np.array([alone.z(query) for query in belief.vectors]))
    weights = np.full(belief.queries, belief.queries**-0.5) if belief.weights is None else belief.weights
    seen_deg = _DEGREES + (belief.orientation_deg - belief.orientation_deg[-1])[:, None]
    log_p: FloatArray = weights @ np.array(
        [np.interp(at, _DEGREES, one, period=360) for at, one in zip(seen_deg, each, strict=True)]
    )
    return log_p


def _log_p_of_each(alone: DenseIndex, z: Floats) -> FloatArray:
    """Return the log-probability of 0, 1, ... 359° for each query, (n, 360), by its z of all views, (n, views)."""
    rows, space = alone.rows_of(0), alone.space
    mutual = alone.among(rows[None])[0]
    expected = np.stack([np.interp(_DEGREES, alone.views.azimuth_deg[rows], one, period=360) for one in mutual], axis=1)
    own, alike = _centred(space.similarity(z[:, rows])), _unit_rows(_centred(expected))
    unlike = np.mean(own**2, axis=1, keepdims=True) - np.maximum(own @ alike.T, 0) ** 2 / len(rows)
    bins_deg = np.arange(BINS) * BIN_DEG
    support = np.array([np.interp(_DEGREES, bins_deg, alone.support(one, 0.0)[0], period=360) for one in z])
    # three similarities less their mean are a point on a plane: they fit some azimuth in any case
    freedom = _FREEDOM * (1 - 2 / len(rows)) if len(rows) > 3 else 0.0
    log_p: FloatArray = _SHARPNESS * space.similarity(support) - freedom / 2 * np.log(unlike + _NOISE**2)
    return log_p


def _unit_rows(rows: FloatArray) -> FloatArray:
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    unit: FloatArray = np.divide(rows, length, out=np.zeros_like(rows), where=length > 0)
    return unit


def _centred(rows: FloatArray) -> FloatArray:
    centred: FloatArray = rows - rows.mean(axis=1, keepdims=True)
    return centred
