"""The open-set threshold of the paper's retrieval."""

import numpy as np
import pytest

import hbr


def ring(seed: int, n: int, change: int) -> hbr.Views:
    """Return views of an object that changes by ``change`` bins from each view to the next."""
    rng = np.random.default_rng(seed)
    rows = [rng.integers(0, 8, 144).astype(np.uint8)]
    for _ in range(n - 1):
        row = rows[-1].copy()
        row[rng.choice(144, change, replace=False)] = rng.integers(0, 8, change)
        rows.append(row)
    return hbr.Views.of_object(f"object {seed}", np.array(rows), np.arange(n) * 360 / n)


def by_hand(views: hbr.Views) -> list[float]:
    """Return every average for one object with views by rising azimuth; their number is a multiple of four."""
    n = len(views)
    T = hbr.tanimoto(views.descriptors, views.descriptors)
    best = [max(T[k, k - 1], T[k, (k + 1) % n]) for k in range(n)]
    return [np.mean([best[(k + i * n // 4) % n] for i in range(4)]) for k in range(n)]


def test_threshold_is_a_quantile_of_neighbour_similarities():
    views = ring(1, 24, 12)
    expected = np.quantile(by_hand(views), 0.05)
    assert hbr.open_set_threshold(views, repeatability=1.0) == pytest.approx(expected)


def test_threshold_is_independent_of_the_order_and_separate_for_objects():
    both = hbr.Views.concatenate([ring(1, 24, 12), ring(2, 16, 30)])
    shuffled = both.select(np.random.default_rng(0).permutation(len(both)))
    assert hbr.open_set_threshold(shuffled) == pytest.approx(hbr.open_set_threshold(both))
    expected = np.quantile(by_hand(ring(1, 24, 12)) + by_hand(ring(2, 16, 30)), 0.05)
    assert hbr.open_set_threshold(both) == pytest.approx(expected)


def test_coarser_enrollment_has_a_lower_threshold():
    fine = ring(3, 72, 8)
    assert hbr.open_set_threshold(fine.select(np.arange(0, 72, 6))) < hbr.open_set_threshold(fine)


def test_too_few_views_give_0():
    assert hbr.open_set_threshold(ring(4, 3, 5)) == 0.0
    assert hbr.open_set_threshold(hbr.Views.empty()) == 0.0


def test_threshold_of_round_objects_is_limited_by_the_repeatability():
    face = np.random.default_rng(5).integers(0, 8, 144).astype(np.uint8)
    views = hbr.Views.of_object("vase", np.tile(face, (36, 1)), np.arange(36) * 10.0)
    assert hbr.open_set_threshold(views) == 0.97
    assert hbr.open_set_threshold(views, repeatability=0.9) == 0.9
    with pytest.raises(ValueError, match="repeatability is 2"):
        hbr.open_set_threshold(views, repeatability=2)
