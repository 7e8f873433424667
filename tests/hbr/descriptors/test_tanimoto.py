from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hbr import tanimoto
from tests.fuzzing import examples


def levels(rows: int) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.uint8, (rows, 144), elements=st.integers(0, 7), fill=st.sampled_from([0, 0, 7]))


@examples(9)
@given(levels(3), levels(4))
def test_equals_exact_fractions(a: np.ndarray, b: np.ndarray) -> None:
    found = tanimoto(a, b)
    assert found.shape == (3, 4)
    for i, x in enumerate(a.astype(int)):
        for j, y in enumerate(b.astype(int)):
            dot = int(x @ y)
            union = int(x @ x + y @ y) - dot
            assert found[i, j] == (float(Fraction(dot, union)) if union else 0.0)


@pytest.mark.parametrize(("length", "level"), [(144, 254), (301, 253)])
def test_long_rows_of_bytes_up_to_255_are_exact(length: int, level: int) -> None:
    a, b = np.full((1, length), 255, np.uint8), np.full((1, length), level, np.uint8)
    dot = length * 255 * level
    assert tanimoto(a, b)[0, 0] == dot / (length * 255**2 + length * level**2 - dot)


def test_real_valued_averages_are_not_rounded() -> None:
    a, b = np.array([0.5, 1.5]), np.array([2.0, 0.25])
    dot = 0.5 * 2.0 + 1.5 * 0.25
    assert tanimoto(a, b)[0, 0] == pytest.approx(dot / (2.5 + 4.0625 - dot), abs=1e-15)


def test_rows_of_different_lengths_are_rejected() -> None:
    with pytest.raises(ValueError, match="same d"):
        tanimoto(np.zeros(144, np.uint8), np.zeros(143, np.uint8))
