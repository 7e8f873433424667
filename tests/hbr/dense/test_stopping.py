"""The stopping rule keeps the stated error rates, and states what too little data does not allow."""

from math import inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr import Belief, DenseIndex, DenseSession, Outcome, StopReason, Views, leave_one_out, tanimoto, update_belief
from hbr.dense.fitting import (
    UNFITTED_MIN_CONFIDENCE,
    conformal_threshold,
    fit_stopping_rule,
    min_confidence_for,
    rule_from_searches,
)
from hbr.dense.stopping import Leaders, LimitationCode, StoppingRule, usual_scores
from tests.fuzzing import examples

BETA = 60.0


def catalog(objects: int = 8, noise: float = 0.15, seed: int = 0) -> Views:
    rng = np.random.default_rng(seed)
    azimuth = np.arange(0, 360, 20, dtype=float)
    parts = []
    for j in range(objects):
        used = rng.random(144) < 0.2
        swing = rng.uniform(0, 2, 144)
        rotation = np.radians(azimuth)[:, None] + rng.uniform(0, 7, 144)
        levels = (rng.uniform(1, 6, 144) + swing * np.sin(rotation)) * used
        levels = levels + (rng.random(levels.shape) < noise) * rng.integers(-1, 2, levels.shape)
        parts.append(Views.of_object(f"object {j}", np.rint(np.clip(levels, 0, 7)).astype(np.uint8), azimuth))
    return Views.concatenate(parts)


@examples(6)
@given(st.integers(0, 10**6), st.sampled_from([0.01, 0.02, 0.05, 0.2]), st.integers(120, 400))
def test_conformal_threshold_rejects_the_stated_share_on_average(seed: int, share: float, count: int) -> None:
    rng = np.random.default_rng(seed)
    rejected = []
    for _ in range(300):
        scores = rng.beta(9, 2, count + 1) ** 2
        rejected.append(scores[0] < conformal_threshold(scores[1:], share))
    assert np.mean(rejected) <= share + 4 * np.sqrt(share * (1 - share) / 300)
    exact = np.floor(share * (count + 1) + 1e-9) / (count + 1)
    assert abs(np.mean(rejected) - exact) <= 4 * np.sqrt(share * (1 - share) / 300) + 1 / count


def test_conformal_threshold_rejects_nothing_with_too_few_scores() -> None:
    assert conformal_threshold(np.linspace(0, 1, 48), 0.02) == -inf
    assert conformal_threshold(np.linspace(0, 1, 49), 0.02) == 0.0
    with pytest.raises(ValueError, match="between 0 and 1"):
        conformal_threshold([1.0], 0.0)
    with pytest.raises(ValueError, match="not finite"):
        conformal_threshold([np.nan], 0.1)


def test_min_confidence_is_the_smallest_that_keeps_the_error_rate() -> None:
    rng = np.random.default_rng(0)
    confidence = rng.uniform(0.3, 1, (2000, 1))
    correct = rng.random((2000, 1)) < confidence  # the confidences are the true probabilities
    least = min_confidence_for(confidence, correct, 0.05)
    assert (~correct[confidence >= least]).mean() <= 0.05
    assert 0.85 < least < 0.95  # the mean above it is 0.95
    assert min_confidence_for(confidence[:15], np.ones((15, 1), bool), 0.05) == inf
    assert min_confidence_for(confidence[:40], np.ones((40, 1), bool), 0.05) < 1


def test_leave_one_out_searches_for_each_object_between_its_own_views() -> None:
    views = catalog()
    index = DenseIndex(views)
    found = leave_one_out(index, beta=BETA, views=3, searches=2)
    assert found.known.score.shape == found.unknown.score.shape == found.correct.shape == (16, 3)
    np.testing.assert_array_equal(found.known.object_index, np.repeat(np.arange(8), 2)[:, None] * [1, 1, 1])
    assert (found.unknown.object_index != found.known.object_index).all()
    assert (found.unknown.score < found.known.score).all()
    assert found.correct.mean() == 1
    # The first view of the first search by hand: 0.618 of a step to the right.
    rows = views.of(0)
    similar = tanimoto(views.descriptors[rows[0]], views.descriptors)[0]
    similar[rows[0]] = 1 - 0.618034 * (1 - similar[rows[17]])
    scores = Belief(index, index.support(similar, 0.0), np.zeros(1)).scores()
    ordered, others = np.sort(scores), np.sort(scores[1:])
    assert found.known.score[0, 0] == pytest.approx(ordered[-1])
    assert found.known.margin[0, 0] == pytest.approx(ordered[-1] - ordered[-2])
    assert found.unknown.score[0, 0] == pytest.approx(others[-1])
    assert found.unknown.margin[0, 0] == pytest.approx(others[-1] - others[-2])


