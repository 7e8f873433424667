"""The dense Hough filter against its formula written out."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hbr import DenseIndex, Views, update_belief
from hbr.core.angles import size_deg
from hbr.dense.filter import BETA, Belief
from hbr.dense.index import BINS, OMEGA
from hbr.dense.pose import azimuth_of
from hbr.kernels import without_library
from tests.fuzzing import examples
from tests.hbr.dense.searches import belief_after


def catalog(seed: int, objects: int = 4, *, ragged: bool = True) -> Views:
    rng = np.random.default_rng(seed)
    parts = []
    for j in range(objects):
        count = int(rng.integers(1, 9)) if ragged else 8
        azimuth = rng.uniform(0, 360, count) if ragged else np.arange(8) * 45.0
        levels = rng.integers(0, 8, (count, 144)) * (rng.random((count, 144)) < 0.2)
        parts.append(Views.of_object(f"object {j}", levels.astype(np.uint8), azimuth))
    return Views.concatenate(parts)


def z_of(query: np.ndarray, index: DenseIndex) -> np.ndarray:
    """Return z of a query and all views of an index."""
    space = index.space
    return space.standardised((space.vectors(query[None]) @ space.vectors(index.views.descriptors).T)[0])


def written_out(
    z_of_each: list[np.ndarray], angles: list[float], views: Views, omega: float, gone: tuple[int, ...] = ()
) -> np.ndarray:
    """Return A_n(j, φ) by the z of each query and all views, computed object by object, bin by bin, view by view."""
    total = np.zeros((len(views.object_names), BINS))
    for j in range(len(views.object_names)):
        rows = [row for row in views.of(j) if row not in gone]
        for b in range(BINS):
            for z, angle in zip(z_of_each, angles, strict=True):
                best = -np.inf
                for k in rows:
                    others = [(views.azimuth_deg[i] - views.azimuth_deg[k]) % 360 for i in rows if i != k] or [360.0]
                    left, right = min(others) / 2, (360 - max(others)) / 2 if len(rows) > 1 else 180.0
                    rotated = (b * 5 + angle - angles[0] - views.azimuth_deg[k]) % 360
                    away = max(0.0, min(rotated - left, 360 - rotated - right))
                    best = max(best, float(z[k]) - omega * away / 360)
                total[j, b] += best
    return total


@examples(6)
@given(
    st.integers(0, 10**6),
    st.floats(0, 8),
    st.lists(st.floats(-720, 720), min_size=1, max_size=3),
)
@example(seed=432, omega=0.05, angles=[0.0])  # a gap, beside which the best view is up to 270° away
@example(seed=656, omega=0.0, angles=[0.0])  # all scores are 0
def test_support_follows_the_formula_at_every_azimuth_of_every_object(
    seed: int, omega: float, angles: list[float]
) -> None:
    views = catalog(seed, objects=3)
    queries = catalog(seed + 1, ragged=False).descriptors[: len(angles)]
    index = DenseIndex(views, omega=omega)
    belief = belief_after(queries, angles, index)
    wanted = written_out([z_of(query, index) for query in queries], angles, views, omega)
    np.testing.assert_allclose(belief.support, wanted, atol=1e-3)
    with without_library():
        np.testing.assert_allclose(belief_after(queries, angles, index).support, belief.support, atol=1e-4)
    ranking = belief.ranking()
    assert ranking.object_index[0] in np.flatnonzero(wanted.max(axis=1) >= wanted.max() - 1e-2)
    mean = np.maximum(index.space.similarity(wanted.max(axis=1) / len(angles)), 0)
    np.testing.assert_allclose(np.sort(ranking.scores), np.sort(mean), atol=1e-4)
    posterior = np.exp(BETA * (wanted - wanted.max()) / np.sqrt(len(angles)))
    np.testing.assert_allclose(belief.posterior, posterior / posterior.sum(), atol=1e-3)
    assert belief.likeliest() == (int(belief.probability().argmax()), belief.probability().max())


@given(st.integers(0, 10**6), st.integers(1, 5))
@examples(6)
def test_support_of_some_objects_does_not_depend_on_the_others(seed: int, count: int) -> None:
    views = catalog(seed, objects=6)
    index = DenseIndex(views)
    queries = catalog(seed + 1, ragged=False).descriptors[:2]
    places = np.sort(np.random.default_rng(seed).permutation(6)[:count])
    every = belief_after(queries, [0.0, 77.0], index)
    few = belief_after(queries, [0.0, 77.0], index.only(places))
    np.testing.assert_allclose(few.support, every.support[places], atol=1e-4)
    np.testing.assert_array_equal(few.index.object_index, places)


def test_weighted_frames_count_as_much_as_their_weights() -> None:
    index = DenseIndex(catalog(3))
    query = index.views.descriptors[0]
    once = update_belief(query, 0.0, index)
    twice = update_belief(query, 0.0, once, weight=0.5)
    np.testing.assert_allclose(twice.support, 1.5 * once.support, rtol=1e-5)
    assert (once.amount, twice.amount, twice.queries) == (1.0, 1.5, 2)
    third = update_belief(query, 0.0, twice)  # without a weight it counts as one
    assert (third.amount, third.queries) == (2.5, 3)
    np.testing.assert_allclose(third.support, 2.5 * once.support, rtol=1e-5)
    np.testing.assert_allclose(twice.scores(), once.scores(), rtol=1e-5)


def test_the_most_similar_segmentation_of_a_query_counts() -> None:
    index = DenseIndex(catalog(4, ragged=False))
    right, wrong = index.views.descriptors[[9, 20]]
    both = update_belief(np.stack([wrong, right]), 0.0, index).support
    each = [update_belief(one, 0.0, index).support for one in (right, wrong)]
    assert (both >= np.maximum(*each) - 1e-4).all()
    assert both[1].max() == pytest.approx(each[0][1].max(), rel=1e-4)


def test_left_out_view_does_not_count() -> None:
    views = catalog(5, ragged=False)
    index = DenseIndex(views)
    query = views.descriptors[11]
    fewer = update_belief(query, 0.0, index.without(np.array([11, 3])))
    again = written_out([z_of(query, index)], [0.0], views, OMEGA, gone=(11, 3))
    np.testing.assert_allclose(fewer.support, again, atol=1e-3)
    assert update_belief(query, 0.0, index).scores()[1] == pytest.approx(1, abs=1e-4)
    with pytest.raises(ValueError, match="without any view"):
        index.without(views.of(2))


def test_rotated_queries_agree_on_an_azimuth_between_the_bins() -> None:
    views = catalog(7, ragged=False)
    rows = views.of(2)
    belief = belief_after(views.descriptors[rows[[1, 3, 6]]], [10.0, 100.0, 235.0], DenseIndex(views))
    ranking = belief.ranking()
    assert ranking.object_index[0] == 2
    assert abs((azimuth_of(belief, 2) - views.azimuth_deg[rows[6]] + 180) % 360 - 180) < 2.5


def test_another_zero_of_the_orientations_changes_nothing() -> None:
    views = catalog(9)
    queries = catalog(10, ragged=False).descriptors[:3]
    index = DenseIndex(views)
    one = belief_after(queries, [0.0, 40.0, 170.0], index)
    other = belief_after(queries, [-300.0, -260.0, 230.0], index)
    np.testing.assert_allclose(one.support, other.support, atol=1e-4)


def test_invalid_query_is_rejected() -> None:
    index = DenseIndex(catalog(1))
    query = np.zeros(144, np.uint8)
    assert isinstance(update_belief(query, 0.0, index), Belief)
    with pytest.raises(ValueError, match="cedd has uint8 of"):
        update_belief(query[:100], 0.0, index)
    with pytest.raises(ValueError, match="finite angle"):
        update_belief(query, float("nan"), index)
    with pytest.raises(ValueError, match="enroll at least one object"):
        DenseIndex(Views.empty())
    with pytest.raises(ValueError, match="finite weight"):
        DenseIndex(catalog(1), omega=-1)


def test_index_of_another_process_has_the_same_space() -> None:
    index = DenseIndex(catalog(3))
    copied = pickle.loads(pickle.dumps(index))
    np.testing.assert_array_equal(copied.vectors, index.vectors)


def test_views_are_as_similar_among_each_other_as_in_the_space() -> None:
    index = DenseIndex(catalog(3, ragged=False))
    rows = np.array([[0, 3, 9], [8, 1, 1]])
    similar = index.among(rows)
    for group, own in zip(rows, similar, strict=True):
        z = np.array([z_of(index.views.descriptors[row], index)[group] for row in group])
        np.testing.assert_allclose(own, index.space.similarity(z), atol=1e-5)
    assert similar.max() == pytest.approx(1, abs=1e-4)


@examples(15)
@given(st.integers(0, 10**6), st.sampled_from([0.0, 5.0, 40.0]))
def test_nearest_view_is_that_of_a_search_among_all_views(seed: int, step_deg: float) -> None:
    views = catalog(seed)
    if step_deg:  # several views at one azimuth, and azimuths half-way between two
        views = replace(views, azimuth_deg=views.azimuth_deg // step_deg * step_deg)
    index, rng = DenseIndex(views), np.random.default_rng(seed)
    place = rng.integers(0, len(index), 5)
    at_deg = rng.uniform(-720, 720, (9, 5))
    at_deg[::2] = at_deg[::2] // 2.5 * 2.5
    rows, away_deg = index.nearest_view(place, at_deg)
    far_deg = size_deg(index.azimuth_deg[place] - at_deg[:, :, None])
    far_deg[:, index.left_out[place]] = np.inf
    np.testing.assert_array_equal(rows, index.rows[place, far_deg.argmin(axis=2)])
    np.testing.assert_array_equal(away_deg, far_deg.min(axis=2))
    with without_library():
        reference = index.nearest_view(place, at_deg)
    np.testing.assert_array_equal(rows, reference[0])
    np.testing.assert_array_equal(away_deg, reference[1])
