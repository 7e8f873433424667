"""The hidden Markov model over poses, against sums over all paths of states and over all pairs of states."""

from itertools import product

import numpy as np
import pytest

import hbr
from hbr.paper.hmm import CONFIDENT, PoseBelief, PoseModel, update_poses


def shelf(*counts: int, seed: int = 1) -> hbr.Views:
    rng = np.random.default_rng(seed)
    objects = [
        hbr.Views.of_object(f"o{j}", rng.integers(0, 8, (n, 144), np.uint8), np.sort(rng.uniform(0, 360, n)))
        for j, n in enumerate(counts)
    ]
    return hbr.Views.concatenate(objects)


def pose_belief(similar, orientation_deg, views, **settings) -> PoseBelief:
    so_far = PoseModel(views, **settings)
    for query, one_deg in zip(similar, orientation_deg, strict=True):
        so_far = update_poses(query, one_deg, so_far)
    assert isinstance(so_far, PoseBelief)
    return so_far


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
                density = np.exp(np.cos(np.deg2rad(off_deg)) / np.deg2rad(sigma_deg) ** 2)
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
        assert other.next_view().rotation_deg == one.next_view().rotation_deg


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
    assert abs(belief.next_view().rotation_deg - 90) <= 15  # the enrolled view at 120° is the nearest
    views_seen = np.stack([first[1], first[4]])
    after = pose_belief(hbr.tanimoto(views_seen, views.descriptors), [0.0, 90.0], views)
    objects, log_object, pose_deg = after.ranking()
    assert (objects[0], pose_deg[0]) == (0, 120)
    assert np.exp(log_object[0]) > 0.99


@pytest.mark.parametrize(
    ("similar", "orientation_deg", "settings"),
    [
        (np.zeros((1, 4)), [0.0], {}),
        (np.full((1, 5), np.nan), [0.0], {}),
        (np.zeros((1, 5)), [np.inf], {}),
        (np.zeros((1, 5)), [0.0], {"sigma_deg": 0.0}),
        (np.zeros((1, 5)), [0.0], {"temperature": -1.0}),
    ],
)
def test_invalid_arguments_are_errors(similar, orientation_deg, settings):
    with pytest.raises(ValueError, match=r"similarit|orientation|sigma_deg"):
        pose_belief(similar, orientation_deg, shelf(3, 2), **settings)


def risk_by_enumeration(belief, rotation_deg, temperature):
    """Return the expected probability of all wrong objects: a sum over all pairs of a true and another state."""
    views, p = belief.model.views, np.exp(belief.log_state)
    total = 0.0
    for true in range(len(views)):
        own = views.of(int(views.object_index[true]))
        after_deg = views.azimuth_deg[true] + rotation_deg
        away_deg = [abs((views.azimuth_deg[one] - after_deg + 180) % 360 - 180) for one in own]
        view = views.descriptors[own[int(np.argmin(away_deg))]]
        right = wrong = 0.0
        for other in range(len(views)):
            rows = views.of(int(views.object_index[other]))
            after_deg = views.azimuth_deg[other] + rotation_deg
            away_deg = [abs((views.azimuth_deg[one] - after_deg + 180) % 360 - 180) for one in rows]
            expected = views.descriptors[rows[int(np.argmin(away_deg))]]
            share = p[other] * np.exp(hbr.tanimoto(view[None], expected[None])[0, 0] / temperature)
            if views.object_index[other] == views.object_index[true]:
                right += share
            else:
                wrong += share
        total += p[true] * wrong / (right + wrong)
    return total


@pytest.mark.parametrize(
    ("counts", "temperature"), [((4, 5), 0.3), pytest.param((7, 6, 8), 0.1, marks=pytest.mark.nightly), ((3,), 0.1)]
)
def test_risk_is_the_expected_probability_of_all_wrong_objects(counts, temperature):
    views, rng = shelf(*counts), np.random.default_rng(5)
    similar = 0.1 * rng.random((2, len(views)))
    belief = pose_belief(similar, [10.0, 75.0], views, temperature=temperature, sigma_deg=30.0)
    chosen = belief.next_view()
    expected = [risk_by_enumeration(belief, one, temperature) for one in chosen.rotations_deg.tolist()]
    np.testing.assert_allclose(chosen.risk, expected, rtol=1e-9, atol=1e-12)
    assert len(counts) == 1 or min(expected) > 1e-3


def test_of_hardly_different_risks_the_farthest_from_all_views_is_chosen():
    views = shelf(4, 4, 4)
    sure = np.where(views.object_index == 0, 2.0, 0.0)
    one = pose_belief([sure], [20.0], views, temperature=0.3)
    chosen = one.next_view()
    assert 1e-6 < chosen.risk.max() < 1 - CONFIDENT
    assert chosen.risk.min() < 0.9 * chosen.risk[chosen.rotations_deg == 180]
    assert chosen.rotation_deg == 180
    assert update_poses(sure, 200.0, one).next_view().rotation_deg == 90  # as far as -90: the one to the left
    third = update_poses(sure, 290.0, update_poses(sure, 200.0, one))
    assert third.next_view().rotation_deg == 180  # 110°, between the views at 20° and 200°


def test_a_risk_that_is_lower_by_more_than_the_error_of_an_end_decides():
    azimuth_deg = np.arange(0, 360, 45.0)
    first = np.random.default_rng(6).integers(0, 8, (8, 144), np.uint8)
    second = first.copy()
    second[1] = 7 - second[1]  # the twins differ at 45° only, which is near to the first view
    views = hbr.Views.concatenate(
        [hbr.Views.of_object(name, levels, azimuth_deg) for name, levels in (("a", first), ("b", second))]
    )
    chosen = pose_belief(hbr.tanimoto(first[:1], views.descriptors), [0.0], views).next_view([45.0, 180.0, -90.0])
    np.testing.assert_allclose(chosen.risk, [0.0, 0.5, 0.5], atol=1e-6)
    assert chosen.rotation_deg == 45


def test_only_possible_and_new_rotations_are_weighed():
    belief = pose_belief(np.zeros((2, 7)), [0.0, 40.0], shelf(4, 3))
    assert belief.next_view([5.0, -35.0, 60.0, -45.0]).rotations_deg.tolist() == [60.0]
    assert belief.next_view([5.0, -45.0]).rotations_deg.tolist() == [5.0, -45.0]  # none is new
