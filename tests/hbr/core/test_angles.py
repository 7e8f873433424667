import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr.core.angles import revolutions_between, wrap180, wrap360

angle = st.floats(-1e6, 1e6)


@pytest.mark.parametrize(
    ("angle_deg", "in_360", "in_180"),
    [(0, 0, 0), (360, 0, 0), (-90, 270, -90), (180, 180, -180), (-180, 180, -180), (725, 5, 5), (179.5, 179.5, 179.5)],
)
def test_known_angles_are_wrapped(angle_deg: float, in_360: float, in_180: float) -> None:
    assert wrap360(float(angle_deg)) == in_360
    assert wrap180(float(angle_deg)) == in_180


@given(angle)
def test_wrapped_angles_stay_in_range_and_in_direction(angle_deg: float) -> None:
    for wrapped, low, high in ((wrap360(angle_deg), 0, 360), (wrap180(angle_deg), -180, 180)):
        assert low <= wrapped < high
        revolutions = (wrapped - angle_deg) / 360
        assert revolutions == pytest.approx(round(revolutions), abs=1e-9)


@pytest.mark.parametrize("tiny", [-5e-324, -1e-300, -1e-17, -0.0])
def test_tiny_negative_angle_does_not_wrap_to_360(tiny: float) -> None:
    assert wrap360(tiny) == 0.0
    assert wrap180(-180.0 + tiny) == -180.0


@given(angle, angle)
def test_revolutions_between_is_a_symmetric_distance(a_deg: float, b_deg: float) -> None:
    revolutions = revolutions_between(a_deg, b_deg)
    assert 0 <= revolutions <= 0.5
    assert revolutions == pytest.approx(revolutions_between(b_deg, a_deg), abs=1e-9)
    assert math.cos(2 * math.pi * revolutions) == pytest.approx(math.cos(math.radians(a_deg - b_deg)), abs=1e-6)


def test_arrays_return_arrays_and_floats_return_floats() -> None:
    angles = np.array([-90.0, 370.0])
    assert wrap360(angles).tolist() == [270.0, 10.0]
    assert wrap180(angles).tolist() == [-90.0, 10.0]
    assert revolutions_between(angles, 0.0).tolist() == [0.25, 10 / 360]
    assert type(wrap360(1.0)) is type(wrap180(1.0)) is type(revolutions_between(1.0, 2.0)) is float


@given(st.lists(st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)), min_size=1, max_size=20))
def test_arrays_and_numbers_have_equal_distances(pairs: list[tuple[float, float]]) -> None:
    a, b = np.array(pairs).T
    expected = [revolutions_between(x, y) for x, y in pairs]
    assert revolutions_between(a, b) == pytest.approx(np.array(expected), abs=1e-9)