def test_open_set_score_is_relative_to_the_usual_score_of_the_leader() -> None:
    known = Leaders(np.array([[0], [0], [1], [1]]), np.array([[0.9], [0.8], [0.7], [0.2]]), np.full((4, 1), 0.1))
    usual = usual_scores(known, np.array([[True], [True], [True], [False]]), 3)
    np.testing.assert_allclose(usual[:, 0], [0.85, 0.7, 0.775])  # the third object was never found
    np.testing.assert_allclose(
        known.open_set_score(usual)[:, 0],
        [0.9 + 0.05 - 0.075, 0.8 + 0.05 - 0.075, 0.7 + 0.05 + 0.075, 0.2 + 0.05 + 0.075],
    )


def test_fitted_rule_finds_enrolled_objects_and_calls_others_unknown() -> None:
    everything = catalog(40, seed=3)
    index = DenseIndex(everything.select(everything.object_index < 30))
    rule = rule_from_searches(leave_one_out(index, beta=BETA), error_rate=0.05, false_reject=0.05)
    assert rule.limitations == ()
    assert rule.false_accept < 0.1
    ends = []
    for j in range(40):
        session = DenseSession(index, rule, max_views=4)
        for i in everything.of(j)[[2, 7, 11, 16]]:
            decision = session.add(everything.descriptors[i], float(everything.azimuth_deg[i]))
            if decision.outcome is not Outcome.CONTINUE:
                break
        ends.append((decision.outcome, decision.object_index == j))
    assert [outcome for outcome, _ in ends[:30]].count(Outcome.FOUND) >= 28
    assert all(right for outcome, right in ends[:30] if outcome is Outcome.FOUND)
    assert [outcome for outcome, _ in ends[30:]].count(Outcome.UNKNOWN) >= 9


def test_small_catalog_guarantees_no_rate_and_reports_the_data_it_needs() -> None:
    index = DenseIndex(catalog(2))
    rule = rule_from_searches(leave_one_out(index, beta=BETA), error_rate=0.01, false_reject=0.02)
    assert rule.min_confidence == UNFITTED_MIN_CONFIDENCE
    assert np.isfinite(rule.open_set_thresholds).all()
    limits = {one.code: one.values for one in rule.limitations}
    assert limits[LimitationCode.FALSE_REJECT_RATE] == {"rate": 0.02, "searches": 8, "needed": 49, "reached": 1 / 9}
    assert limits[LimitationCode.ERROR_RATE]["needed"] == 100
    assert LimitationCode.UNKNOWN_NOT_MEASURED in limits
    assert np.isnan(rule.false_accept)


