"""Hit rates, decisions, poses and comparisons of methods, and their statistics."""

import numpy as np
import pytest

from hbr.dense.pose import Pose
from hbr.evaluation.poses import StatedPose, pose_rates, stated_pose
from hbr.evaluation.protocol import METHODS, Runs
from hbr.evaluation.results import contests, method_results, step_median_ms
from hbr.evaluation.statistics import bootstrap_difference, mcnemar_exact, wilson

PAIR = (METHODS["ahbr"], METHODS["hbr"])


def runs_of(rank: list, **arrays: list) -> Runs:
    """Return runs with one trial for each object: methods x objects x views."""
    ranks = np.array(rank, np.int32)[:, :, None]
    runs = Runs.blank(*ranks.shape)
    runs.rank[:] = ranks
    runs.named[:] = ranks == 1
    for name, values in arrays.items():
        getattr(runs, name)[:] = np.array(values)[:, :, None]
    return runs


def test_curve_counts_hits_and_the_ten_best() -> None:
    runs = runs_of([[[1, 1], [2, 1], [11, 10], [0, 0]]], travelled_deg=[[[0, 90], [0, 30], [0, 60], [0, 0]]])
    (result,) = method_results(runs, PAIR[:1], 0.0)
    first, second = result["curve"]
    assert [first[key] for key in ("views", "trials", "hits", "best10_hits")] == [1, 4, 1, 2]
    assert [second[key] for key in ("hits", "hit_rate", "best10_rate", "travelled_mean_deg")] == [2, 0.5, 0.75, 45]
    assert (first["hit_rate_low"], first["hit_rate_high"]) == wilson(1, 4)
    assert (first["best10_low"], first["best10_high"]) == wilson(2, 4)


def test_only_hits_have_pose_errors() -> None:
    runs = runs_of([[[1], [1], [3]]], pose_error_deg=[[[30], [40], [170]]], alike_error_deg=[[[0], [10], [170]]])
    (result,) = method_results(runs, PAIR[:1], 0.0, min_views=1)
    (point,) = result["curve"]
    assert (point["pose_error_median_deg"], point["alike_error_median_deg"]) == (35, 5)
    assert point["pose_error_rmse_deg"] == pytest.approx((30**2 / 2 + 40**2 / 2) ** 0.5)
    assert result["pose_rmse_deg_by_object"] == [30, 40, None]
    assert result["alike_rmse_deg_by_object"] == [0, 10, None]
    (none,) = method_results(runs_of([[[2], [0]]]), PAIR[:1], 0.0)
    assert none["curve"][0]["pose_error_median_deg"] is none["curve"][0]["alike_error_rmse_deg"] is None


@pytest.mark.parametrize(("min_views", "views_mean", "hit_rate"), [(2, 2.5, 0.25), (1, 2.25, 0.5)])
def test_search_ends_by_its_margin_after_min_views_or_at_the_last_view(
    min_views: int, views_mean: float, hit_rate: float
) -> None:
    runs = runs_of(
        [[[2, 2, 1], [1, 2, 2], [1, 1, 2], [2, 2, 1]]],
        margin=[[[0.1, 0.2, 0.3], [0.9, 0.5, 0.5], [0.0, 0.49, 0.2], [0, 0.5, 0]]],
        travelled_deg=[[[0, 10, 20]] * 4],
    )
    (result,) = method_results(runs, PAIR[:1], 0.5, min_views)
    stopping = result["stopping"]
    assert (stopping["views_mean"], stopping["hit_rate"]) == (views_mean, hit_rate)
    if min_views == 2:  # ends after 3, 2, 3 and 2 views
        assert (stopping["views_p95"], stopping["ended_early"], stopping["travelled_mean_deg"]) == (3, 0.5, 15)


def test_method_of_one_view_has_one_point() -> None:
    runs = runs_of([[[1, -1], [2, -1]]], margin=[[[0.0, np.nan]] * 2], travelled_deg=[[[0.0, np.nan]] * 2])
    (result,) = method_results(runs, PAIR[:1], 0.1)
    assert len(result["curve"]) == 1
    assert (result["stopping"]["views_mean"], result["stopping"]["hit_rate"]) == (1, 0.5)
    runs.step_ns[..., 0] = 2_500_000
    assert step_median_ms(runs, 0) == [2.5]


def test_contests_are_on_the_same_trials_and_questions_without_runs_are_left_out() -> None:
    ahbr, hbr = [[2, 2, 2, 1]] * 30 + [[2] * 4] * 10, [[2, 2, 2, 1]] * 20 + [[2] * 4] * 20
    answers = contests(runs_of([ahbr, hbr]), PAIR, np.random.default_rng(0))
    contest = next(one for one in answers if (one["first_views"], one["second_views"]) == (4, 4))
    assert [contest[key] for key in ("only_first", "only_second", "trials")] == [10, 0, 40]
    assert [contest[key] for key in ("first_rate", "second_rate", "difference")] == [0.75, 0.5, 0.25]
    assert contest["p_value"] == 2 / 2**10
    assert 0 < contest["difference_low"] < 0.25 < contest["difference_high"]
    assert not contests(runs_of([[[1, 1]]]), PAIR[:1], np.random.default_rng(0))


ENROLLED_DEG = np.arange(0.0, 360.0, 20.0)


@pytest.mark.parametrize(
    ("stated", "true_deg", "expected"),
    [
        (Pose((357.0,), 2.0, 360.0), 4.0, StatedPose(1, 7.0, 2.0, 7.0)),
        (Pose((16.0,), 2.0, 360.0), 15.0, StatedPose(1, 1.0, 2.0, 1.0)),
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


@pytest.mark.parametrize(
    ("hits", "trials", "low", "high", "p_value"),
    [
        (0, 1, 0.0, 0.7934506856227626, 1.0),
        (3, 3, 0.4385029682449546, 1.0, 0.25),
        (1, 4, 0.04558726080970055, 0.6993581574175981, 0.625),
        (37, 100, 0.28182360534324535, 0.4677947041905709, 0.012032975725363479),
        (2999, 3000, 0.9981141811156957, 0.9999411560581284, 0.0),
    ],
)
def test_intervals_and_p_values_equal_those_of_scipy(
    hits: int, trials: int, low: float, high: float, p_value: float
) -> None:
    assert wilson(hits, trials) == pytest.approx((low, high), abs=1e-12)
    assert mcnemar_exact(hits, trials - hits) == mcnemar_exact(trials - hits, hits) == pytest.approx(p_value, rel=1e-9)
    assert mcnemar_exact(0, 0) == 1.0


def test_bootstrap_resamples_objects_not_trials() -> None:
    rng = np.random.default_rng(0)
    of_object = np.repeat(rng.random((60, 1)) < 0.7, 20, axis=1)  # all trials of an object are one
    low, high = bootstrap_difference(of_object, np.zeros_like(of_object), np.random.default_rng(1))
    rate = of_object.mean()
    spread = 1.96 * (rate * (1 - rate) / 60) ** 0.5
    assert (low, high) == pytest.approx((rate - spread, rate + spread), abs=0.03)
    assert bootstrap_difference(of_object, of_object, rng) == (0, 0)


@pytest.mark.parametrize(
    "call",
    [
        lambda: wilson(3, 2),
        lambda: wilson(0, 0),
        lambda: mcnemar_exact(-1, 2),
        lambda: bootstrap_difference(np.ones((2, 3), bool), np.ones((3, 2), bool), np.random.default_rng()),
    ],
)
def test_impossible_counts_are_rejected(call) -> None:
    with pytest.raises(ValueError, match=r"trials|hits"):
        call()
