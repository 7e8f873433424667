"""The last steps of a search: it asks for enrolled views, and its decision depends on them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

import hbr
from hbr import Outcome, StopReason
from hbr.dense.arc import ArcSession
from hbr.dense.local_difference import LocalView, PixelFit
from hbr.dense.session import NeedEnrolledViews, answered, compare_leaders
from hbr.dense.stopping import ERROR_RATE, decide
from tests.hbr.dense.searches import catalog, found_from
from tests.hbr.dense.test_local_difference import shown

SIDES_DEG = np.arange(0.0, 360.0, 10.0).tolist()


@pytest.fixture(scope="module")
def enrolled() -> tuple[list[LocalView], list[LocalView]]:
    plain, marked = ([shown(side, sticker=kind, noise=n) for n, side in enumerate(SIDES_DEG)] for kind in (False, True))
    return plain, marked


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


@pytest.mark.parametrize("sticker", [False, True])
def test_the_views_that_the_search_asks_for_distinguish_near_twins(session, enrolled, sticker: bool) -> None:
    before, asked = session.end(), []

    def views(leader: int, azimuths_deg: Sequence[float]) -> list[LocalView]:
        asked.append(leader)
        assert azimuths_deg
        return enrolled[int(leader == 4)]

    found = answered(session.compare(lambda _: [shown(4.0, sticker=sticker, noise=90)]), views)
    assert found is not None
    assert sorted(asked) == [0, 4]
    end = session.end()
    assert (end.outcome, end.reason, end.object_index) == (
        Outcome.FOUND,
        StopReason.LOCAL_DIFFERENCE,
        4 if sticker else 0,
    )
    assert end.probability == 1 - found.found.error_bound
    assert end.min_confidence == 1 - ERROR_RATE
    assert end.not_enrolled == before.not_enrolled
    session.add(session.belief.index.views.levels(np.array([0]))[0], 0.0)
    assert session.comparison is None
    assert session.end().reason is not StopReason.LOCAL_DIFFERENCE


@pytest.mark.parametrize(("is_enrolled", "winner"), [(True, 0), (False, None)])
def test_an_ambiguous_search_compares_its_leaders(session, enrolled, is_enrolled: bool, winner: int | None) -> None:
    plain, marked = enrolled
    query = shown(4.0, sticker=False, noise=90)
    step = compare_leaders(session.belief, Outcome.AMBIGUOUS, lambda _: [query if is_enrolled else recoloured(query)])
    found = answered(step, lambda leader, _: marked if leader == 4 else plain)
    assert found is not None
    assert found.winner == winner


def test_an_unknown_search_compares_nothing(session) -> None:
    step = compare_leaders(session.belief, Outcome.UNKNOWN, lambda _: pytest.fail("no view is needed"))
    assert answered(step) is None


def recoloured(view: LocalView) -> LocalView:
    """Return the view of an object of the same shape, in other colours."""
    return replace(view, crop=np.roll(view.crop, 1, axis=2))


def test_without_enrolled_views_the_decision_stays(session) -> None:
    before = session.end()
    step = session.compare(lambda _: pytest.fail("no view is needed"))
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
        measured = PixelFit(session.end().object_index, own, 0.3, 0.3, 0.8)
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
    with_fit = decide(session.belief, last=False, fit=PixelFit(0, 0.95, 0.2, 0.2, 0.9)).probability
    found_from(monkeypatch, with_fit)
    session = hbr.DenseSession(index)
    assert session.add(index.views.levels(np.array([0]))[0], 0.0).outcome is Outcome.CONTINUE
    answered(session.verify(lambda _: [], PixelFit(0, 0.95, 0.2, 0.2, 0.9)))
    assert session.decision.outcome is session.end().outcome is Outcome.FOUND
