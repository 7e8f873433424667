"""The posterior of a search, and the decision that follows from it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr import Belief, DenseIndex, Outcome, StopReason, Views
from hbr.dense.stopping import LAST_CONFIDENCE, MIN_CONFIDENCE, UNKNOWN_FROM, among_enrolled, decide, posterior
from tests.fuzzing import examples
from tests.hbr.dense.searches import LIGHT, belief_after, catalog, fitted, view

QUERIES_DEG = (30.0, 150.0, 270.0, 330.0)
GOOD, BAD = fitted(0, 0.9), fitted(0, 0.3)
INDEX = DenseIndex(catalog(12))
STRANGE = catalog(3, seed=9)


def search(share: float, count: int = 2, *, j: int = 2, index: DenseIndex = INDEX) -> Belief:
    """Return the belief after views of an object, of which views of one that is not enrolled replace a share."""
    rng = np.random.default_rng(3)
    queries = [
        np.where(rng.random(len(own)) < share, view(STRANGE, 1, deg), own)
        for deg, own in ((deg, view(index.views, j, deg)) for deg in QUERIES_DEG[:count])
    ]
    return belief_after(queries, QUERIES_DEG[:count], index)


@pytest.mark.parametrize("kind", ["cedd", LIGHT, "edges+colours+cedd+network", "edges=0.5,cedd=0.5"])
@pytest.mark.parametrize("objects", [1, 2, 6])
def test_probabilities_add_up_to_1(kind: str, objects: int) -> None:
    index = DenseIndex(catalog(objects, kind=kind, step_deg=90.0))
    for count in range(1, 7):
        queries = [view(index.views, 0, 90.0 * n) for n in range(count)]
        belief = belief_after(queries, [90.0 * n for n in range(count)], index)
        for fit in (None, GOOD, BAD):
            probability, not_enrolled = posterior(belief, fit)
            assert probability.shape == (objects,)
            assert probability.min() >= 0
            assert 0 < not_enrolled < 1
            assert probability.sum() + not_enrolled == pytest.approx(1)


@examples(10)
@given(st.floats(0, 0.9), st.integers(1, 4))
def test_decision_follows_from_the_posterior(share: float, count: int) -> None:
    belief = search(share, count)
    probability, not_enrolled = posterior(belief)
    for last in (False, True):
        found = decide(belief, last=last)
        assert found.object_index == probability.argmax()
        assert (found.probability, found.not_enrolled) == (probability.max(), not_enrolled)
        least = max(LAST_CONFIDENCE, MIN_CONFIDENCE * (1 - not_enrolled)) if last else MIN_CONFIDENCE
        assert found.min_confidence == least
        assert (found.outcome is Outcome.FOUND) == (found.probability >= found.min_confidence)
        if last:
            assert found.outcome is not Outcome.CONTINUE
            is_unknown = found.outcome is not Outcome.FOUND and not_enrolled >= UNKNOWN_FROM
            assert (found.outcome is Outcome.UNKNOWN) == is_unknown
        unreliable = decide(belief, last=last, reliable=False)
        if last:
            assert unreliable == found
        else:
            assert unreliable.outcome is Outcome.CONTINUE
            badly = found.outcome is not Outcome.CONTINUE
            assert unreliable.reason is (StopReason.BADLY_SEGMENTED if badly else StopReason.NOT_CONFIDENT)


def test_enrolled_objects_are_found_and_others_are_unknown() -> None:
    for j in range(len(INDEX)):
        found = decide(search(0.0, j=j), last=False)
        assert (found.outcome, found.reason, found.object_index) == (Outcome.FOUND, StopReason.CONFIDENT, j)
    for j in range(3):
        other = belief_after([view(STRANGE, j, deg) for deg in QUERIES_DEG], QUERIES_DEG, INDEX)
        found = decide(other, last=True)
        assert (found.outcome, found.reason) == (Outcome.UNKNOWN, StopReason.NOT_ENROLLED)


def test_a_similar_enrolled_object_is_a_reason_for_two_names_and_one_that_is_not_enrolled_is_none() -> None:
    """After the last view, 90 % for one object and 10 % for its twin end as ambiguous."""
    twins = catalog(2, seed=1)
    levels = twins.descriptors.copy()
    levels[twins.of(1)] = levels[twins.of(0)]
    index = DenseIndex(Views(levels, twins.azimuth_deg, twins.object_index, twins.object_names, twins.descriptor))
    belief = belief_after([view(twins, 0, deg) for deg in QUERIES_DEG[:2]], QUERIES_DEG[:2], index)
    decisions = [decide(belief, last=True, fit=fitted(0, 0.9, second=0.9 - by)) for by in (0.15, 0.5)]
    assert [found.outcome for found in decisions] == [Outcome.AMBIGUOUS, Outcome.FOUND]
    assert all(found.probability >= LAST_CONFIDENCE for found in decisions)


def test_a_search_between_both_is_ambiguous_only_after_its_last_view() -> None:
    shares = np.linspace(0, 1, 41).tolist()
    share = next(one for one in shares if 0.3 < posterior(search(one))[1] < 0.7)
    found, end = decide(search(share), last=False), decide(search(share), last=True)
    assert (found.outcome, found.reason) == (Outcome.CONTINUE, StopReason.NOT_CONFIDENT)
    assert (end.outcome, end.reason) == (Outcome.AMBIGUOUS, StopReason.MAX_VIEWS)


def test_two_equal_objects_share_the_probability() -> None:
    views = catalog(6)
    own = views.of(2)
    twin = type(views).of_object("twin", views.levels(own), views.azimuth_deg[own], views.descriptor)
    index = DenseIndex(type(views).concatenate([views, twin]))
    probability, _ = posterior(search(0.0, index=index))
    assert probability[2] == pytest.approx(probability[6], rel=1e-3)
    assert decide(search(0.0, index=index), last=True).outcome is not Outcome.FOUND


def test_the_better_fit_leads_among_twins() -> None:
    views = catalog(6)
    own = views.of(2)
    twin = type(views).of_object("twin", views.levels(own), views.azimuth_deg[own], views.descriptor)
    belief = search(0.0, index=DenseIndex(type(views).concatenate([views, twin])))
    for leader, other in ((2, 6), (6, 2)):
        shares = [
            among_enrolled(belief, fitted(leader, 0.6 + by, second=0.6, others=0.2, expected=0.6))
            for by in (0.0, 0.1, 0.3)
        ]
        assert np.array(shares).sum(axis=1) == pytest.approx(1)
        leading = [one[leader] for one in shares]
        assert leading == sorted(leading)
        assert leading[0] == pytest.approx(shares[0][other], rel=1e-3)
        assert leading[-1] > 0.95
        assert (
            decide(belief, last=True, fit=fitted(leader, 0.9, second=0.6, others=0.2, expected=0.6)).object_index
            == leader
        )
        assert np.delete(shares[-1], [2, 6]) == pytest.approx(np.delete(belief.probability(), [2, 6]))


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_a_more_similar_object_is_more_probable(count: int) -> None:
    not_enrolled = [posterior(search(share, count))[1] for share in (0.0, 0.2, 0.4, 0.6)]
    assert not_enrolled == sorted(not_enrolled)
    assert not_enrolled[0] < 0.05 < not_enrolled[-1]


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6])
def test_a_better_fit_raises_the_probability(share: float) -> None:
    belief = search(share)
    fits = [fitted(2, own) for own in (0.3, 0.5, 0.7, 0.9)]
    probabilities = [decide(belief, last=True, fit=one).probability for one in fits]
    assert probabilities == sorted(probabilities)
    # the fit changes the probability of "not enrolled", and not which object leads
    assert {decide(belief, last=True, fit=one).object_index for one in fits} == {2}


def test_another_light_than_at_the_enrollment_makes_an_object_less_probable() -> None:
    belief = search(0.3)
    probabilities = [posterior(belief, fitted(2, 0.7)._replace(light=by))[0][2] for by in (0.0, 0.1, 0.5, 1.0)]
    assert probabilities == sorted(probabilities, reverse=True)
    assert probabilities[-1] == posterior(belief, fitted(2, 0.7)._replace(light=30.0))[0][2]
