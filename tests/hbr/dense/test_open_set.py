"""The open-set thresholds keep the rate of accepted unknown objects, and depend on what is known of the bench."""

from dataclasses import replace

import numpy as np
import pytest

from hbr import DenseIndex, Outcome, Views
from hbr.dense.calibration import FALSE_ACCEPT, calibrate_stopping_rule, fit_open_set
from hbr.dense.open_set import NUMBERS, OpenSetModel
from hbr.dense.shifted_searches import STRENGTHS, ShiftedSearches
from hbr.dense.stopping import StoppingRule
from tests.hbr.dense.searches import belief_after
from tests.hbr.dense.test_stopping import catalog

VIEWS = 4


@pytest.fixture(scope="module")
def index() -> DenseIndex:
    return DenseIndex(catalog())


@pytest.fixture(scope="module")
def plain(index: DenseIndex) -> StoppingRule:
    return calibrate_stopping_rule(index).rule


def drawn(searches: int = 500, seed: int = 0) -> ShiftedSearches:
    """Searches whose known objects score less under a stronger change; unknown ones score most without any."""
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


@pytest.mark.parametrize(
    ("same_bench", "early", "last"),
    [
        (None, Outcome.CONTINUE, Outcome.FOUND),
        (True, Outcome.CONTINUE, Outcome.AMBIGUOUS),
        (False, Outcome.FOUND, Outcome.FOUND),
    ],
)
def test_decision_depends_on_what_is_known_of_the_bench(
    index: DenseIndex, plain: StoppingRule, same_bench: bool | None, early: Outcome, last: Outcome
) -> None:
    views: Views = index.views
    rows = views.of(2)[[0, 4, 9, 13]]
    score = np.zeros((VIEWS, len(NUMBERS)))
    model = OpenSetModel(score, score + 1, score, np.zeros(VIEWS))  # each object scores 0
    rule = replace(
        plain,
        min_confidence=0.5,
        open_set=model,
        open_set_thresholds=(1.0, 1.0, 1.0, -1.0),
        changed_bench_thresholds=(-1.0,) * VIEWS,
        same_bench_thresholds=(1.0,) * VIEWS,
        unknown_thresholds=(-2.0,) * VIEWS,
    )
    for count, outcome in ((2, early), (4, last)):
        belief = belief_after(views.descriptors[rows[:count]], views.azimuth_deg[rows[:count]], index)
        assert rule.decide(belief, max_views=4, same_bench=same_bench).outcome is outcome
