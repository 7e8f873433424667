"""Stated error rates, kept; and nothing promised of too little data."""

from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hbr import Belief, DenseIndex, Views, tanimoto, update_belief
from hbr.dense.stopping import (
    Leaders,
    Rules,
    certainty_for,
    conformal_threshold,
    judge,
    rehearse,
    rules,
    usual_scores,
)

BETA = 60.0


def catalog(objects: int = 8, noise: float = 0.15, seed: int = 0) -> Views:
    rng = np.random.default_rng(seed)
    azimuth = np.arange(0, 360, 20, dtype=float)
    parts = []
    for j in range(objects):
        used = rng.random(144) < 0.2
        swing = rng.uniform(0, 2, 144)
        turn = np.radians(azimuth)[:, None] + rng.uniform(0, 7, 144)
        levels = (rng.uniform(1, 6, 144) + swing * np.sin(turn)) * used
        levels = levels + (rng.random(levels.shape) < noise) * rng.integers(-1, 2, levels.shape)
        parts.append(Views.of_object(f"object {j}", np.rint(np.clip(levels, 0, 7)).astype(np.uint8), azimuth))
    return Views.concatenate(parts)


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.sampled_from([0.01, 0.02, 0.05, 0.2]), st.integers(120, 400))
def test_a_conformal_threshold_rejects_the_stated_share_on_average(seed: int, share: float, count: int) -> None:
    rng = np.random.default_rng(seed)
    rejected = []
    for _ in range(300):
        scores = rng.beta(9, 2, count + 1) ** 2
        rejected.append(scores[0] < conformal_threshold(scores[1:], share))
    assert np.mean(rejected) <= share + 4 * np.sqrt(share * (1 - share) / 300)
    exact = np.floor(share * (count + 1) + 1e-9) / (count + 1)
    assert abs(np.mean(rejected) - exact) <= 4 * np.sqrt(share * (1 - share) / 300) + 1 / count


def test_too_few_scores_reject_nothing() -> None:
    assert conformal_threshold(np.linspace(0, 1, 48), 0.02) == -inf
    assert conformal_threshold(np.linspace(0, 1, 49), 0.02) == 0.0
    with pytest.raises(ValueError, match="between 0 and 1"):
        conformal_threshold([1.0], 0.0)
    with pytest.raises(ValueError, match="not finite"):
        conformal_threshold([np.nan], 0.1)


def test_certainty_is_the_least_that_keeps_the_error_rate() -> None:
    rng = np.random.default_rng(0)
    posterior = rng.uniform(0.3, 1, (2000, 1))
    correct = rng.random((2000, 1)) < posterior  # as probable as it says
    certainty = certainty_for(posterior, correct, 0.05)
    stops = posterior >= certainty
    assert (~correct[stops]).mean() <= 0.05
    assert 0.85 < certainty < 0.95  # the mean above it is 0.95
    assert certainty_for(posterior[:15], np.ones((15, 1), bool), 0.05) == inf
    assert certainty_for(posterior[:40], np.ones((40, 1), bool), 0.05) < 1


def test_a_rehearsal_looks_for_each_object_by_its_own_views_as_if_taken_aside() -> None:
    views = catalog()
    index = DenseIndex(views)
    rehearsal = rehearse(index, beta=BETA, views=3, searches=2)
    assert rehearsal.known.score.shape == rehearsal.stranger.score.shape == rehearsal.correct.shape == (16, 3)
    np.testing.assert_array_equal(rehearsal.known.object_index, np.repeat(np.arange(8), 2)[:, None] * [1, 1, 1])
    assert (rehearsal.stranger.object_index != rehearsal.known.object_index).all()
    assert (rehearsal.stranger.score < rehearsal.known.score).all()
    assert rehearsal.correct.mean() == 1
    # the first view of the first search once more: 0.618 of a step aside, to the right
    rows = views.of(0)
    similar = tanimoto(views.descriptors[rows[0]], views.descriptors)[0]
    similar[rows[0]] = 1 - 0.618034 * (1 - similar[rows[17]])
    belief = Belief(index, index.support(similar, 0.0), np.zeros(1))
    scores = belief.scores()
    ordered = np.sort(scores)
    assert rehearsal.known.score[0, 0] == pytest.approx(ordered[-1])
    assert rehearsal.known.lead[0, 0] == pytest.approx(ordered[-1] - ordered[-2])
    others = np.sort(scores[1:])
    assert rehearsal.stranger.score[0, 0] == pytest.approx(others[-1])
    assert rehearsal.stranger.lead[0, 0] == pytest.approx(others[-1] - others[-2])
    # views of a second sitting that are less like the enrolled ones are met less well
    other = np.maximum(views.descriptors, 1) - (views.descriptors > 0)
    again = rehearse(index, beta=BETA, views=3, searches=2, seen=other.astype(np.uint8))
    assert again.known.score.mean() < rehearsal.known.score.mean()


