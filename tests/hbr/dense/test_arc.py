"""Searches in motion: when they decide, and by which rule."""

from dataclasses import replace
from math import ceil

import numpy as np
import pytest

from hbr import DenseIndex, DenseSession, Outcome, Views, leave_one_out
from hbr.dense.arc import (
    ARC_DEG,
    DECISIONS,
    MOTION_LOSS,
    SIDE_DEG,
    STEP_DEG,
    STEP_WEIGHT,
    ArcSession,
    arc_confidence,
    fit_arc_confidence,
    frame_weight,
)
from hbr.dense.fitting import UNFITTED_MIN_CONFIDENCE, fit_stopping_rule
from hbr.dense.stopping import StoppingRule, StopReason
from tests.hbr.dense.test_stopping import catalog


@pytest.fixture(scope="module")
def index() -> DenseIndex:
    return DenseIndex(catalog(objects=6))


@pytest.fixture(scope="module")
def rest(index: DenseIndex) -> StoppingRule:
    return fit_stopping_rule(index, most_searches=60).rule


def pass_by(session: ArcSession, of: Views, row: int, degrees: float) -> list[Outcome]:
    """Add the views of an object from one view on, a frame every 4°; return the outcome after each."""
    rows = of.of(int(of.object_index[row]))
    found = []
    for angle in np.arange(0.0, degrees + 1, 4.0).tolist():
        away = np.abs((of.azimuth_deg[rows] - of.azimuth_deg[row] - angle + 180) % 360 - 180)
        found.append(session.add(of.levels(rows[[int(away.argmin())]])[0], angle).outcome)
    return found


def test_evidence_of_an_arc_does_not_depend_on_the_number_of_its_frames() -> None:
    sums = [sum(frame_weight(step) for _ in np.arange(0, 90, step)) for step in (1.0, 2.0, 3.0)]
    assert max(sums) / min(sums) < 1.05
    assert frame_weight(0.0) == 0.0


def test_first_view_is_decided_as_at_rest(
    index: DenseIndex, rest: StoppingRule, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hbr.dense.arc.MOST_SEARCHES", 24)
    confidence = fit_arc_confidence(index, rest)
    for row in range(0, len(index.views), 9):
        levels = index.views.levels(np.array([row]))[0]
        at_rest, moving = DenseSession(index, rest), ArcSession(index, rest, confidence)
        assert moving.add(levels, 0.0) == at_rest.add(levels, 0.0)


def test_later_decisions_come_every_step_and_need_two_sides(index: DenseIndex, rest: StoppingRule) -> None:
    later = replace(rest, min_confidence=2.0)  # the first view ends no search, any later frame does
    session = ArcSession(index, later, 0.0)
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
    outcomes = pass_by(ArcSession(index, later, 0.0), index.views, 0, 90.0)
    assert outcomes.index(Outcome.FOUND) == SIDE_DEG // 4


def test_rule_is_asked_after_every_frame_but_ends_no_search_on_a_guess(index: DenseIndex, rest: StoppingRule) -> None:
    later = replace(rest, min_confidence=2.0)
    for reliable in (True, False):
        session, present = ArcSession(index, later, 0.0), []
        levels = index.views.levels(np.array([0]))[0]
        for angle in np.arange(0.0, 71.0, 2.0).tolist():
            session.add(levels, angle, reliable=reliable)
            present.append(session.present.outcome)
            if session.is_new_decision:
                assert session.decision == session.present
        if reliable:
            assert present.index(Outcome.FOUND) == SIDE_DEG // 2
        else:
            assert set(present) == {Outcome.CONTINUE}
            assert session.present.reason is StopReason.BADLY_SEGMENTED


def test_search_ends_after_the_arc_as_ambiguous_or_unknown(index: DenseIndex, rest: StoppingRule) -> None:
    later = replace(rest, min_confidence=2.0)
    session = ArcSession(index, later, 2.0)
    outcomes = pass_by(session, index.views, 0, 240.0)
    assert outcomes[-1] is Outcome.AMBIGUOUS
    assert outcomes.index(Outcome.AMBIGUOUS) == ceil(ARC_DEG / 4)
    assert session.decisions >= DECISIONS
    short = ArcSession(index, later, 2.0)
    pass_by(short, index.views, 0, 45.0)
    assert short.end().outcome is Outcome.AMBIGUOUS
    strict = replace(rest, min_confidence=2.0, open_set_thresholds=(5.0,) * len(rest.open_set_thresholds))
    outcomes = pass_by(missed := ArcSession(index, strict, 0.0), index.views, 0, 240.0)
    just_above = missed.decision.open_set_score + MOTION_LOSS / 2
    doubtful = replace(strict, open_set_thresholds=(just_above,) * len(rest.open_set_thresholds))
    assert pass_by(ArcSession(index, doubtful, 0.0), index.views, 0, 240.0)[-1] is Outcome.AMBIGUOUS
    assert outcomes.index(Outcome.UNKNOWN) == (len(rest.open_set_thresholds) - 1) * SIDE_DEG // 4


def test_error_rate_counts_only_decisions_that_can_end_a_search(index: DenseIndex, rest: StoppingRule) -> None:
    searches = leave_one_out(index, views=DECISIONS, searches=4, step_deg=STEP_DEG, weight=STEP_WEIGHT)
    rest = replace(rest, error_rate=0.05, min_confidence=0.9)
    correct = searches.correct.copy()
    correct[:, 1 : round(SIDE_DEG / STEP_DEG)] = False  # wrong where no decision is made
    assert rest.min_confidence <= arc_confidence(replace(searches, correct=correct), rest) < UNFITTED_MIN_CONFIDENCE
    correct[:, 0] = False  # and where the first view ends the search
    wrong = arc_confidence(replace(searches, correct=correct), replace(rest, min_confidence=0.0))
    assert wrong == UNFITTED_MIN_CONFIDENCE


def test_confidence_of_a_large_catalog_is_fitted_to_a_part(
    index: DenseIndex, rest: StoppingRule, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hbr.dense.arc.MOST_SEARCHES", 4)
    assert fit_arc_confidence(index, rest) == max(UNFITTED_MIN_CONFIDENCE, rest.min_confidence)
    strict = replace(rest, min_confidence=0.9999)
    assert fit_arc_confidence(index, strict) == 0.9999
    single = DenseIndex(catalog(objects=1))
    assert fit_arc_confidence(single, rest) == rest.min_confidence
