from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr import ViewIndex, Views, tanimoto
from hbr.paper.index import Method, largest
from tests.fuzzing import examples

METHODS = get_args(Method)


def views_of(descriptors: np.ndarray) -> Views:
    return Views.of_object("object", descriptors, np.zeros(len(descriptors)))


def adversarial(rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw rows that are difficult for a search: zeros, equal rows, ties, one-hot, saturated, sparse, dense."""
    kinds = [
        np.zeros((1, 144), np.uint8),
        np.full((1, 144), 7, np.uint8),
        np.eye(144, dtype=np.uint8) * rng.integers(1, 8, dtype=np.uint8),
        rng.integers(0, 8, (30, 144), dtype=np.uint8),
        rng.integers(0, 8, (30, 144), dtype=np.uint8) * (rng.random((30, 144)) < 0.1).astype(np.uint8),
        np.repeat(rng.integers(0, 2, (3, 144), dtype=np.uint8), 10, axis=0),
    ]
    chosen = [kind for kind in kinds if rng.random() < 0.6] or kinds
    pool = np.concatenate(chosen)
    return pool[rng.integers(len(pool), size=count)]


@examples(7)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 2, 5, 63, 64, 65, 700, 2600, 2700]), st.integers(1, 40))
def test_equals_brute_force(seed: int, count: int, k: int) -> None:
    rng = np.random.default_rng(seed)
    descriptors = adversarial(rng, count)
    query = descriptors[rng.integers(count)] if rng.random() < 0.5 else adversarial(rng, 1)[0]
    similarities = tanimoto(query, descriptors)[0]
    expected = np.lexsort((np.arange(count), -similarities))[:k]
    for method in METHODS:
        rows, values = ViewIndex(views_of(descriptors), method).search(query, k)
        assert rows.tolist() == expected.tolist(), method
        assert values.tolist() == similarities[expected].tolist(), method


@examples(6)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, 900), min_size=1, max_size=4), st.sampled_from(METHODS))
def test_extended_index_equals_a_new_one(seed: int, sizes: list[int], method: Method) -> None:
    rng = np.random.default_rng(seed)
    parts = [views_of(adversarial(rng, size)) for size in sizes]
    grown = ViewIndex(Views.empty(), method)
    for part in parts:
        before, count = grown, len(grown)
        grown = grown.extended(part)
        assert len(before) == count
    whole = ViewIndex(Views.concatenate(parts), method)
    query = adversarial(rng, 1)[0]
    for found, expected in zip(grown.search(query, 12), whole.search(query, 12), strict=True):
        assert found.tolist() == expected.tolist()


def test_results_are_cached_and_returned_as_copies(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = np.random.default_rng(0).integers(0, 8, (100, 144), dtype=np.uint8)
    index = ViewIndex(views_of(rows))
    searched = []
    top = index._searcher.top

    def counted(query: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        searched.append(k)
        return top(query, k)

    monkeypatch.setattr(index._searcher, "top", counted)
    expected = [part.tolist() for part in index.search(rows[3], 5)]
    for part in index.search(rows[3], 5):
        part[:] = 0
    assert [part.tolist() for part in index.search(rows[3], 5)] == expected
    assert searched == [5]
    index.search(rows[3], 6)
    assert searched == [5, 6]
    for row in rows[10:80]:
        index.search(row, 5)
        assert len(index._remembered) <= 64
    index.search(rows[3], 5)
    assert len(searched) == 2 + 70 + 1


@given(st.lists(st.integers(0, 5), min_size=1, max_size=400), st.integers(1, 10))
def test_best_of_equal_values_has_the_lower_index(values: list[int], k: int) -> None:
    rows, best = largest(np.array(values, float), k)
    expected = sorted(range(len(values)), key=lambda i: (-values[i], i))[:k]
    assert rows.tolist() == expected
    assert best.tolist() == [values[i] for i in expected]


@pytest.mark.parametrize("method", METHODS)
def test_large_k_returns_all_views_and_an_empty_index_none(method: Method) -> None:
    index = ViewIndex(views_of(np.eye(3, 144, dtype=np.uint8)), method)
    rows, similarities = index.search(np.eye(1, 144, 1, dtype=np.uint8)[0], 10)
    assert rows.tolist() == [1, 0, 2]
    assert similarities.tolist() == [1, 0, 0]
    empty = ViewIndex(Views.empty(), method)
    rows, similarities = empty.search(np.ones(144, np.uint8), 10)
    assert len(empty) == len(rows) == len(similarities) == 0
    with pytest.raises(ValueError, match="flat, tree"):
        ViewIndex(Views.empty(), "hash")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("query", "k", "error", "message"),
    [
        (np.zeros(144), 1, TypeError, "uint8"),
        (np.zeros((1, 144), np.uint8), 1, ValueError, "144"),
        (np.zeros(54, np.uint8), 1, ValueError, "54"),
        (np.full(144, 8, np.uint8), 1, ValueError, "level of 8"),
        (np.zeros(144, np.uint8), 0, ValueError, "k is 0"),
    ],
)
def test_invalid_queries_are_rejected(query: np.ndarray, k: int, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        ViewIndex(views_of(np.ones((1, 144), np.uint8))).search(query, k)
