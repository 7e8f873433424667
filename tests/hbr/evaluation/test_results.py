import numpy as np
import pytest

from hbr.evaluation.protocol import METHODS, Runs
from hbr.evaluation.results import contests, method_results, pose_rmse_by_object, step_median_ms

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
    first, second = result.curve
    assert (first.views, first.trials, first.hits, first.best10_hits) == (1, 4, 1, 2)
    assert (second.hits, second.hit_rate, second.best10_rate, second.travelled_mean_deg) == (2, 0.5, 0.75, 45)
    assert first.hit_rate_low < 0.25 < first.hit_rate_high


def test_only_hits_have_pose_errors() -> None:
    runs = runs_of([[[1], [1], [3]]], pose_error_deg=[[[30], [40], [170]]], alike_error_deg=[[[0], [10], [170]]])
    ((point,),) = (result.curve for result in method_results(runs, PAIR[:1], 0.0, min_views=1))
    assert (point.pose_error_median_deg, point.alike_error_median_deg) == (35, 5)
    assert point.pose_error_rmse_deg == pytest.approx((30**2 / 2 + 40**2 / 2) ** 0.5)
    np.testing.assert_array_equal(pose_rmse_by_object(runs, 0, similar=False), [30, 40, np.nan])
    np.testing.assert_array_equal(pose_rmse_by_object(runs, 0, similar=True), [0, 10, np.nan])


def test_no_hit_has_no_pose_error() -> None:
    ((point,),) = (result.curve for result in method_results(runs_of([[[2], [0]]]), PAIR[:1], 0.0))
    assert point.pose_error_median_deg is point.alike_error_rmse_deg is None


def test_search_ends_by_its_margin_after_min_views_or_at_the_last_view() -> None:
    runs = runs_of(
        [[[2, 2, 1], [1, 2, 2], [1, 1, 2], [2, 2, 1]]],
        margin=[[[0.1, 0.2, 0.3], [0.9, 0.5, 0.5], [0.0, 0.49, 0.2], [0, 0.5, 0]]],
        travelled_deg=[[[0, 10, 20]] * 4],
    )
    (result,) = method_results(runs, PAIR[:1], 0.5, min_views=2)
    stopping = result.stopping
    assert (stopping.views_mean, stopping.views_p95) == (2.5, 3)  # after 3, 2, 3 and 2 views
    assert stopping.hit_rate == 0.25
    assert stopping.ended_early == 0.5
    assert stopping.travelled_mean_deg == 15
    (early,) = method_results(runs, PAIR[:1], 0.5, min_views=1)
    assert early.stopping.views_mean == 2.25
    assert early.stopping.hit_rate == 0.5


def test_method_of_one_view_has_one_point() -> None:
    runs = runs_of([[[1, -1], [2, -1]]], margin=[[[0.0, np.nan]] * 2], travelled_deg=[[[0.0, np.nan]] * 2])
    (result,) = method_results(runs, PAIR[:1], 0.1)
    assert len(result.curve) == 1
    assert (result.stopping.views_mean, result.stopping.hit_rate) == (1, 0.5)
    runs.step_ns[..., 0] = 2_500_000
    assert step_median_ms(runs, 0) == [2.5]


def test_contests_are_on_the_same_trials() -> None:
    ahbr, hbr = [[2, 2, 2, 1]] * 30 + [[2] * 4] * 10, [[2, 2, 2, 1]] * 20 + [[2] * 4] * 20
    found = {(c.first_views, c.second_views): c for c in contests(runs_of([ahbr, hbr]), PAIR, np.random.default_rng(0))}
    contest = found[4, 4]
    assert (contest.only_first, contest.only_second, contest.trials) == (10, 0, 40)
    assert (contest.first_rate, contest.second_rate, contest.difference) == (0.75, 0.5, 0.25)
    assert contest.p_value == 2 / 2**10
    assert 0 < contest.difference_low < 0.25 < contest.difference_high


def test_questions_without_runs_are_left_out() -> None:
    assert contests(runs_of([[[1]], [[1]]]), PAIR, np.random.default_rng(0))[0].first_views == 1
    assert not contests(runs_of([[[1, 1]]]), PAIR[:1], np.random.default_rng(0))
