"""What answers say about the pose."""

import numpy as np
import pytest

from hbr.dense.pose import Pose
from hbr.evaluation.poses import StatedPose, pose_rates, stated_pose

ENROLLED_DEG = np.arange(0.0, 360.0, 20.0)


@pytest.mark.parametrize(
    ("stated", "true_deg", "expected"),
    [
        (Pose((357.0,), 2.0, 360.0), 4.0, StatedPose(1, 7.0, 2.0, 7.0)),
        (Pose((16.0,), 2.0, 360.0), 15.0, StatedPose(1, 1.0, 2.0, 1.0)),
        (Pose((14.0,), 2.0, 360.0), 15.0, StatedPose(1, 1.0, 2.0, -1.0)),
        (Pose((14.0, 194.0), 2.0, 180.0), 195.0, StatedPose(2, 1.0, 2.0, -1.0)),
        (Pose((14.0,), 2.0, 360.0), 10.0, StatedPose(1, 4.0, 2.0, None)),
        (Pose((14.0,), 2.0, 360.0), 20.0, StatedPose(1, 6.0, 2.0, None)),
        (Pose((), None, 0.0), 20.0, StatedPose(0)),
    ],
)
def test_errors_are_those_of_the_nearest_stated_pose(stated: Pose, true_deg: float, expected: StatedPose) -> None:
    assert stated_pose(stated, true_deg, ENROLLED_DEG) == expected


def test_rates_are_those_of_the_answers_that_state_poses() -> None:
    stated = [StatedPose(1, 1.0, 2.0, 1.0), StatedPose(1, 40.0, 2.0), StatedPose(2, 3.0, 2.0, -2.0), StatedPose(0)]
    found = pose_rates(np.array(stated, np.float64))
    assert (found["pose_one"], found["pose_several"], found["pose_far"]) == (0.5, 0.25, 0.5)
    assert (found["pose_error_median_deg"], found["pose_toward_view_median_deg"]) == (3.0, -0.5)
    assert found["pose_within_1_sigma"] == pytest.approx(1 / 3)
    assert found["pose_within_2_sigma"] == pytest.approx(2 / 3)
    assert set(pose_rates(np.empty((0, 4))).values()) == {None}
