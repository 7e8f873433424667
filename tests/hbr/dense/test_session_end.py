"""The comparison after a view at rest: the search asks for enrolled views, and its decision depends on them."""

import numpy as np
import pytest

import hbr
from hbr import Outcome
from hbr.dense.arc import ArcSession
from hbr.dense.session import NeedEnrolledViews, answered
from hbr.dense.stopping import decide
from tests.hbr.dense.searches import catalog, fitted, found_from


@pytest.fixture
def session() -> hbr.DenseSession:
    """A search for one of two near twins, which have the same descriptors, after its last view."""
    others = catalog(objects=4)
    own = others.of(0)
    twin = hbr.Views.of_object("twin", others.levels(own), others.azimuth_deg[own], others.descriptor)
    index = hbr.DenseIndex(hbr.Views.concatenate([others, twin]))
    session = hbr.DenseSession(index, max_views=1)
    session.add(others.levels(own[:1])[0], 0.0)
    assert session.end().outcome in (Outcome.AMBIGUOUS, Outcome.UNKNOWN)
    return session


@pytest.mark.parametrize(("by", "outcome"), [(0.0, Outcome.AMBIGUOUS), (0.02, Outcome.AMBIGUOUS), (0.3, Outcome.FOUND)])
def test_near_twins_are_ambiguous_unless_the_pixels_separate_them(session, by: float, outcome: Outcome) -> None:
    for twin in (0, 4):
        answered(session.verify(lambda _: [], fitted(twin, 0.9, second=0.9 - by, others=0.2, expected=0.9)))
        assert (session.end().outcome, session.end().object_index) == (outcome, twin if by else 0)


def test_without_enrolled_views_the_decision_stays(session) -> None:
    before = session.end()
    step = session.verify(lambda _: pytest.fail("no view is needed"))
    assert isinstance(next(step), NeedEnrolledViews)
    with pytest.raises(StopIteration) as end:
        step.send(None)
    assert end.value.value is None
    assert session.end() == before


def test_a_search_at_rest_is_verified_unless_its_object_is_hardly_enrolled(session) -> None:
    views = session.belief.index.views
    need = next(session.verify(lambda _: pytest.fail("first it asks")))
    assert need.object_index == session.end().object_index
    moving = ArcSession(session.belief.index)
    moving.add(views.levels(np.array([0]))[0], 0.0)
    unknown = hbr.DenseSession(session.belief.index)
    for n in range(4):
        unknown.add(catalog(1, seed=9).levels(np.array([4 * n]))[0], 80.0 * n)
    assert unknown.end().outcome is Outcome.UNKNOWN
    for one in (moving, unknown):
        before = one.end()
        assert answered(one.verify(lambda _: pytest.fail("no view is needed"))) is None
        assert (one.verification, one.end()) == (None, before)


def test_a_measured_fit_replaces_the_enrolled_views(session) -> None:
    found = []
    for own in (0.1, 0.5, 0.9):
        measured = fitted(session.end().object_index, own, expected=0.8)
        assert answered(session.verify(lambda _: pytest.fail("no view is needed"), measured)) is measured
        assert session.decision == session.present == decide(session.belief, last=True, fit=measured)
        found.append(session.end().not_enrolled)
    assert found == sorted(found, reverse=True)
    session.add(session.belief.index.views.levels(np.array([0]))[0], 0.0)
    assert session.verification is None


def test_a_good_fit_ends_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    index = hbr.DenseIndex(catalog(objects=4))
    session = hbr.DenseSession(index)
    session.add(index.views.levels(np.array([0]))[0], 0.0)
    with_fit = decide(session.belief, last=False, fit=fitted(0, 0.95, second=0.2, others=0.2, expected=0.9)).probability
    found_from(monkeypatch, with_fit)
    session = hbr.DenseSession(index)
    assert session.add(index.views.levels(np.array([0]))[0], 0.0).outcome is Outcome.CONTINUE
    answered(session.verify(lambda _: [], fitted(0, 0.95, second=0.2, others=0.2, expected=0.9)))
    assert session.decision.outcome is session.end().outcome is Outcome.FOUND
