"""The pose of a found object: azimuths between enrolled views, uncertainty and symmetry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr import DenseIndex, Views, update_belief
from hbr.core.angles import wrap180
from hbr.dense.pose import Pose, azimuth_of, pose, pose_of
from tests.hbr.dense.searches import belief_after, catalog

AZIMUTHS_DEG = np.arange(360.0)
#: Of no other azimuth.
NONE = 1e-12


def lobes(order: int, width_deg: float, at_deg: float = 0.0) -> np.ndarray:
    """Return a distribution of azimuths with ``order`` equal parts."""
    away_deg = np.asarray(wrap180((AZIMUTHS_DEG - at_deg) * order)) / order
    p = np.exp(-0.5 * (away_deg / width_deg) ** 2)
    return p / p.sum() + NONE


@given(order=st.integers(1, 6), at_deg=st.floats(0, 359))
def test_poses_are_a_period_apart(order: int, at_deg: float) -> None:
    found = pose_of(np.log(lobes(order, 3.0, at_deg)))
    assert found.period_deg == pytest.approx(360 / order)
    assert len(found.azimuth_deg) == order
    assert found.sigma_deg is not None
    assert 1 < found.sigma_deg < 4
    for azimuth_deg in found.azimuth_deg:
        assert abs(wrap180((azimuth_deg - at_deg) * order)) < 0.5


def test_wider_distributions_have_larger_uncertainties() -> None:
    sigmas = [pose_of(np.log(lobes(1, width_deg))).sigma_deg for width_deg in (5.0, 10.0, 20.0)]
    assert sigmas == sorted(sigmas, key=float)
    assert pose_of(np.log(lobes(1, 90.0))).sigma_deg is None


def test_pose_of_a_round_object_is_free() -> None:
    assert pose_of(np.zeros(360)) == Pose((), None, 0.0)


def test_unequal_parts_are_no_symmetry() -> None:
    found = pose_of(np.log(0.85 * lobes(1, 5.0) + 0.15 * lobes(1, 5.0, 100.0)))
    assert found == Pose((), None, None)


def among_others(views: Views) -> DenseIndex:
    """Return an index of an object, and others that change as much: they show what distinguishes views of one."""
    return DenseIndex(Views.concatenate([views, catalog(8, kind="cedd")]))


def ring(period: int, seed: int) -> np.ndarray:
    """Return descriptors, uint8 (36, 144), that change smoothly around an object and repeat after ``period`` views."""
    keys = np.random.default_rng(seed).integers(0, 8, (period, 144)).astype(float)
    smooth = sum(np.roll(keys, shift, axis=0) for shift in range(-3, 4)) / 7
    return np.tile(np.rint(smooth).astype(np.uint8), (36 // period, 1))


@pytest.mark.parametrize(("period", "period_deg"), [(36, 360.0), (18, 180.0), (1, 0.0)])
def test_symmetry_is_reported_with_the_answer(period: int, period_deg: float) -> None:
    azimuth_deg = np.arange(36) * 10.0
    views = Views.of_object("a", ring(period, 1), azimuth_deg)
    found = pose(belief_after(views.descriptors[[4, 9]], (40.0, 90.0), among_others(views)), 0)
    assert found.period_deg == period_deg
    if period_deg:
        assert found.sigma_deg is not None
        assert (
            abs(float(wrap180((found.azimuth_deg[0] - 90.0) * 360 / period_deg))) * period_deg / 360
            < 2 * found.sigma_deg
        )


def turntable(step_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuths, and descriptors, uint8 (n, 144), of waves that move around an object as it rotates."""
    azimuth_deg = np.arange(0, 360, step_deg)
    wave, phase = np.random.default_rng(3).uniform([[0.5], [0]], [[2.4], [360]], (2, 144))
    levels = 3.5 + 3.5 * np.cos(np.deg2rad(np.rint(wave) * azimuth_deg[:, None] + phase))
    return azimuth_deg, np.rint(levels).astype(np.uint8)


@pytest.mark.parametrize("step_deg", [10.0, 20.0, 45.0])
@pytest.mark.parametrize("share", [0.0, 0.2, 0.4, 0.5, 0.7])
def test_azimuths_between_enrolled_views_are_estimated(step_deg: float, share: float) -> None:
    azimuth_deg, levels = turntable(step_deg)
    index = among_others(Views.of_object("waves", levels, azimuth_deg))
    true_deg = azimuth_deg[2] + share * step_deg
    seen_deg, seen = turntable(0.5)
    query = seen[int(np.abs(seen_deg - true_deg).argmin())]
    belief = update_belief(query, 0.0, index)
    found = pose(belief, 0)
    assert found.sigma_deg is not None
    assert abs(found.azimuth_deg[0] - true_deg) < min(0.1 * step_deg, 2 * found.sigma_deg + 0.5)
    assert azimuth_of(belief, 0) == found.azimuth_deg[0]


def test_a_changed_bench_makes_a_pose_less_certain() -> None:
    azimuth_deg, levels = turntable(10.0)
    index = among_others(Views.of_object("waves", levels, azimuth_deg))
    rng = np.random.default_rng(1)
    changed = np.where(rng.random(144) < 0.25, rng.integers(0, 8, 144), levels[7]).astype(np.uint8)
    same, other = (pose(update_belief(query, 0.0, index), 0).sigma_deg for query in (levels[7], changed))
    assert same is not None
    assert other is not None
    assert other > 1.2 * same


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_few_views_determine_no_wrong_pose(count: int) -> None:
    azimuth_deg, levels = turntable(360 / count)
    seen_deg, seen = turntable(1.0)
    index = among_others(Views.of_object("waves", levels, azimuth_deg))
    for place in range(0, 360, 17):
        found = pose(update_belief(seen[place], 0.0, index), 0)
        if found.sigma_deg is not None:
            assert abs(wrap180(found.azimuth_deg[0] - seen_deg[place])) < 0.25 * 360 / count
