"""What answers say about the pose, compared with the truth."""

from typing import NamedTuple

import numpy as np

from hbr.core.angles import wrap180
from hbr.core.arrays import FloatArray
from hbr.dense.pose import Pose

#: An error of a pose from which on it is of another side of the object.
_FAR_DEG = 30.0


class StatedPose(NamedTuple):
    """The pose that an answer states."""

    number: int
    """Number of azimuths that are equally likely; 0 if none is stated."""
    error_deg: float | None = None
    """Distance of the nearest of them from the true one."""
    sigma_deg: float | None = None
    """Its standard uncertainty."""
    toward_deg: float | None = None
    """The error towards the nearest enrolled view; None if the object is seen from there, or from half-way between
    two."""


def stated_pose(found: Pose, true_deg: float, enrolled_deg: FloatArray) -> StatedPose:
    """Return what a pose says, for a true azimuth and those of the object's enrolled views, (m,)."""
    if found.sigma_deg is None:
        return StatedPose(0)
    error_deg = min((float(wrap180(one - true_deg)) for one in found.azimuth_deg), key=abs)
    away_deg = wrap180(enrolled_deg - true_deg)
    near, *others = away_deg[np.argsort(np.abs(away_deg), kind="stable")].tolist()
    between = near and not (others and np.isclose(-near, others[0]))
    toward_deg = error_deg * float(np.sign(near)) if between else None
    return StatedPose(len(found.azimuth_deg), abs(error_deg), found.sigma_deg, toward_deg)


def pose_rates(stated: FloatArray) -> dict[str, float | None]:
    """Return how many answers state poses, and how many are right, by names with units; None without any case.

    The rows of ``stated``, (n, 4), are `StatedPose`.

    ``pose_far`` is the share of the answers with one pose that are more than 30° off.
    """
    number, error_deg, sigma_deg, toward_deg = stated.T
    known = number > 0
    return {
        "pose_one": _mean(number == 1),
        "pose_several": _mean(number > 1),
        "pose_error_median_deg": _median(error_deg[known]),
        "pose_toward_view_median_deg": _median(toward_deg[~np.isnan(toward_deg)]),
        "pose_within_1_sigma": _mean(error_deg[known] <= sigma_deg[known]),
        "pose_within_2_sigma": _mean(error_deg[known] <= 2 * sigma_deg[known]),
        "pose_far": _mean(error_deg[number == 1] > _FAR_DEG),
    }


def _mean(values: np.typing.NDArray[np.bool_]) -> float | None:
    return float(values.mean()) if values.size else None


def _median(values: FloatArray) -> float | None:
    return float(np.median(values)) if values.size else None