def test_familiarity_is_relative_to_what_the_leader_usually_scores() -> None:
    known = Leaders(np.array([[0], [0], [1], [1]]), np.array([[0.9], [0.8], [0.7], [0.2]]), np.full((4, 1), 0.1))
    usual = usual_scores(known, np.array([[True], [True], [True], [False]]), 3)
    np.testing.assert_allclose(usual[:, 0], [0.85, 0.7, 0.775])  # of the third nothing is known
    np.testing.assert_allclose(
        known.familiarity(usual)[:, 0],
        [0.9 + 0.05 - 0.075, 0.8 + 0.05 - 0.075, 0.7 + 0.05 + 0.075, 0.2 + 0.05 + 0.075],
    )


def test_rules_of_a_catalog_find_its_objects_and_not_others() -> None:
    everything = catalog(40, seed=3)
    enrolled = everything.object_index < 30
    index = DenseIndex(everything.select(enrolled))
    made = rules(rehearse(index, beta=BETA), error_rate=0.05, false_reject=0.05)
    assert made.promises == ()
    assert made.false_accept < 0.1
    kinds = []
    for j in range(40):
        rows = everything.of(j)
        so_far: DenseIndex | Belief = index
        for i in rows[[2, 7, 11, 16]]:
            so_far = belief = update_belief(everything.descriptors[i], float(everything.azimuth_deg[i]), so_far)
            verdict = judge(belief, made, max_views=4)
            if verdict.kind != "look":
                break
        kinds.append((verdict.kind, verdict.object_index == j))
        assert verdict.words.startswith(f"object {verdict.object_index} with a probability of")
    assert [kind for kind, _ in kinds[:30]].count("found") >= 28
    assert all(right for kind, right in kinds[:30] if kind == "found")
    assert [kind for kind, _ in kinds[30:]].count("unknown") >= 9


def test_a_small_catalog_promises_nothing_and_says_how_much_it_takes() -> None:
    made = rules(rehearse(DenseIndex(catalog(2)), beta=BETA), error_rate=0.01, false_reject=0.02)
    assert made.familiar == (-inf,) * 4
    assert made.certainty == inf
    assert "49 are needed" in made.promises[0]
    assert "no search ends early" in made.promises[1]
    belief = update_belief(catalog(2).descriptors[0], 0.0, DenseIndex(catalog(2)))
    assert judge(belief, made, max_views=4).kind == "look"
    assert judge(belief, made, max_views=1).kind == "found"


def test_a_score_that_no_enrolled_object_has_ends_as_unknown_and_never_early() -> None:
    by = Rules(BETA, 0.9, np.full((4, 2), 0.9), (1.4, 1.4), 0.01, 0.02, 0.0, 100)
    index = DenseIndex(catalog(4))
    stranger = catalog(1, seed=99).descriptors[0]
    belief = update_belief(stranger, 0.0, index)
    assert judge(belief, by, max_views=2).kind == "look"
    verdict = judge(update_belief(stranger, 90.0, belief), by, max_views=2)
    assert verdict.kind == "unknown"
    assert "none of those enrolled" in verdict.words


def test_what_cannot_be_rehearsed_is_refused() -> None:
    with pytest.raises(ValueError, match="at least two"):
        rehearse(DenseIndex(catalog(1)), beta=BETA)
    with pytest.raises(ValueError, match="no object has 19 views"):
        rehearse(DenseIndex(catalog(2)), beta=BETA, views=19)
    with pytest.raises(ValueError, match="seen has shape"):
        rehearse(DenseIndex(catalog(2)), beta=BETA, seen=np.zeros((3, 144), np.uint8))
