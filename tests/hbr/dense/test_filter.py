"""The dense Hough filter against its formula written out."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hbr import DenseIndex, Views, tanimoto, update_belief
from hbr.core.angles import size_deg
from hbr.dense.filter import Belief, completed
from hbr.dense.index import BINS
from hbr.dense.pose import poses_of
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


def written_out(queries: np.ndarray, angles: list[float], views: Views, omega: float) -> np.ndarray:
    """Return A_n(j, φ), computed object by object, bin by bin, view by view."""
    total = np.zeros((len(views.object_names), BINS))
    for j in range(len(views.object_names)):
        rows = views.of(j)
        for b in range(BINS):
            for query, angle in zip(queries, angles, strict=True):
                best = -np.inf
                for k in rows:
                    others = [(views.azimuth_deg[i] - views.azimuth_deg[k]) % 360 for i in rows if i != k] or [360.0]
                    left, right = min(others) / 2, (360 - max(others)) / 2 if len(rows) > 1 else 180.0
                    rotated = (b * 5 + angle - angles[0] - views.azimuth_deg[k]) % 360
                    away = max(0.0, min(rotated - left, 360 - rotated - right))
                    similar = float(tanimoto(query, views.descriptors[k])[0, 0])
                    best = max(best, similar**4 - omega * away / 360)
                total[j, b] += best
    return total


@examples(6)
@given(
    st.integers(0, 10**6),
    st.floats(0, 8),
    st.lists(st.floats(-720, 720), min_size=1, max_size=3),
)
@example(seed=432, omega=0.05, angles=[0.0])  # a gap, beside which the best view is up to 270° away
def test_support_follows_the_formula_at_every_azimuth_of_every_object(
    seed: int, omega: float, angles: list[float]
) -> None:
    views = catalog(seed, objects=3)
    queries = catalog(seed + 1, ragged=False).descriptors[: len(angles)]
    belief = belief_after(queries, angles, DenseIndex(views, omega=omega))
    wanted = written_out(queries, angles, views, omega)
    np.testing.assert_allclose(belief.support, wanted, atol=2e-5)
    ranking = belief.ranking()
    assert ranking.object_index[0] in np.flatnonzero(wanted.max(axis=1) >= wanted.max() - 1e-4)
    mean = np.maximum(wanted.max(axis=1), 0) / len(angles)
    np.testing.assert_allclose(np.sort(ranking.scores) ** 4, np.sort(mean), atol=2e-5)
    assert belief.posterior(30.0).sum() == pytest.approx(1)


@given(st.integers(0, 10**6), st.integers(2, 5))
@examples(6)
def test_no_object_that_can_lead_or_be_second_is_lost(seed: int, queries: int) -> None:
    """Only one object is considered after the first view; the others come back if they can still win."""
    views = catalog(seed, objects=12)
    index = DenseIndex(views)
    seen, angles = list(catalog(seed + 1, ragged=False).descriptors[:queries]), [50.0 * n for n in range(queries)]
    every = belief_after(seen, angles, index)
    few: DenseIndex | Belief = index
    for query, angle in zip(seen, angles, strict=True):
        few = update_belief(query, angle, few, kept=1)
    assert isinstance(few, Belief)
    assert len(few.index) == 1
    found, whole = completed(few, index).ranking(), every.ranking()
    np.testing.assert_array_equal(found.object_index[:2], whole.object_index[:2])
    np.testing.assert_array_equal(found.scores[:2], whole.scores[:2])


@given(st.integers(0, 10**6), st.integers(1, 3))
@example(seed=2756, kept=1)  # three views within 5°: the most similar one is the nearest view at no azimuth of a bin
@examples(6)
def test_kept_objects_have_the_most_similar_views_and_their_support_does_not_change(seed: int, kept: int) -> None:
    views = catalog(seed, objects=6)
    index = DenseIndex(views)
    queries = catalog(seed + 1, ragged=False).descriptors[:2]
    every = update_belief(queries[0], 0.0, index)
    few = update_belief(queries[0], 0.0, index, kept=kept)
    similar = [tanimoto(queries[0], views.descriptors[views.of(j)]).max() for j in range(6)]
    nearest = np.sort(np.argsort(-np.array(similar), kind="stable")[:kept])
    np.testing.assert_array_equal(few.support, every.support[nearest])
    np.testing.assert_array_equal(few.index.object_index, nearest)
    later, whole = update_belief(queries[1], 77.0, few), update_belief(queries[1], 77.0, every)
    np.testing.assert_array_equal(later.support, whole.support[nearest])


def test_left_out_view_does_not_count() -> None:
    views = catalog(5, ragged=False)
    index = DenseIndex(views)
    query = views.descriptors[11]
    gone = np.array([11, 3])
    fewer = update_belief(query, 0.0, index.without(gone))
    again = written_out(query[None], [0.0], views.select(np.setdiff1d(np.arange(len(views)), gone)), 2.0)
    np.testing.assert_allclose(fewer.support, again, atol=2e-5)
    assert update_belief(query, 0.0, index).scores()[1] == pytest.approx(1)
    with pytest.raises(ValueError, match="without any view"):
        index.without(views.of(2))


def test_rotated_queries_agree_on_an_azimuth_between_the_bins() -> None:
    views = catalog(7, ragged=False)
    rows = views.of(2)
    belief = belief_after(views.descriptors[rows[[1, 3, 6]]], [10.0, 100.0, 235.0], DenseIndex(views))
    ranking = belief.ranking()
    assert ranking.object_index[0] == 2
    assert abs((poses_of(belief, 2)[0] - views.azimuth_deg[rows[6]] + 180) % 360 - 180) < 2.5


def test_another_zero_of_the_orientations_changes_nothing() -> None:
    views = catalog(9)
    queries = catalog(10, ragged=False).descriptors[:3]
    index = DenseIndex(views)
    one = belief_after(queries, [0.0, 40.0, 170.0], index)
    other = belief_after(queries, [-300.0, -260.0, 230.0], index)
    np.testing.assert_allclose(one.support, other.support, atol=1e-6)


def test_invalid_query_is_rejected() -> None:
    index = DenseIndex(catalog(1))
    query = np.zeros(144, np.uint8)
    assert isinstance(update_belief(query, 0.0, index), Belief)
    with pytest.raises(ValueError, match="cedd has uint8 of"):
        update_belief(query[:100], 0.0, index)
    with pytest.raises(ValueError, match="finite angle"):
        update_belief(query, float("nan"), index)
    with pytest.raises(ValueError, match="kept is 0"):
        update_belief(query, 0.0, index, kept=0)
    with pytest.raises(ValueError, match="enroll at least one object"):
        DenseIndex(Views.empty())


def test_index_of_another_process_whitens_in_the_same_way() -> None:
    index = DenseIndex(catalog(3))
    copied = pickle.loads(pickle.dumps(index))
    np.testing.assert_array_equal(
        copied.whitening.unit(index.views.descriptors[:5]), index.whitening.unit(index.views.descriptors[:5])
    )


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
