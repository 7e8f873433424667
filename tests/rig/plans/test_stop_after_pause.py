"""An enrollment that was paused and then stopped: cable budget, torque, stored angle, and how it continues.

The plan pauses while its consumer does not ask for the next event. `tests/rig/search/test_arc_search.py` has the same
for a search in motion, `tests/rig/cli/ui/test_live.py` Ctrl+Z at the terminal.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rig import enroll
from rig.core.errors import MotionStopped
from rig.devices.servo import ServoState
from rig.events.events import Accepted, Enrolled, Event, ScanStarted
from rig.safety.saved_state import FileStore
from sim.bench import ShelfOperator
from tests.rig.bench_parts import LAG_S
from tests.rig.plans.test_fly import FAST, flying

BUDGET_DEG = (-4.0, 361.0)
"""A revolution upwards, and the approach from below."""
VIEWS = 6
REACTION_S = 0.15
"""Time from a request until the ramp begins: rounds of the control loop, and two readings that agree."""


def case(*values: object, nightly: bool = False) -> Any:
    *parameters, name = values
    marks = [pytest.mark.nightly] if nightly else []
    return pytest.param(*parameters, id=f"{name}-{parameters[-1]}", marks=marks)


def scan_started(event: Event) -> bool:
    return isinstance(event, ScanStarted)


def accepted(index: int) -> Callable[[Event], bool]:
    return lambda event: isinstance(event, Accepted) and event.index == index


@pytest.mark.parametrize(
    ("fly", "pauses_at", "stops_at_deg", "how"),
    [
        case(False, accepted(2), None, "rig stop", "at-rest-in-the-pause"),
        case(False, accepted(2), None, "Ctrl+C", "at-rest-in-the-pause", nightly=True),
        case(False, accepted(2), 150.0, "rig stop", "at-rest-in-the-next-rotation", nightly=True),
        case(False, accepted(2), 150.0, "Ctrl+C", "at-rest-in-the-next-rotation"),
        case(True, accepted(1), None, "rig stop", "after-the-revolution-in-the-pause"),
        case(True, accepted(1), None, "Ctrl+C", "after-the-revolution-in-the-pause", nightly=True),
        case(True, accepted(VIEWS - 1), 200.0, "rig stop", "after-the-revolution-on-the-way-home", nightly=True),
        case(True, accepted(VIEWS - 1), 200.0, "Ctrl+C", "after-the-revolution-on-the-way-home", nightly=True),
        case(True, scan_started, 340.0, "rig stop", "in-the-revolution", nightly=True),
        case(True, scan_started, 340.0, "Ctrl+C", "in-the-revolution", nightly=True),
    ],
)
def test_stop_after_a_pause(
    fly: bool,
    pauses_at: Callable[[Event], bool],
    stops_at_deg: float | None,
    how: str,
    tmp_path: Path,
) -> None:
    limits = f"table.limits_deg=[{BUDGET_DEG[0]}, {BUDGET_DEG[1]}]"
    store = FileStore(tmp_path / "state")
    with flying(tmp_path, *FAST, limits, state=store, camera_readout_ms=0.0) as (bench, catalog, world):
        operator = bench.placer
        assert isinstance(operator, ShelfOperator)
        assert operator.devices is not None
        memory, clock = operator.devices.servo.memory, world.clock
        angles_deg: list[float] = []
        paused_at_deg: list[float] = []
        seen: list[Event] = []

        def watch() -> None:
            angles_deg.append(world.table_deg())
            clock.call_at(clock.now_ns() + 10_000_000, watch)

        def stop() -> None:
            if how == "Ctrl+C":
                raise KeyboardInterrupt
            store.request_stop()

        def stop_when_it_passes(state: ServoState) -> None:
            before_deg, now_deg = paused_at_deg[0], bench.safety.angle_reference.to_table(state.position_deg)
            assert stops_at_deg is not None
            if min(before_deg, now_deg) < stops_at_deg < max(before_deg, now_deg):
                bench.safety.observers.clear()
                stop()

        watch()
        events = enroll(bench, catalog, "block", views=VIEWS, fly=fly)
        with pytest.raises(KeyboardInterrupt if how == "Ctrl+C" else MotionStopped):
            for event in events:
                seen.append(event)
                if not paused_at_deg and pauses_at(event):
                    clock.sleep(20.0)
                    paused_at_deg.append(world.table_deg())
                    assert (memory["Torque Enable"], memory["Bus Watchdog"]) == (1, 0)
                    if stops_at_deg is None:
                        stop()
                    else:
                        bench.safety.observers.append(stop_when_it_passes)
        events.close()

        # It stands without torque.
        assert (memory["Torque Enable"], memory["Bus Watchdog"]) == (0, 0)
        rest_deg = world.table_deg()
        if stops_at_deg is None:
            assert rest_deg == pytest.approx(paused_at_deg[0], abs=0.05)
        else:
            speed_dps, ramp_dps2 = bench.config.table.velocity_dps, bench.config.table.acceleration_dps2
            way_deg = speed_dps**2 / (2 * ramp_dps2) + speed_dps * (REACTION_S + LAG_S)
            assert abs(rest_deg - stops_at_deg) < way_deg
        # Friction holds the shaft short of where it stopped.
        held = operator.devices.servo.motor.held_deg * 4096 / 360
        assert abs(memory["Goal Position"] - memory["Present Position"]) == pytest.approx(held, abs=3)
        clock.sleep(1.0)
        assert world.table_deg() == pytest.approx(rest_deg, abs=0.05)

        # The stored angle is that of the servo, and no motion is open.
        stored = store.load()
        assert stored.fault is None
        assert stored.table is not None
        assert stored.table.path_deg is None
        assert stored.table.position_deg == pytest.approx(memory["Present Position"] * 360 / 4096, abs=0.2)
        assert not store.stop_requested()

        # The enrollment continues, or begins again if the revolution was not complete.
        resume = any(isinstance(event, Accepted) for event in seen)
        *_, done = enroll(bench, catalog, "block", views=None if resume else VIEWS, resume=resume, fly=fly)
        assert isinstance(done, Enrolled)
        assert len(catalog.object("block").views) == VIEWS
        low_deg, high_deg = BUDGET_DEG
        assert low_deg - 0.5 < min(angles_deg) < max(angles_deg) < high_deg + 0.5
