"""Searches in motion: when they decide."""

from math import ceil

import numpy as np
import pytest

from hbr import DenseIndex, DenseSession, Outcome, StopReason
from hbr.dense.arc import ARC_DEG, DECISIONS, SIDE_DEG, STEP_DEG, STEP_WEIGHT, ArcSession, frame_weight
from tests.hbr.dense.searches import catalog, found_from, view

NEVER, ALWAYS = 2.0, 0.0


@pytest.fixture(scope="module")
def index() -> DenseIndex:
    return DenseIndex(catalog(6))


@pytest.fixture
def confidence(monkeypatch: pytest.MonkeyPatch):
    """Return a function that sets the probability from which an object is found."""
    return lambda least: found_from(monkeypatch, least)


def pass_by(session: ArcSession, of: DenseIndex, degrees: float, j: int = 0, *, begin: float = 0.0) -> list[Outcome]:
    """Add the views of an object, a frame every 4°; return the outcome after each."""
    angles = np.arange(begin, degrees + 1, 4.0).tolist()
    return [session.add(view(of.views, j, angle), angle).outcome for angle in angles]


def test_evidence_of_an_arc_does_not_depend_on_the_number_of_its_frames() -> None:
    sums = [sum(frame_weight(step) for _ in np.arange(0, 90, step)) for step in (1.0, 2.0, 3.0)]
    assert max(sums) / min(sums) < 1.05
    assert frame_weight(0.0) == 0.0
    assert pytest.approx(STEP_DEG / 90 * sums[-1], rel=0.05) == STEP_WEIGHT


def test_first_view_is_decided_as_at_rest(index: DenseIndex) -> None:
    for row in range(0, len(index.views), 9):
        levels = index.views.levels(np.array([row]))[0]
        assert ArcSession(index).add(levels, 0.0) == DenseSession(index).add(levels, 0.0)


def test_later_decisions_come_every_step_and_need_two_sides(index: DenseIndex, confidence) -> None:
    confidence(NEVER)
    session = ArcSession(index)
    levels = index.views.levels(np.array([0]))[0]
    decided = []
    for angle in np.arange(0.0, 31.0, 3.0).tolist():
        session.add(levels, angle)
        decided.append(session.is_new_decision)
    assert np.flatnonzero(decided).tolist() == [0, 5, 10]
    assert STEP_DEG == 15.0
    session.add(levels, 20.0)  # seen before
    assert not session.is_new_decision
    assert session.belief.amount < session.belief.queries
    moving = ArcSession(index)
    pass_by(moving, index, 0.0)
    confidence(ALWAYS)
    outcomes = pass_by(moving, index, 90.0, begin=4.0)
    assert outcomes.index(Outcome.FOUND) == SIDE_DEG // 4 - 1


def test_present_decision_follows_every_frame_but_ends_no_search_on_a_guess(index: DenseIndex, confidence) -> None:
    levels = index.views.levels(np.array([0]))[0]
    for reliable in (True, False):
        confidence(NEVER)
        session, present = ArcSession(index), []
        for angle in np.arange(0.0, 71.0, 2.0).tolist():
            session.add(levels, angle, reliable=reliable)
            present.append(session.present.outcome)
            if session.is_new_decision:
                assert session.decision == session.present
            confidence(ALWAYS)
        if reliable:
            assert present.index(Outcome.FOUND) == SIDE_DEG // 2
        else:
            assert set(present) == {Outcome.CONTINUE}
            assert session.present.reason is StopReason.BADLY_SEGMENTED


def test_search_ends_after_the_arc_as_ambiguous_or_unknown(index: DenseIndex, confidence, monkeypatch) -> None:
    confidence(NEVER)
    for from_probability, outcome in ((1.0, Outcome.AMBIGUOUS), (0.0, Outcome.UNKNOWN)):
        monkeypatch.setattr("hbr.dense.stopping.UNKNOWN_FROM", from_probability)
        session = ArcSession(index)
        outcomes = pass_by(session, index, 240.0)
        assert outcomes.index(outcome) == ceil(ARC_DEG / 4)
        assert session.decisions >= DECISIONS
        short = ArcSession(index)
        pass_by(short, index, 45.0)
        assert short.end().outcome is outcome


def test_a_search_that_ends_on_its_first_side_has_an_answer(index: DenseIndex, confidence) -> None:
    confidence(NEVER)
    session = ArcSession(index)
    pass_by(session, index, 30.0)
    confidence(ALWAYS)
    assert pass_by(session, index, 40.0, begin=34.0)[-1] is Outcome.CONTINUE
    assert session.end().outcome is Outcome.FOUND


def test_objects_are_found_in_motion_and_others_are_not(index: DenseIndex) -> None:
    strange = DenseIndex(catalog(2, seed=9))
    for j in range(6):
        session = ArcSession(index)
        assert Outcome.FOUND in pass_by(session, index, 90.0, j)
        assert session.decision.object_index == j
    for j in range(2):
        assert Outcome.FOUND not in pass_by(ArcSession(index), strange, 240.0, j)