@pytest.mark.parametrize(
    ("thresholds", "min_confidence", "views", "max_views", "outcome", "reason"),
    [
        ((0.0, 0.0, 0.0), 0.5, 1, 8, Outcome.FOUND, StopReason.CONFIDENT),
        # Before the last fitted view, the highest threshold counts.
        ((0.0, 9.0, 9.0), 0.5, 1, 8, Outcome.CONTINUE, StopReason.BELOW_OPEN_SET_THRESHOLD),
        ((0.0, 9.0, 9.0), 0.5, 1, 1, Outcome.FOUND, StopReason.CONFIDENT),
        ((0.0, 9.0, 9.0), 0.5, 2, 8, Outcome.CONTINUE, StopReason.BELOW_OPEN_SET_THRESHOLD),
        # From then on, an object below it is unknown, even if views are left.
        ((0.0, 9.0, 9.0), 0.5, 3, 8, Outcome.UNKNOWN, StopReason.BELOW_OPEN_SET_THRESHOLD),
        ((9.0,), 0.5, 1, 8, Outcome.UNKNOWN, StopReason.BELOW_OPEN_SET_THRESHOLD),
        ((0.0, 0.0, 0.0), 0.5, 3, 8, Outcome.FOUND, StopReason.CONFIDENT),
        ((0.0, 0.0, 0.0), 1.1, 3, 8, Outcome.CONTINUE, StopReason.NOT_CONFIDENT),
        ((0.0, 0.0, 0.0), 1.1, 3, 3, Outcome.AMBIGUOUS, StopReason.MAX_VIEWS),
        ((-inf,), 1.1, 1, 1, Outcome.AMBIGUOUS, StopReason.MAX_VIEWS),
    ],
)
def test_decision_follows_the_confidence_and_the_open_set_score(
    thresholds, min_confidence, views, max_views, outcome, reason
) -> None:
    everything = catalog(3)
    usual = np.zeros((3, len(thresholds)))
    rule = StoppingRule(BETA, min_confidence, usual, thresholds, 0.01, 0.02, 0.0, 100)
    session = DenseSession(DenseIndex(everything), rule, max_views=max_views)
    for i in everything.of(1)[[0, 6, 12][:views]]:
        decision = session.add(everything.descriptors[i], float(everything.azimuth_deg[i]))
    assert (decision.outcome, decision.reason, decision.object_index) == (outcome, reason, 1)
    assert session.end().outcome is not Outcome.CONTINUE


def test_one_object_is_compared_with_its_own_views() -> None:
    views = catalog(1)
    index = DenseIndex(views)
    rule = fit_stopping_rule(index).rule
    assert [one.code for one in rule.limitations] == [LimitationCode.ONE_OBJECT]
    scores = [
        update_belief(views.descriptors[i], views.azimuth_deg[i], index.without(np.array([i]))).scores()[0]
        for i in range(len(views))
    ]
    assert rule.open_set_thresholds == (pytest.approx(1.5 * min(scores)),)
    unknown = catalog(1, seed=99).descriptors[0]
    assert DenseSession(index, rule).add(unknown, 0.0).outcome is Outcome.UNKNOWN
    assert DenseSession(index, rule).add(views.descriptors[0], 0.0).outcome is Outcome.FOUND


def test_leave_one_out_searches_for_some_of_many_objects_among_all_of_them() -> None:
    index = DenseIndex(catalog(7))
    found = leave_one_out(index, beta=BETA, views=2, searches=1, most_objects=3)
    assert found.searched.tolist() == [0, 3, 6]
    alone = leave_one_out(index.only(np.array([0, 3, 6])), beta=BETA, views=2, searches=1)
    assert (found.known.score == alone.known.score).all()  # found in both
    assert (found.unknown.margin < alone.unknown.margin).any()  # among more others


def test_leave_one_out_takes_a_view_twice_only_in_motion() -> None:
    index = DenseIndex(catalog())  # a view each 20 degrees
    for weight, is_same in ((None, True), (0.5, False)):
        near, far = (leave_one_out(index, beta=BETA, views=2, step_deg=step, weight=weight) for step in (1.0, 20.0))
        assert (near.known.score[:, 0] == far.known.score[:, 0]).all()
        assert (near.known.score[:, 1] == far.known.score[:, 1]).all() == is_same


def test_rule_is_fitted_to_at_least_one_search_for_each_object() -> None:
    index = DenseIndex(catalog(8))
    for most, searches in ((4, 8), (8, 8), (20, 16)):
        found = fit_stopping_rule(index, most_searches=most)
        assert (found.rule.searches, found.searched) == (searches, 8)


def test_leave_one_out_rejects_catalogs_without_enough_views() -> None:
    with pytest.raises(ValueError, match="at least two"):
        leave_one_out(DenseIndex(catalog(1)), beta=BETA)
    with pytest.raises(ValueError, match="no object has 19 views"):
        leave_one_out(DenseIndex(catalog(2)), beta=BETA, views=19)
