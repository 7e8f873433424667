from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr import Extension, ViewIndex, Views, retrieve
from tests.fuzzing import examples
from tests.hbr.paper.retrieval_reference import SEVERAL, Enumeration, similarity_of_several

EXTENSIONS = get_args(Extension)


def one_hot(*levels: tuple[int, int]) -> np.ndarray:
    row = np.zeros(144, np.uint8)
    for bin_, level in levels:
        row[bin_] = level
    return row


@st.composite
def small_cases(draw: st.DrawFn) -> tuple[np.ndarray, list[float], Views, float, int]:
    """Draw model sets with few bins and levels, so that similarities are equal; azimuths are regular or not."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(1, 14))
    steps = draw(st.integers(1, 4))
    objects = draw(st.integers(1, 4))
    bins, top = draw(st.integers(1, 6)), draw(st.sampled_from([1, 7]))

    def rows(n: int) -> np.ndarray:
        descriptors = np.zeros((n, 144), np.uint8)
        descriptors[:, :bins] = rng.integers(0, top + 1, (n, bins))
        return descriptors

    # multiples of an eighth of a degree: differences are exact, so that ties of the reference are ties
    azimuth = (5 * rng.integers(0, 72, count)).astype(np.float64)
    if draw(st.booleans()):
        azimuth = rng.integers(0, 2880, count) / 8.0
    views = Views(rows(count), azimuth, rng.integers(0, objects, count), tuple("abcd"[:objects]))
    orientations = (rng.integers(-2880, 2880, steps) / 8).tolist()
    return rows(steps), orientations, views, draw(st.sampled_from([0.0, 0.5, 2.0])), draw(st.integers(1, 5))


@pytest.mark.parametrize("extension", EXTENSIONS)
@examples(17)
@given(small_cases())
def test_equals_the_enumeration_of_all_paths(
    extension: Extension, case: tuple[np.ndarray, list[float], Views, float, int]
) -> None:
    queries, orientations, views, omega, length = case
    expected = Enumeration(queries, orientations, views, omega, length, extension)
    ranking = retrieve(queries, orientations, ViewIndex(views), omega=omega, list_length=length, extension=extension)
    assert [rows.tolist() for rows in ranking.lists] == expected.lists
    assert sorted(ranking.object_index.tolist()) == expected.candidates
    for j, score, pose, path in zip(
        ranking.object_index.tolist(), ranking.scores.tolist(), ranking.pose_deg, ranking.paths.tolist(), strict=True
    ):
        assert score == pytest.approx(expected.scores[j], abs=1e-12)
        assert all(v in nodes for v, nodes in zip(path, expected.nodes[j], strict=True))
        assert expected.value(path) == pytest.approx(score, abs=1e-12)
        assert pose == views.azimuth_deg[path[-1]]
    order = list(zip(-ranking.scores, ranking.object_index, strict=True))
    assert order == sorted(order)


@pytest.mark.parametrize("extension", EXTENSIONS)
@examples(5)
@given(small_cases(), st.integers(0, 2**32 - 1))
def test_several_descriptors_add_up_with_their_weights(
    extension: Extension, case: tuple[np.ndarray, list[float], Views, float, int], seed: int
) -> None:
    first_queries, orientations, first, omega, length = case
    rng = np.random.default_rng(seed)

    def both(levels: np.ndarray) -> np.ndarray:
        return np.concatenate([levels, rng.integers(0, 8, levels.shape, np.uint8)], axis=1)

    views = Views(both(first.descriptors), first.azimuth_deg, first.object_index, first.object_names, SEVERAL)
    queries = both(first_queries)
    expected = Enumeration(queries, orientations, views, omega, length, extension, similarity_of_several)
    ranking = retrieve(queries, orientations, ViewIndex(views), omega=omega, list_length=length, extension=extension)
    scores = dict(zip(ranking.object_index.tolist(), ranking.scores.tolist(), strict=True))
    assert scores == pytest.approx(expected.scores, abs=1e-12)


@examples(6)
@given(small_cases(), st.integers(-720, 720))
def test_zero_of_the_orientations_does_not_matter(
    case: tuple[np.ndarray, list[float], Views, float, int], zero_deg: int
) -> None:
    queries, orientations, views, omega, length = case
    index = ViewIndex(views)
    plain = retrieve(queries, orientations, index, omega=omega, list_length=length)
    shifted = retrieve(queries, np.add(orientations, zero_deg), index, omega=omega, list_length=length)
    assert shifted.object_index.tolist() == plain.object_index.tolist()
    assert shifted.scores == pytest.approx(plain.scores, abs=1e-12)
    assert shifted.paths.tolist() == plain.paths.tolist()


# Two objects for the examples by hand. Query 1 is seen at 0 degrees, query 2 at 90.
#   a: view 0 at 0   = query 1     view 1 at 90  = half like query 2     view 2 at 180 = query 2
#   b: view 3 at 0   = query 2
# T(query 2, view 1): (2, 0) against (1, 1) is 2 / (4 + 2 - 2) = 0.5
Q1 = one_hot((0, 2))
Q2 = one_hot((1, 2))
HAND = Views(
    np.stack([Q1, one_hot((1, 1), (2, 1)), Q2, Q2]),
    np.array([0.0, 90.0, 180.0, 0.0]),
    np.array([0, 0, 0, 1]),
    ("a", "b"),
)


@pytest.mark.parametrize(
    ("extension", "omega", "expected"),
    [
        # lists: {view 0}, {view 2}; view 2 is 180 from view 0, 90 degrees more than the camera's 90: 2 - 1 * 0.25
        ("visual", 1.0, [("a", 1.75, [0, 2])]),
        ("orient", 1.0, [("a", 1.75, [0, 2])]),
        # view 0 leads to view 1 at the second query (1 + 0.5, no penalty), view 2 back to view 1 at the first
        ("orient_all", 1.0, [("a", 1.75, [0, 2])]),
        ("orient_all", 4.0, [("a", 1.5, [0, 1])]),
        ("orient", 4.0, [("a", 1.0, [0, 2])]),
    ],
)
def test_extensions_add_the_views_of_a_known_example(
    extension: Extension, omega: float, expected: list[tuple[str, float, list[int]]]
) -> None:
    found = retrieve([Q1, Q2], [0, 90], ViewIndex(HAND), omega=omega, list_length=1, extension=extension)
    assert list(zip(found.names, found.scores.tolist(), found.paths.tolist(), strict=True)) == expected


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        ({"queries": np.zeros((0, 144), np.uint8), "orientation_deg": []}, ValueError, "at least one"),
        ({"queries": Q1}, ValueError, r"\(N, 144\)"),
        ({"queries": np.zeros((2, 144))}, TypeError, "uint8"),
        ({"orientation_deg": [0.0]}, ValueError, "each of 2 queries"),
        ({"orientation_deg": [0.0, np.nan]}, ValueError, "finite"),
        ({"index": ViewIndex(Views.empty())}, ValueError, "enroll"),
        ({"omega": -0.1}, ValueError, "omega"),
        ({"omega": np.inf}, ValueError, "omega"),
        ({"list_length": 0}, ValueError, "list_length"),
        ({"extension": "both"}, ValueError, "visual, orient, orient_all"),
    ],
)
def test_invalid_arguments_are_rejected(changed: dict[str, Any], error: type[Exception], message: str) -> None:
    arguments = {"queries": np.stack([Q1, Q2]), "orientation_deg": [0.0, 90.0], "index": ViewIndex(HAND)}
    with pytest.raises(error, match=message):
        retrieve(**(arguments | changed))
