"""The numbers of a fitted rule and of searches stay the same: they are published, and saved runs repeat them."""

import numpy as np
import pytest

import hbr
from hbr.dense.arc import ArcSession, fit_arc_confidence
from hbr.dense.pose import poses_of


@pytest.fixture(scope="module")
def index() -> hbr.DenseIndex:
    """Return 50 drawn objects of 8 views, which change smoothly around the object."""
    rng = np.random.default_rng(0)
    kind = hbr.descriptor("edges+colours")
    parts = []
    for j in range(50):
        first, second = rng.integers(0, 4, (2, kind.length)) * (rng.random((2, kind.length)) < 0.4)
        share = (1 - np.cos(np.arange(8) * np.pi / 4)) / 2
        levels = np.where(rng.random(kind.length) < share[:, None], second, first).astype(np.uint8)
        parts.append(hbr.Views.of_object(f"object {j}", levels, np.arange(8) * 45.0 + j % 3, kind.name))
    return hbr.DenseIndex(hbr.Views.concatenate(parts))


@pytest.fixture(scope="module")
def found(index: hbr.DenseIndex) -> hbr.FittedRule:
    return hbr.fit_stopping_rule(index, most_searches=100, most_shifted_searches=50)


def numbers(index: hbr.DenseIndex, session: hbr.DenseSession, angles: list[float], *rotations: object) -> list[float]:
    """Return the numbers of a search for object 7, whose views have errors."""
    rng, rows = np.random.default_rng(1), index.views.of(7)
    for n, angle in enumerate(angles):
        levels = index.views.levels(rows[[n % 8]])[0]
        wrong = rng.random(len(levels)) < 0.8
        decision = session.add(np.where(wrong, rng.integers(0, 4, len(levels)), levels).astype(np.uint8), angle)
    best, (azimuth_deg, *_) = session.next_best_view(*rotations), poses_of(session.belief, decision.object_index)
    return [
        decision.object_index, decision.probability, decision.open_set_score, decision.open_set_threshold,
        best.rotation_deg, float(np.median(best.confusion)), azimuth_deg,
    ]  # fmt: skip


def test_numbers_of_a_fitted_rule(
    index: hbr.DenseIndex, found: hbr.FittedRule, monkeypatch: pytest.MonkeyPatch
) -> None:
    rule = found.rule
    assert (found.ended, found.wrong, found.mean_views, found.rejected, found.accepted) == (100, 0, 1.0, 0, 4)
    assert (rule.min_confidence, rule.false_accept, rule.limitations) == (0.9, 0.08, ())
    assert [(one.accepted, one.rejected, one.false_accepts) for one in rule.rates] == [
        (10, 0, 2), (10, 0, 2), (10, 0, 0), (10, 0, 0), (9, 0, 0),
    ]  # fmt: skip
    for thresholds, early, last in (
        (rule.open_set_thresholds, -7.5117972792, -9.2388025542),
        (rule.same_bench_thresholds, -7.5117972792, -9.2388025542),
        (rule.changed_bench_thresholds, -7.6296737583, -10.6748447834),
    ):
        assert thresholds == pytest.approx([early] * 3 + [last])
    assert rule.unknown_thresholds == pytest.approx((-16.3811509719, -13.3541501645, -12.6590924979, -12.0743723601))
    assert rule.leave_one_out_thresholds == pytest.approx((1.0837565127, 1.0701975000, 1.1046153613, 1.0849816831))
    assert rule.usual_scores.mean() == pytest.approx(0.9570251157)
    monkeypatch.setattr("hbr.dense.arc.MOST_SEARCHES", 20)
    assert fit_arc_confidence(index, rule) == 0.98


def test_numbers_of_searches(index: hbr.DenseIndex, found: hbr.FittedRule) -> None:
    rule, ends = found.rule, np.delete(np.arange(-90.0, 91.0, 15.0), 6)
    assert numbers(index, hbr.DenseSession(index, rule), [3.0]) == pytest.approx(
        [7, 0.0841801787, -4.7869476489, -7.5117972792, -60.0, -99.9999984770, 352.1742316628]
    )
    assert numbers(index, hbr.DenseSession(index, rule), [3.0, 48.0, 93.0]) == pytest.approx(
        [7, 0.1605481057, -6.6940798155, -7.5117972792, 60.0, -98.8891003462, 73.7785688717]
    )
    moving = ArcSession(index, rule, 0.95)
    assert numbers(index, moving, [3.0, 13.0, 23.0, 33.0], ends, np.abs(ends) / 60) == pytest.approx(
        [7, 0.1529595211, -4.7869476489, -7.5117972792, 90.0, -85.9906866245, 42.0302527204]
    )
