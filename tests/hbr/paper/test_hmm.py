"""The hidden Markov model over poses, against the sum over all paths of states."""

from itertools import product

import numpy as np
import pytest

import hbr
from hbr.paper.hmm import pose_belief


def shelf(*counts: int, seed: int = 1) -> hbr.Views:
    rng = np.random.default_rng(seed)
    objects = [
        hbr.Views.of_object(f"o{j}", rng.integers(0, 8, (n, 144), np.uint8), np.sort(rng.uniform(0, 360, n)))
        for j, n in enumerate(counts)
    ]
    return hbr.Views.concatenate(objects)


def by_enumeration(similar, orientation_deg, views, sigma_deg, temperature):
    """Return the probability of every last state: the sum over all paths of states of each object."""
    total = np.zeros(len(views))
    for j in range(len(views.object_names)):
        own = views.of(j)
        for path in product(own.tolist(), repeat=len(orientation_deg)):
            p = np.exp(similar[0, path[0]] / temperature) / len(own)
            for i in range(1, len(path)):
                rotation_deg = orientation_deg[i] - orientation_deg[i - 1]
                off_deg = views.azimuth_deg[own] - views.azimuth_deg[path[i - 1]] - rotation_deg
                revolutions = off_deg[:, None] + 360 * np.arange(-9, 10)
                density = np.exp(-0.5 * (revolutions / sigma_deg) ** 2).sum(axis=1)
                p *= density[own.tolist().index(path[i])] / density.sum()
                p *= np.exp(similar[i, path[i]] / temperature)
            total[path[-1]] += p
    return total / total.sum()


@pytest.mark.parametrize(("counts", "queries"), [((1,), 1), ((3, 4), 3), ((4, 4, 2), 4)])
@pytest.mark.parametrize("sigma_deg", [20.0, 90.0])
def test_belief_is_the_sum_over_all_paths(counts, queries, sigma_deg):
    views, rng = shelf(*counts), np.random.default_rng(2)
    similar, orientation_deg = rng.random((queries, len(views))), rng.uniform(-400, 400, queries)
    belief = pose_belief(similar, orientation_deg, views, sigma_deg=sigma_deg, temperature=0.1)
    expected = by_enumeration(similar, orientation_deg, views, sigma_deg, 0.1)
    np.testing.assert_allclose(np.exp(belief.log_state), expected, rtol=1e-9)
    objects, log_object, _ = belief.ranking()
    by_object = np.bincount(views.object_index, expected)
    np.testing.assert_allclose(np.exp(log_object), by_object[objects], rtol=1e-9)
    assert np.exp(log_object).sum() == pytest.approx(1, abs=1e-12)
    assert (np.diff(log_object) <= 0).all()


def test_a_rotation_of_all_angles_changes_nothing():
    views, rng = shelf(6, 6, 5), np.random.default_rng(3)
    similar, orientation_deg = rng.random((3, len(views))), np.array([0.0, 80.0, -35.0])
    rotated = hbr.Views.concatenate(
        [
            hbr.Views.of_object(name, views.descriptors[views.of(j)], (views.azimuth_deg[views.of(j)] + 77) % 360)
            for j, name in enumerate(views.object_names)
        ]
    )
    one = pose_belief(similar, orientation_deg, views)
    for zero_deg, known in ((123.0, views), (0.0, rotated)):
        other = pose_belief(similar, orientation_deg + zero_deg, known)
        np.testing.assert_allclose(other.log_state, one.log_state, atol=1e-6)
        assert other.next_rotation_deg() == one.next_rotation_deg()


def test_small_errors_and_impossible_rotations_stay_finite():
    views = shelf(3, 2)
    belief = pose_belief(np.zeros((3, 5)), [0, 180, 10], views, sigma_deg=0.01, temperature=1e-3)
    assert np.isfinite(belief.log_state).all()
    assert np.exp(belief.log_state).sum() == pytest.approx(1)


def test_next_view_is_where_twins_differ():
    azimuth_deg = np.arange(0, 360, 30.0)
    first = np.random.default_rng(4).integers(0, 8, (12, 144), np.uint8)
    second = first.copy()
    second[4] = 7 - second[4]  # they differ at 120° only
    views = hbr.Views.concatenate(
        [hbr.Views.of_object(name, levels, azimuth_deg) for name, levels in (("a", first), ("b", second))]
    )
    belief = pose_belief(hbr.tanimoto(first[1:2], views.descriptors), [0.0], views)
    assert np.exp(belief.ranking()[1]) == pytest.approx([0.5, 0.5])
    assert abs(belief.next_rotation_deg() - 90) < 15
    views_seen = np.stack([first[1], first[4]])
    after = pose_belief(hbr.tanimoto(views_seen, views.descriptors), [0.0, 90.0], views)
    objects, log_object, pose_deg = after.ranking()
    assert (objects[0], pose_deg[0]) == (0, 120)
    assert np.exp(log_object[0]) > 0.99


@pytest.mark.parametrize(
    ("similar", "orientation_deg", "settings"),
    [
        (np.zeros((1, 4)), [0.0], {}),
        (np.zeros((0, 5)), [], {}),
        (np.full((1, 5), np.nan), [0.0], {}),
        (np.zeros((1, 5)), [np.inf], {}),
        (np.zeros((1, 5)), [0.0], {"sigma_deg": 0.0}),
        (np.zeros((1, 5)), [0.0], {"temperature": -1.0}),
    ],
)
def test_invalid_arguments_are_errors(similar, orientation_deg, settings):
    with pytest.raises(ValueError, match=r"similarit|orientation|sigma_deg"):
        pose_belief(similar, orientation_deg, shelf(3, 2), **settings)
