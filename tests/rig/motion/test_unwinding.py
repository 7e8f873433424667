"""The cable budget in the plans: moves stay within it, unwinding is announced, and the cable is unwound at the end."""

from itertools import pairwise

import pytest

from rig.catalog import Catalog, derived
from rig.core.errors import Stalled
from rig.events.events import Accepted, Enrolled, Identified, Moved, Unwinding
from rig.motion.turntable import Turntable
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from rig.search.model import model_of

VIEWS = 6


@pytest.fixture
def catalog(tmp_path, simulated):
    with Catalog.open(tmp_path / "catalog", clock=simulated().bench.clock) as catalog:
        yield catalog


@pytest.mark.parametrize(
    "limits", ["[-300, 60]", *(pytest.param(one, marks=pytest.mark.nightly) for one in ("[-400, 400]", "[0, 360]"))]
)
def test_enrollment_stays_within_the_budget_and_unwinds_the_cable(simulated, catalog, limits):
    s = simulated(f"table.limits_deg={limits}")
    low, high = s.bench.config.table.limits_deg
    events = list(enroll(s.bench, catalog, "toy-car", views=VIEWS))
    assert isinstance(events[-1], Enrolled)
    moves = [e for e in events if isinstance(e, Moved)]
    assert all(low <= move.commanded_deg <= high for move in moves)
    assert sorted({round(e.azimuth_deg) % 360 for e in events if isinstance(e, Accepted)}) == list(range(0, 360, 60))
    behind_deg = s.operator.devices.servo.motor.held_deg + s.world.noise.backlash_deg / 2
    # With 0 as its lowest angle, the table cannot approach it from below: it is held above it.
    assert s.world.table_deg() == pytest.approx(-behind_deg if low < 0 else behind_deg, abs=0.3)
    for event, following in pairwise(events):
        if isinstance(event, Unwinding):
            assert abs(event.to_deg) < abs(event.from_deg)
            assert event.revolutions == 1
            assert event.limits_deg == (low, high)
            if isinstance(following, Moved):
                assert following.commanded_deg == event.to_deg


@pytest.mark.parametrize(
    ("start_deg", "step_deg", "rotates_to"),
    [
        (390.0, -90, [120.0]),
        pytest.param(30.0, 90, [], marks=pytest.mark.nightly),
        pytest.param(-395.0, 90, [-125.0], marks=pytest.mark.nightly),
        pytest.param(250.0, 5, [-115.0], marks=pytest.mark.nightly),
    ],
)
def test_search_unwinds_when_necessary_and_reports_it(simulated, catalog, start_deg, step_deg, rotates_to):
    s = simulated("identify.max_views=2", f"identify.first_step_deg={step_deg}", seed=3)
    list(enroll(s.bench, catalog, "toy-car", views=VIEWS))
    with Turntable(s.bench) as table:
        table.goto(start_deg)
    s.operator.next_object = "toy-car"
    events = list(identify(s.bench, model_of(derived.views(catalog))))
    assert isinstance(events[-1], Identified)
    held_deg = s.operator.devices.servo.motor.held_deg
    unwound_deg = [e.to_deg for e in events if isinstance(e, Unwinding)]
    # The search rotates from the measured angle of its view, so each of its moves before adds what it is held short.
    held_deg *= 2 if step_deg == 5 else 1
    assert unwound_deg == pytest.approx([angle - held_deg for angle in rotates_to], abs=0.3)
    assert abs(s.world.table_deg()) <= 180
    low, high = s.bench.config.table.limits_deg
    assert all(low <= e.commanded_deg <= high for e in events if isinstance(e, Moved))


def test_answer_is_reported_although_the_cable_cannot_be_unwound(simulated, catalog):
    s = simulated("identify.max_views=2", seed=3)
    list(enroll(s.bench, catalog, "toy-car", views=VIEWS))
    with Turntable(s.bench) as table:
        table.goto(300.0)
    s.operator.next_object = "toy-car"
    events = []
    with pytest.raises(Stalled):
        for event in identify(s.bench, model_of(derived.views(catalog))):
            events.append(event)
            if isinstance(event, Unwinding):
                s.operator.devices.servo.jam()
    assert isinstance(events[-1], Identified)
    assert events[-1].candidates[0].name == "toy-car"
    assert s.bench.safety.fault.code == Stalled.code
