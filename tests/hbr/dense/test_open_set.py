"""The open-set thresholds keep the rate of accepted unknown objects, and depend on what is known of the bench."""

from dataclasses import replace

import numpy as np
import pytest

from hbr import DenseIndex, Outcome, Views
from hbr.dense.fitting import FALSE_ACCEPT, fit_open_set, fit_stopping_rule, rule_from_searches, with_false_accepts
from hbr.dense.leave_one_out import STRENGTHS, LeaveOneOut, ShiftedSearches, leave_one_out
from hbr.dense.stopping import NUMBERS, Leaders, LimitationCode, OpenSetModel, StoppingRule, StopReason
from tests.hbr.dense.searches import belief_after
from tests.hbr.dense.test_stopping import catalog

VIEWS = 4


@pytest.fixture(scope="module")
def index() -> DenseIndex:
    return DenseIndex(catalog())


@pytest.fixture(scope="module")
def plain(index: DenseIndex) -> StoppingRule:
    return fit_stopping_rule(index).rule


def drawn(searches: int = 500, seed: int = 0) -> ShiftedSearches:
    """Return searches whose known objects score less under a stronger change; unknown ones score most without a
    change."""
    rng = np.random.default_rng(seed)
    strength = np.array(STRENGTHS)[np.arange(searches) % len(STRENGTHS)]
    shape = searches, VIEWS, len(NUMBERS)
    known = rng.normal(0, 1, shape) + (5 - 2 * strength)[:, None, None]
    unknown = rng.normal(0, 1, shape) + np.where(strength == 0, 1.0, 0.0)[:, None, None]
    return ShiftedSearches(strength, known, unknown, np.ones((searches, VIEWS), np.bool_))


def test_thresholds_keep_the_rate_of_accepted_unknown_objects(plain: StoppingRule) -> None:
    searches = drawn()
    rule = fit_open_set(plain, searches)
    assert rule.open_set is not None
    scores = rule.open_set.scores(searches.unknown)
    for thresholds, own in (
        (rule.open_set_thresholds, scores),
        (rule.changed_bench_thresholds, scores[searches.strength > 0]),
        (rule.same_bench_thresholds, scores[searches.strength <= 0.25]),
    ):
        accepted = (own >= thresholds).any(axis=1)
        early = (own[:, :-1] >= thresholds[:-1]).any(axis=1)
        assert accepted.mean() <= FALSE_ACCEPT
        assert early.mean() <= FALSE_ACCEPT / 4
        assert accepted.any()  # no higher than needed


def test_threshold_is_lower_on_a_bench_that_is_known_to_have_changed(plain: StoppingRule) -> None:
    rule = fit_open_set(plain, drawn())
    assert (np.array(rule.changed_bench_thresholds) <= rule.open_set_thresholds).all()
    assert rule.changed_bench_thresholds[-1] < rule.open_set_thresholds[-1] < rule.open_set_thresholds[0]
    assert [one.strength for one in rule.rates] == list(STRENGTHS)
    assert sum(one.false_accepts for one in rule.rates) <= 2 * FALSE_ACCEPT * sum(one.searches for one in rule.rates)


def by_bench(plain: StoppingRule) -> StoppingRule:
    """Return a rule with which each object scores 0, and whose thresholds depend on the bench."""
    score = np.zeros((VIEWS, len(NUMBERS)))
    return replace(
        plain,
        min_confidence=0.5,
        open_set=OpenSetModel(score, score + 1, score, np.zeros(VIEWS)),
        open_set_thresholds=(1.0, 1.0, 1.0, -1.0),
        changed_bench_thresholds=(-1.0,) * VIEWS,
        same_bench_thresholds=(1.0,) * VIEWS,
        unknown_thresholds=(-2.0,) * VIEWS,
    )


