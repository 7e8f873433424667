import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr.evaluation.statistics import bootstrap_difference, mcnemar_exact, wilson


@given(st.integers(1, 2000), st.data())
def test_wilson_equals_scipy(trials: int, data: st.DataObject) -> None:
    hits = data.draw(st.integers(0, trials))
    from scipy import stats  # takes a second to load

    expected = stats.binomtest(hits, trials).proportion_ci(method="wilson")
    assert wilson(hits, trials) == pytest.approx((expected.low, expected.high), abs=1e-12)


@given(st.integers(0, 300), st.integers(0, 300))
def test_mcnemar_equals_the_binomial_test(a: int, b: int) -> None:
    from scipy import stats

    expected = stats.binomtest(a, a + b).pvalue if a + b else 1.0
    assert mcnemar_exact(a, b) == pytest.approx(expected, rel=1e-9)


def test_mcnemar_equals_values_computed_by_hand() -> None:
    assert mcnemar_exact(6, 0) == 2 / 64
    assert mcnemar_exact(1, 3) == mcnemar_exact(3, 1) == 2 * 5 / 16


def test_bootstrap_resamples_objects_not_trials() -> None:
    rng = np.random.default_rng(0)
    of_object = np.repeat(rng.random((60, 1)) < 0.7, 20, axis=1)  # all trials of an object are one
    never = np.zeros_like(of_object)
    low, high = bootstrap_difference(of_object, never, np.random.default_rng(1))
    rate = of_object.mean()
    spread = 1.96 * (rate * (1 - rate) / 60) ** 0.5
    assert (low, high) == pytest.approx((rate - spread, rate + spread), abs=0.03)
    assert bootstrap_difference(of_object, of_object, rng) == (0, 0)


@pytest.mark.parametrize(
    "call",
    [
        lambda: wilson(3, 2),
        lambda: wilson(0, 0),
        lambda: mcnemar_exact(-1, 2),
        lambda: bootstrap_difference(np.ones((2, 3), bool), np.ones((3, 2), bool), np.random.default_rng()),
    ],
)
def test_impossible_counts_are_rejected(call) -> None:
    with pytest.raises(ValueError, match=r"trials|hits"):
        call()
