"""The pose of a found object: uncertainty and symmetry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr import DenseIndex, Views
from hbr.core.angles import wrap180
from hbr.dense.filter import LARGEST_SIGMA_DEG, pose, pose_of
from tests.hbr.dense.searches import belief_after

AZIMUTHS_DEG = np.arange(72) * 5.0


def lobes(order: int, width_deg: float, at_deg: float = 0.0) -> np.ndarray:
    """Return a posterior with ``order`` equal parts."""
    away_deg = np.asarray(wrap180((AZIMUTHS_DEG - at_deg) * order)) / order
    p = np.exp(-0.5 * (away_deg / width_deg) ** 2)
    return p / p.sum()


@given(order=st.integers(1, 6), at_deg=st.floats(0, 359))
def test_poses_are_a_period_apart(order: int, at_deg: float) -> None:
    found = pose_of(lobes(order, 5.0, at_deg), at_deg, at_deg)
    assert found.period_deg == pytest.approx(360 / order)
    assert found.azimuth_deg[0] == pytest.approx(at_deg)
    assert len(found.azimuth_deg) == order
    assert found.sigma_deg is not None
    assert 1 < found.sigma_deg < 8
    for azimuth_deg in found.azimuth_deg:
        assert abs(wrap180((azimuth_deg - at_deg) * order)) < 1e-6


def test_wider_posteriors_have_larger_uncertainties() -> None:
    sigmas = [pose_of(lobes(1, width_deg), 0.0, 0.0).sigma_deg for width_deg in (5.0, 10.0, 20.0)]
    assert sigmas == sorted(sigmas, key=float)
    assert pose_of(lobes(1, 3 * LARGEST_SIGMA_DEG), 0.0, 0.0).sigma_deg is None


def test_pose_of_a_round_object_is_free() -> None:
    found = pose_of(np.full(72, 1 / 72), 10.0, 10.0)
    assert (found.azimuth_deg, found.sigma_deg, found.period_deg) == ((), None, 0.0)


def test_unequal_parts_are_no_symmetry() -> None:
    found = pose_of(0.85 * lobes(1, 5.0) + 0.15 * lobes(1, 5.0, 100.0), 0.0, 0.0)
    assert (found.azimuth_deg, found.sigma_deg, found.period_deg) == ((), None, None)


def ring(period: int, seed: int) -> np.ndarray:
    """Return descriptors, uint8 (36, 144), that change smoothly around an object and repeat after ``period`` views."""
    keys = np.random.default_rng(seed).integers(0, 8, (period, 144)).astype(float)
    smooth = sum(np.roll(keys, shift, axis=0) for shift in range(-3, 4)) / 7
    return np.tile(np.rint(smooth).astype(np.uint8), (36 // period, 1))


@pytest.mark.parametrize(("period", "period_deg"), [(36, 360.0), (18, 180.0), (9, 90.0), (1, 0.0)])
def test_symmetry_is_reported_with_the_answer(period: int, period_deg: float) -> None:
    azimuth_deg = np.arange(36) * 10.0
    objects = [
        Views.of_object(name, ring(size, seed), azimuth_deg) for name, size, seed in (("a", period, 1), ("b", 36, 2))
    ]
    views = Views.concatenate(objects)
    found = pose(belief_after(views.descriptors[[4, 9]], (40.0, 90.0), DenseIndex(views)), 0)
    assert found.period_deg == period_deg
    if period_deg:
        assert found.sigma_deg is not None
        assert (
            abs(float(wrap180((found.azimuth_deg[0] - 90.0) * 360 / period_deg))) * period_deg / 360
            < 2 * found.sigma_deg
        )