@pytest.mark.parametrize(
    ("same_bench", "early", "last"),
    [
        (None, Outcome.CONTINUE, Outcome.FOUND),
        (True, Outcome.CONTINUE, Outcome.AMBIGUOUS),
        (False, Outcome.FOUND, Outcome.FOUND),
    ],
)
def test_decision_depends_on_whether_the_bench_is_known_to_be_the_same(
    index: DenseIndex, plain: StoppingRule, same_bench: bool | None, early: Outcome, last: Outcome
) -> None:
    rule, views = by_bench(plain), index.views
    rows = views.of(2)[[0, 4, 9, 13]]
    for count, outcome in ((2, early), (4, last)):
        belief = belief_after(views.descriptors[rows[:count]], views.azimuth_deg[rows[:count]], index)
        assert rule.decide(belief, max_views=4, same_bench=same_bench).outcome is outcome


@pytest.mark.parametrize(
    ("same_bench", "views", "shift", "outcome"),
    [
        (True, 1, 0.0, Outcome.FOUND),
        (True, 1, 0.1, Outcome.CONTINUE),  # the score is too low
        (None, 1, 0.0, Outcome.CONTINUE),  # the thresholds are those of an unchanged bench
        (True, 4, 0.0, Outcome.FOUND),
        (True, 4, 0.1, Outcome.AMBIGUOUS),
    ],
)
def test_on_an_unchanged_bench_an_object_is_found_by_the_leave_one_out_thresholds(
    index: DenseIndex, plain: StoppingRule, same_bench: bool | None, views: int, shift: float, outcome: Outcome
) -> None:
    rows = index.views.of(2)[[0, 4, 9, 13]][:views]
    belief = belief_after(index.views.descriptors[rows], index.views.azimuth_deg[rows], index)
    before = by_bench(plain)
    score = plain.decide(belief, max_views=4).open_set_score  # of the leave-one-out searches
    rule = replace(before, leave_one_out_thresholds=(0.0, score + shift, 0.0, 0.0))
    decision = rule.decide(belief, max_views=4, same_bench=same_bench)
    assert decision.outcome is outcome
    if outcome is Outcome.FOUND:
        assert (decision.open_set_score, decision.open_set_threshold) == (score, score)
        assert decision.reason is StopReason.UNCHANGED_BENCH
        assert before.decide(belief, max_views=4, same_bench=True).outcome is not Outcome.FOUND


def test_rule_states_that_twins_are_accepted_more_often_than_promised(plain: StoppingRule) -> None:
    assert fit_open_set(plain, drawn()).leave_one_out_thresholds == plain.open_set_thresholds
    apart, twins = catalog(4), Views.concatenate([catalog(4), renamed(catalog(4, noise=0.2))])
    for views, codes in ((apart, []), (twins, [LimitationCode.FALSE_ACCEPT_RATE])):
        searches = leave_one_out(DenseIndex(views))
        rule = replace(rule_from_searches(searches), limitations=())
        found = with_false_accepts(rule, searches)
        assert [one.code for one in found.limitations] == codes
        for one in found.limitations:
            assert one.values["accepted"] > one.values["rate"] * one.values["searches"]


@pytest.mark.parametrize("accepted", [0, 1, 2])
def test_rule_states_no_limitation_at_exactly_the_promised_share(plain: StoppingRule, accepted: int) -> None:
    score = np.zeros((50, VIEWS))  # of which the promised share is one search
    score[:accepted, 0] = 1.0
    leaders = Leaders(np.zeros((50, VIEWS), np.intp), score, score)
    none = np.zeros((50, VIEWS), np.bool_)
    searches = LeaveOneOut(1, np.zeros(50, np.intp), leaders, leaders, score, none, plain.beta)
    rule = replace(plain, usual_scores=np.zeros((1, VIEWS)), open_set_thresholds=(0.5,) * VIEWS, limitations=())
    assert bool(with_false_accepts(rule, searches).limitations) == (accepted > 1)


def renamed(views: Views) -> Views:
    """Return the same objects with other names."""
    names = tuple(f"twin of {name}" for name in views.object_names)
    return Views(views.descriptors, views.azimuth_deg, views.object_index, names, views.descriptor)
