"""A search begins again if its object was replaced or rotated by hand, and only then."""

import numpy as np
import pytest

from hbr import DenseIndex, DenseSession, Outcome, Views
from hbr.core.angles import wrap180
from hbr.dense.arc import STEP_DEG, ArcSession
from hbr.dense.change import CHANGED_FROM, CHANGED_FROM_KNOWN, DISTURBED, MORE_PER_VIEW, changed
from hbr.dense.pose import azimuth_of
from tests.hbr.dense.searches import belief_after, catalog, found_from, view

ANGLES_DEG = (0.0, 100.0, 220.0, 300.0)


@pytest.fixture(scope="module")
def index() -> DenseIndex:
    return DenseIndex(catalog(objects=12))


@pytest.fixture(autouse=True)
def never_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """No view ends a search as found."""
    found_from(monkeypatch, 2.0)


def changes(session: DenseSession, views: Views, shown: list[tuple[int, float]]) -> list[int | None]:
    """Add views at `ANGLES_DEG`, of objects that were rotated by hand; return the first view since each change."""
    found = []
    for (j, rotated_deg), angle_deg in zip(shown, ANGLES_DEG, strict=False):
        session.add(view(views, j, angle_deg + rotated_deg), angle_deg)
        found.append(None if session.change is None else session.change.first)
    return found


def test_search_begins_again_with_the_view_of_another_object(index: DenseIndex) -> None:
    session = DenseSession(index)
    assert changes(session, index.views, [(3, 0.0), (3, 0.0), (8, 40.0), (8, 40.0)]) == [None, None, 2, None]
    assert session.left_out == 2
    alone = belief_after([view(index.views, 8, deg + 40.0) for deg in ANGLES_DEG[2:]], ANGLES_DEG[2:], index)
    assert np.array_equal(session.belief.support, alone.support)
    assert session.decision.object_index == 8


def test_search_begins_again_if_the_object_was_rotated_by_hand(index: DenseIndex) -> None:
    index = DenseIndex(index.views, omega=60.0)  # the azimuths of the views count much
    session = DenseSession(index)
    assert changes(session, index.views, [(3, 0.0), (3, 0.0), (3, 140.0)]) == [None, None, 2]
    assert wrap180(azimuth_of(session.belief, 3) - ANGLES_DEG[2] - 140.0) == pytest.approx(0.0, abs=5.0)


def test_search_for_one_object_never_begins_again(index: DenseIndex) -> None:
    others = catalog(objects=12, seed=1)  # not enrolled
    for views in (index.views, others):
        for j in range(12):
            assert not any(changes(DenseSession(index), views, [(j, 20.0)] * 4))


def test_search_that_may_not_begin_again_counts_all_views(index: DenseIndex) -> None:
    shown = [(3, 0.0), (8, 40.0), (3, 0.0), (8, 40.0)]
    assert changes(DenseSession(index, most_changes=2), index.views, shown) == [None, 1, 2, None]
    session = DenseSession(index, most_changes=0)
    assert not any(changes(session, index.views, shown))
    assert session.belief.queries == 4


def test_views_to_the_end_count_from_the_change(index: DenseIndex) -> None:
    session = DenseSession(index, max_views=2)
    session.add(view(index.views, 3, 0.0), 0.0)
    assert session.add(view(index.views, 8, 140.0), 100.0).outcome is Outcome.CONTINUE
    assert session.add(view(index.views, 8, 260.0), 220.0).outcome is not Outcome.CONTINUE


def test_change_that_one_view_leaves_open_is_found_by_the_next(index: DenseIndex) -> None:
    views = index.views
    # a view of which each half shows one of both objects
    half = np.random.default_rng(0).random(len(view(views, 3, 0.0))) < 0.5
    between = np.where(half, view(views, 3, 100.0), view(views, 8, 140.0)).astype(np.uint8)
    session = DenseSession(index)
    for levels, angle_deg in ((view(views, 3, 0.0), 0.0), (between, 100.0)):
        session.add(levels, angle_deg)
        assert session.change is None
    session.add(view(views, 8, 260.0), 220.0)
    assert session.change is not None
    assert session.left_out == session.change.first
    assert session.left_out in (1, 2)


