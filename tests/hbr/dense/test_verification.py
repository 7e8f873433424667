"""A doubtful leader is found if its enrolled views explain the pixels of the views in any light."""

from dataclasses import replace
from math import inf

import cv2
import numpy as np
import pytest

from hbr import Belief, DenseIndex, DenseSession, Outcome, StopDecision, StopReason, Views, update_belief
from hbr.core.angles import wrap180
from hbr.dense.fitting import fit_stopping_rule
from hbr.dense.local_difference import LocalView, Pixels, fit
from hbr.dense.session import (
    FOUND_FROM,
    FOUND_FROM_SAME_BENCH,
    UNKNOWN_BELOW,
    Verification,
    answered,
    is_doubtful,
    verify,
)
from hbr.dense.stopping import StoppingRule, fitted_before
from tests.hbr.dense.test_stopping import catalog

KIND = "edges+colours"
SIDE = 160


def painted(
    seed: int, *, moved: tuple[float, float] = (0, 0), light: tuple[float, float, float] = (1, 1, 1)
) -> LocalView:
    """Return a box with coloured spots, the same for the same seed, on its own background."""
    rng = np.random.default_rng(seed)
    crop = np.full((SIDE, SIDE, 3), rng.integers(60, 120, 3), np.uint8)
    mask = np.zeros((SIDE, SIDE), np.uint8)
    cv2.rectangle(mask, (20, 10), (140, 150), 255, -1)
    crop[mask > 0] = 140
    for _ in range(25):
        x, y = (int(v) for v in rng.integers((30, 20), (130, 140)))
        cv2.circle(crop, (x, y), int(rng.integers(4, 12)), rng.integers(20, 230, 3).tolist(), -1)
    move = np.array([[1.04, 0, moved[0]], [0, 0.97, moved[1]]]) if any(moved) else np.eye(2, 3)
    crop = cv2.warpAffine(crop, move, (SIDE, SIDE), borderMode=cv2.BORDER_REPLICATE)
    mask = cv2.warpAffine(mask, move, (SIDE, SIDE))
    lit = np.clip(crop * np.array(light), 0, 255).astype(np.uint8)
    return LocalView(lit, mask, 0.0)


def test_fit_is_high_for_the_same_object_in_other_light_and_low_for_another_object() -> None:
    enrolled = Pixels.of(painted(1))
    same = fit(Pixels.of(painted(1, moved=(-6, 5), light=(0.7, 0.8, 1.05))), enrolled)
    other = fit(Pixels.of(painted(2)), enrolled)
    assert fit(enrolled, enrolled) > 0.95
    assert same > 0.75
    assert other < 0.5


def test_fit_stays_high_where_a_shade_lies_across_the_object() -> None:
    view = painted(1)
    shade = np.linspace(1, 0.5, SIDE)[:, None]
    assert fit(Pixels.of(replace(view, crop=(view.crop * shade).astype(np.uint8))), Pixels.of(view)) > 0.75


