"""Table angles within the cable budget, and the duration of an enrollment."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr.core.angles import wrap180, wrap360
from rig.catalog import Catalog
from rig.config import load_config
from rig.core.errors import LimitExceeded
from rig.core.next_steps import Do
from rig.events.events import Accepted, Enrolled, Started
from rig.motion.move import MotionTimes
from rig.motion.turntable import Turntable
from rig.plans.enroll import enroll
from rig.plans.estimate import even_azimuths, table_angles
from tests.rig.bench_parts import motion_bench

LIMITS = st.floats(-2000, 0).flatmap(
    lambda low: st.tuples(st.just(low), st.floats(0.0, 200.0) | st.floats(max(0.0, low + 360.0), low + 4000.0))
)


@given(views=st.integers(4, 720), limits=LIMITS, sign=st.sampled_from([1, -1]))
def test_table_angles_rise_within_every_cable_budget(views, limits, sign):
    (low, high), step = limits, 360.0 / views
    azimuths = even_azimuths(views, limits, sign)
    angles = table_angles(azimuths, limits, sign)
    assert len(angles) == len(set(azimuths))
    assert len(angles) == views if high - low >= 360.0 else len(angles) >= min(views, (high - low) / step - 1)
    assert all(low - 1e-5 <= angle <= high + 1e-5 for angle in angles)
    for before, after in pairwise(angles):
        assert after - before == pytest.approx(step)
    for azimuth, angle in zip(azimuths, angles, strict=True):
        assert wrap180(azimuth - sign * angle) == pytest.approx(0.0, abs=1e-6)


def test_table_starts_at_zero_if_the_cable_allows_it():
    assert table_angles(even_azimuths(4, (-400, 400)), (-400, 400)) == (0.0, 90.0, 180.0, 270.0)


def test_plan_of_another_bench_is_shifted_by_revolutions_or_rejected():
    elsewhere = [float(wrap360(-angle)) for angle in range(-180, 180, 90)]
    assert table_angles(elsewhere, (-400, 400)) == (-180.0, -90.0, 0.0, 90.0)
    with pytest.raises(LimitExceeded) as caught:
        table_angles(even_azimuths(72, (-400, 400)), (-180, 185))
    assert Do.ENROLL_AGAIN() in caught.value.steps


@pytest.mark.parametrize("views", [8, pytest.param(36, marks=pytest.mark.nightly)])
def test_motion_model_predicts_the_duration_within_10_percent(simulated, tmp_path, views):
    s = simulated(seed=3)
    with Catalog.open(tmp_path, clock=s.bench.clock) as catalog:
        model = MotionTimes(s.bench.config)
        angles_deg = table_angles(even_azimuths(views, (-400, 400)), (-400, 400))
        predicted: list[tuple[int, float]] = []
        for event in enroll(s.bench, catalog, "dice", views=views):
            if isinstance(event, Started):
                assert event.angles_deg == angles_deg
                start_ns = s.bench.clock.now_ns()
            if isinstance(event, Accepted):
                predicted.append((s.bench.clock.now_ns(), model.left_s(angles_deg, len(predicted) + 1)))
    end_ns = s.bench.clock.now_ns()
    duration_s = (end_ns - start_ns) * 1e-9
    assert isinstance(event, Enrolled)
    assert model.enrollment_s(0.0, angles_deg) == pytest.approx(duration_s, rel=0.1)
    for now_ns, seconds in predicted:
        assert seconds == pytest.approx((end_ns - now_ns) * 1e-9, rel=0.1, abs=1.5)


@pytest.mark.parametrize("quiet_s", [0.05, 0.12, 0.6])
def test_move_is_estimated_with_the_time_in_which_the_table_must_be_quiet(quiet_s):
    with motion_bench(f"table.quiet_s={quiet_s}") as (bench, _), Turntable(bench) as table:
        table.goto(10.0)
        assert MotionTimes(bench.config).move_s(90.0) == pytest.approx(table.goto(100.0).seconds, abs=0.1)


def test_downward_moves_take_longer():
    model = MotionTimes(load_config())
    assert model.move_s(-90) > model.move_s(90) > model.move_s(10)
    assert model.enrollment_s(0.0, ()) == 0.0