def test_less_evidence_is_needed_of_a_known_object_and_after_a_disturbance(
    index: DenseIndex, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hbr.dense.change.BETA", 20.0)  # far more evidence than is needed
    shown = [view(index.views, 3, 0.0)] * 3

    def needed(views: int = 1, **options: set[int]) -> float:
        before = belief_after(shown[:views], [0.0] * views, index)
        after = belief_after([*shown[:views], view(index.views, 8, 140.0)], [0.0] * views + [100.0], index)
        found = changed(after, [before], **options)
        assert found is not None
        assert found.evidence > found.needed
        return found.needed

    assert needed() == CHANGED_FROM_KNOWN
    assert needed(views=3) == CHANGED_FROM_KNOWN + 2 * MORE_PER_VIEW
    monkeypatch.setattr("hbr.dense.change.KNOWN_FROM", 1000.0)
    assert needed() == CHANGED_FROM
    assert needed(disturbed={1}) == CHANGED_FROM - DISTURBED
    assert needed(disturbed={0}) == CHANGED_FROM  # before the first view


def test_disturbed_table_decides_a_doubtful_change(index: DenseIndex, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = view(index.views, 3, 0.0), view(index.views, 8, 140.0)
    beliefs = [belief_after(shown[:n], ANGLES_DEG[:n], index) for n in (1, 2)]
    found = changed(beliefs[1], beliefs[:1])
    assert found is not None
    monkeypatch.setattr("hbr.dense.change.CHANGED_FROM_KNOWN", found.evidence + DISTURBED / 2)
    monkeypatch.setattr("hbr.dense.change.CHANGED_FROM", found.evidence + DISTURBED / 2)
    for disturbed in (False, True):
        session = DenseSession(index)
        session.add(shown[0], 0.0)
        session.add(shown[1], 100.0, disturbed=disturbed)
        assert (session.change is not None) is disturbed


def test_earlier_views_that_are_described_again_include_those_left_out(index: DenseIndex) -> None:
    session, again = DenseSession(index), DenseSession(index)
    shown = [view(index.views, j, deg) for j, deg in ((3, 0.0), (8, 100.0), (8, 220.0))]
    for one in (session, again):
        one.add(shown[0], 0.0)
        one.add(shown[1], 100.0, earlier=[shown[0]])
    assert session.left_out == 1
    session.add(shown[2], 220.0)
    again.add(shown[2], 220.0, earlier=[shown[0], view(index.views, 8, 120.0)])
    assert again.left_out == 1
    assert again.belief.queries == session.belief.queries == 2
    assert not np.array_equal(again.belief.support, session.belief.support)
    with pytest.raises(ValueError, match="2 earlier views; the search has 3"):
        again.add(shown[2], 300.0, earlier=shown[:2])


def test_search_in_motion_begins_again_within_a_few_steps(index: DenseIndex) -> None:
    session, noticed = ArcSession(index), None
    for n, angle_deg in enumerate(np.arange(0.0, 160.0, 3.0).tolist()):
        j, rotated_deg = (3, 0.0) if angle_deg < 60.0 else (8, 50.0)
        session.add(view(index.views, j, angle_deg + rotated_deg), angle_deg)
        if session.change is not None:
            assert noticed is None
            noticed = angle_deg
            assert session.is_new_decision
            assert session.left_out + session.belief.queries == n + 1
    assert noticed is not None
    assert 60.0 <= noticed <= 60.0 + 3 * STEP_DEG
    assert session.decisions == 1 + int(
        (session.belief.orientation_deg[-1] - session.belief.orientation_deg[0]) / STEP_DEG
    )
    assert session.decision.object_index == 8