@pytest.mark.parametrize("across", [False, True])
def test_no_scale_is_changed_where_only_the_colours_would_show_it(across: bool) -> None:
    half = np.where(np.arange(SIDE) < SIDE // 2, 0, 30)
    tint = np.random.default_rng(1).integers(-40, 41, 16).repeat(SIDE // 16) * np.ones((SIDE, 1), np.intp)
    tint = tint if across else tint.T
    bright = 100 + half + half[:, None]  # at any scale the same four quarters
    crop = np.dstack([bright + tint, bright, bright - tint]).astype(np.uint8)
    view = Pixels.of(LocalView(crop, np.full((SIDE, SIDE), 255, np.uint8), 0.0))
    assert fit(view, view) > 0.95


def test_nothing_is_explained_without_common_pixels() -> None:
    view = painted(1)
    nothing = LocalView(view.crop, np.zeros_like(view.mask), 0.0)
    assert fit(Pixels.of(view), Pixels.of(nothing)) == 0


def decision(score: float, *, confidence: float = 0.99, outcome: Outcome = Outcome.UNKNOWN) -> StopDecision:
    return StopDecision(outcome, StopReason.CONFIDENT, 0, confidence, 0.95, score, 0.0)


@pytest.mark.parametrize(
    ("fitted", "confidence", "outcome"),
    [
        (0.8, 0.99, Outcome.FOUND),
        (0.8, 0.5, Outcome.AMBIGUOUS),
        (0.4, 0.99, Outcome.AMBIGUOUS),
        (0.2, 0.99, Outcome.UNKNOWN),
    ],
)
def test_outcome_follows_from_fit_and_open_set_score(fitted: float, confidence: float, outcome: Outcome) -> None:
    found = Verification(0, fitted, 0.1)
    decided = found.decided(decision(0.0, confidence=confidence))
    assert (decided.outcome, decided.reason) == (outcome, StopReason.PIXEL_FIT)
    assert found.score(1.0) > found.score(0.0)
    assert Verification(0, fitted, 0.2).score(0.0) < found.score(0.0)
    assert FOUND_FROM > UNKNOWN_BELOW


@pytest.mark.parametrize("fitted", [0.5, 0.8])
def test_object_on_a_bench_that_may_be_unchanged_needs_a_better_fit(
    index: DenseIndex, rule: StoppingRule, fitted: float
) -> None:
    for same_bench, least in ((True, FOUND_FROM_SAME_BENCH), (None, FOUND_FROM_SAME_BENCH), (False, FOUND_FROM)):
        session = DenseSession(index, rule)
        session.add(index.views.descriptors[0], 0.0, same_bench=same_bench)
        assert session.found_from == least
    assert FOUND_FROM_SAME_BENCH > FOUND_FROM
    found = Verification(0, fitted, fitted - 0.2)
    assert found.decided(decision(0.0)).outcome is Outcome.FOUND
    strict = found.decided(decision(0.0), FOUND_FROM_SAME_BENCH).outcome
    assert strict is (Outcome.FOUND if fitted == 0.8 else Outcome.AMBIGUOUS)


@pytest.fixture(scope="module")
def index() -> DenseIndex:
    return DenseIndex(catalog())


@pytest.fixture(scope="module")
def rule(index: DenseIndex) -> StoppingRule:
    plain = fit_stopping_rule(index).rule
    return replace(plain, open_set=fitted_before(KIND, 4), open_set_thresholds=(3.0, 3.0, 3.0, -1.0))


@pytest.mark.parametrize(
    ("score", "views", "outcome", "doubtful"),
    [
        (0.0, 4, Outcome.UNKNOWN, True),
        (0.0, 4, Outcome.FOUND, True),
        (0.0, 3, Outcome.UNKNOWN, False),
        (0.0, 4, Outcome.CONTINUE, False),
        (3.0, 4, Outcome.FOUND, False),
        (-7.5, 4, Outcome.UNKNOWN, False),
        (-inf, 4, Outcome.UNKNOWN, False),
    ],
)
def test_search_that_ends_between_two_scores_is_doubtful(
    rule: StoppingRule, score: float, views: int, outcome: Outcome, doubtful: bool
) -> None:
    assert is_doubtful(rule, decision(score, outcome=outcome), views, KIND) is doubtful
    assert not is_doubtful(replace(rule, open_set=None), decision(score, outcome=outcome), views, KIND)
    sure = replace(decision(score, outcome=Outcome.FOUND), reason=StopReason.UNCHANGED_BENCH)
    assert not is_doubtful(rule, sure, views, KIND)
    other = replace(rule.open_set, weights=rule.open_set.weights + 1)  # type: ignore[type-var, union-attr]
    assert not is_doubtful(replace(rule, open_set=other), decision(score, outcome=outcome), views, KIND)


def test_the_leader_is_compared_at_its_pose_with_the_better_segmentation(index: DenseIndex) -> None:
    views: Views = index.views
    rows = views.of(2)[[0, 6]]
    other = views.descriptors[views.of(5)[0]]
    so_far: DenseIndex | Belief = index
    for row in rows.tolist():  # the second segmentation of each view is the right one
        so_far = update_belief(np.stack([other, views.descriptors[row]]), float(views.azimuth_deg[row]), so_far)
    assert isinstance(so_far, Belief)
    asked: dict[int, list[float]] = {}

    def enrolled(leader: int, azimuths_deg: list[float]) -> list[LocalView]:
        asked[leader] = list(azimuths_deg)
        return [replace(painted(leader), azimuth_deg=azimuth_deg) for azimuth_deg in azimuths_deg]

    found = answered(verify(so_far, 2, lambda _: [painted(9), painted(2)]), enrolled)
    assert found is not None
    assert len(asked) == 4
    assert np.allclose(wrap180(asked[2] - views.azimuth_deg[rows]), 0, atol=15)
    assert found.object_index == 2
    assert found.fit > 0.4 > found.others
