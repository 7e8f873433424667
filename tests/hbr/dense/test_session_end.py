"""The last steps of a search: it asks for enrolled views, and its decision depends on them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

import hbr
from hbr import Outcome, StopReason
from hbr.dense.arc import ArcSession
from hbr.dense.local_difference import LocalView
from hbr.dense.session import NeedEnrolledViews, Verification, answered, compare_leaders
from tests.hbr.dense.test_local_difference import shown
from tests.hbr.dense.test_stopping import catalog

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
    twin = hbr.Views.of_object("twin", others.levels(own), others.azimuth_deg[own])
    index = hbr.DenseIndex(hbr.Views.concatenate([others, twin]))
    rule = hbr.fit_stopping_rule(hbr.DenseIndex(others)).rule
    usual = np.vstack([rule.usual_scores, rule.usual_scores[:1]])
    session = hbr.DenseSession(index, replace(rule, usual_scores=usual), max_views=1)
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
    assert end.min_confidence == 1 - session.rule.error_rate
    assert end.open_set_score == before.open_set_score
    session.add(session.belief.levels[0], 0.0)
    assert session.comparison is None
    assert session.end().reason is not StopReason.LOCAL_DIFFERENCE


@pytest.mark.parametrize(
    ("before", "are_twins", "is_enrolled", "after"),
    [
        (Outcome.AMBIGUOUS, True, True, Outcome.FOUND),
        (Outcome.AMBIGUOUS, False, True, Outcome.FOUND),
        (Outcome.AMBIGUOUS, True, False, Outcome.AMBIGUOUS),
        (Outcome.UNKNOWN, True, True, Outcome.FOUND),
        (Outcome.UNKNOWN, False, True, Outcome.UNKNOWN),
        (Outcome.UNKNOWN, True, False, Outcome.UNKNOWN),
    ],
)
def test_a_comparison_decides_an_unknown_search_only_for_an_object_that_fits_one_of_two_twins(
    session, enrolled, before: Outcome, are_twins: bool, is_enrolled: bool, after: Outcome
) -> None:
    plain, marked = enrolled
    second = marked if are_twins else [recoloured(view) for view in plain]
    query = shown(4.0, sticker=False, noise=90)
    step = compare_leaders(
        session.belief, before, lambda _: [query if is_enrolled else recoloured(query)], beta=60.0, max_error=0.01
    )
    found = answered(step, lambda leader, _: second if leader == 4 else plain)
    assert found is not None
    assert (found.outcome, found.winner) == (after, 0 if after is Outcome.FOUND else None)


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
    assert answered(session.verify(lambda _: pytest.fail("it is not doubtful"))) is None


def test_a_doubtful_search_in_motion_is_not_verified(session, monkeypatch) -> None:
    monkeypatch.setattr("hbr.dense.session.is_doubtful", lambda *_: True)
    need = next(session.verify(lambda _: pytest.fail("first it asks")))
    assert need.object_index == session.end().object_index
    moving = ArcSession(session.belief.index, session.rule, 2.0)
    moving.add(session.belief.levels[0], 0.0)
    assert answered(moving.verify(lambda _: pytest.fail("no view is needed"))) is None
    assert moving.verification is None


def test_a_measured_fit_replaces_the_enrolled_views(session) -> None:
    before = session.end()
    assert answered(session.verify(lambda _: pytest.fail("no view is needed"), Verification(0, 0.0, 0.0))) is not None
    assert session.end() == session.verification.decided(before, session.found_from)
    assert session.end().reason is StopReason.PIXEL_FIT
