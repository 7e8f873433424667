"""A search, view by view: its shortlist of a large catalog, views that are described again, and its end."""

from collections.abc import Sequence

import numpy as np
import pytest

from hbr import DenseIndex, DenseSession, Outcome
from hbr.dense.filter import update_belief
from tests.hbr.dense.searches import belief_after, catalog, found_from, view

QUERIES_DEG = (0.0, 100.0, 220.0)
STRANGE = catalog(1, seed=9)


@pytest.fixture(scope="module")
def index() -> DenseIndex:
    return DenseIndex(catalog(20))


def searched(session: DenseSession, queries: Sequence[np.ndarray]) -> DenseSession:
    for query, deg in zip(queries, QUERIES_DEG, strict=False):
        session.add(query, deg)
    return session


def test_a_search_is_the_belief_of_its_views_and_the_decision_after_each(index: DenseIndex) -> None:
    queries = [view(index.views, 3, deg) for deg in QUERIES_DEG]
    session = searched(DenseSession(index), queries)
    np.testing.assert_array_equal(session.belief.support, belief_after(queries, QUERIES_DEG, index).support)
    assert (session.decision.outcome, session.decision.object_index) == (Outcome.FOUND, 3)
    assert session.end() == session.present == session.decision


def test_a_search_that_ends_has_an_answer_after_any_view(index: DenseIndex, monkeypatch: pytest.MonkeyPatch) -> None:
    found_from(monkeypatch, 2.0)
    session = searched(DenseSession(index, max_views=3), [view(index.views, 3, deg) for deg in QUERIES_DEG[:2]])
    assert session.decision.outcome is Outcome.CONTINUE
    assert session.end().outcome is Outcome.AMBIGUOUS
    assert session.add(view(index.views, 3, 220.0), 220.0).outcome is Outcome.AMBIGUOUS


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only two objects of a catalog are considered."""
    monkeypatch.setattr("hbr.dense.session.KEPT", 2)


@pytest.mark.usefixtures("few")
def test_some_objects_of_a_large_catalog_are_considered_in_the_space_of_all(index: DenseIndex) -> None:
    queries = [view(index.views, 3, deg) for deg in QUERIES_DEG]
    session = searched(DenseSession(index), queries)
    considered = session.belief.index
    assert len(considered) == 2
    whole = belief_after(queries, QUERIES_DEG, index)
    np.testing.assert_allclose(session.belief.support, whole.support[considered.object_index], atol=1e-3)
    assert considered.space is index.space
    assert session.decision.object_index == 3


@pytest.mark.usefixtures("few")
def test_an_object_that_the_first_view_leaves_out_is_found_by_later_ones(index: DenseIndex) -> None:
    queries = [view(index.views, 5, QUERIES_DEG[0]), *(view(index.views, 3, deg) for deg in QUERIES_DEG[1:])]
    first = searched(DenseSession(index, most_changes=0), queries[:1])
    mixed = np.where(np.random.default_rng(1).random(len(queries[0])) < 0.3, view(index.views, 3, 0.0), queries[0])
    session = searched(DenseSession(index, most_changes=0), [mixed])
    assert 3 not in first.belief.index.object_index
    for query, deg in zip(queries[1:], QUERIES_DEG[1:], strict=True):
        first.add(query, deg)
        session.add(query, deg)
    for one, shown in ((first, queries[0]), (session, mixed)):
        place = int(np.flatnonzero(one.belief.index.object_index == 3)[0])
        whole = belief_after([shown, *queries[1:]], QUERIES_DEG, index)
        np.testing.assert_allclose(one.belief.support[place], whole.support[3], atol=1e-3)  # all views count
        assert one.belief.queries == 3
        assert one.decision.object_index == 3


def test_earlier_views_that_are_described_again_replace_the_first_descriptions(index: DenseIndex) -> None:
    queries = [view(index.views, 3, deg) for deg in QUERIES_DEG]
    session = searched(DenseSession(index, most_changes=0), [view(STRANGE, 0, 0.0), queries[1]])
    session.add(queries[2], QUERIES_DEG[2], earlier=queries[:2])
    whole = belief_after(queries, QUERIES_DEG, index)
    np.testing.assert_array_equal(session.belief.support, whole.support)
    assert session.decision == searched(DenseSession(index), queries).decision
    with pytest.raises(ValueError, match="1 earlier views; the search has 3"):
        session.add(queries[0], 0.0, earlier=queries[:1])


@pytest.mark.usefixtures("few")
def test_a_shortlist_follows_from_the_views_as_they_are_described_again(index: DenseIndex) -> None:
    queries = [view(index.views, 3, deg) for deg in QUERIES_DEG]
    session = searched(DenseSession(index, most_changes=0), [view(index.views, 5, 0.0)])
    session.add(queries[1], QUERIES_DEG[1], earlier=queries[:1])
    fresh = searched(DenseSession(index, most_changes=0), queries[:2])
    np.testing.assert_array_equal(session.belief.index.object_index, fresh.belief.index.object_index)
    np.testing.assert_array_equal(session.belief.support, fresh.belief.support)


def test_a_search_does_not_end_by_views_that_were_not_segmented_reliably(index: DenseIndex) -> None:
    query = view(index.views, 3, 0.0)
    assert DenseSession(index).add(query, 0.0, reliable=False).outcome is Outcome.CONTINUE
    assert DenseSession(index, max_views=1).add(query, 0.0, reliable=False).outcome is Outcome.FOUND


def test_the_next_view_is_that_of_the_belief(index: DenseIndex) -> None:
    session = searched(DenseSession(index), [view(index.views, 3, 0.0)])
    chosen = session.next_best_view([-90.0, 45.0, 120.0], [1.0, 0.5, 1.3])
    assert chosen.rotation_deg in (-90.0, 45.0, 120.0)
    belief = update_belief(view(index.views, 3, 0.0), 0.0, index)
    np.testing.assert_array_equal(session.belief.posterior, belief.posterior)
