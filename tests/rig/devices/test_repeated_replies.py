"""An answer that arrives twice is never taken for a new reading, whatever its delay."""

import random

import pytest

from rig.core.errors import RigError
from tests.rig.bench_parts import open_servo, servo_wires

NIGHTLY = [0.008, 0.011, 0.015, 0.022, 0.08, 0.12, 0.16, 0.2, 0.3, 0.32, 0.64, 1.0, 2.1, 5.0]


@pytest.mark.parametrize("poll_s", [0.04, pytest.param(0.012, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("spread", [False, True], ids=["fixed", "random"])
@pytest.mark.parametrize(
    "delay_s", [0.005, 0.04, 0.045, 0.5, 2.5, *(pytest.param(d, marks=pytest.mark.nightly) for d in NIGHTLY)]
)
def test_no_old_answer_is_taken_for_a_reading(delay_s, spread, poll_s):
    wires, rng = servo_wires(), random.Random(1)
    servo, clock = open_servo(wires), wires.world.clock
    servo.torque_on()
    servo.move_to(20_000.0)

    def repeat(frame):
        late_s = delay_s * (rng.uniform(0.5, 1.5) if spread else 1.0)
        if rng.random() < 0.3:
            clock.call_at(frame.start_ns + round(late_s * 1e9), lambda: wires.bus.disturb(frame.data, frame.baudrate))
        return frame

    clock.sleep(1.0)
    wires.bus.filters.append(repeat)
    readings = rejected = 0
    for _ in range(150):
        clock.sleep(poll_s)
        begun_deg = wires.world.shaft()[0]
        try:
            state = servo.read_state()
        except RigError:
            rejected += 1
            continue
        readings += 1
        assert begun_deg - 0.6 <= state.position_deg - 180.0 <= wires.world.shaft()[0] + 0.6
    assert readings > 140
    assert rejected < 10


def test_restarted_servo_is_read_again_although_its_clock_starts_at_zero():
    wires = servo_wires()
    servo = open_servo(wires)
    wires.world.clock.sleep(5.0)
    servo.read_state()
    wires.device.power_cycle()
    wires.world.clock.sleep(1.0)
    assert servo.read_state().position_deg == pytest.approx(180.0, abs=1.0)


def test_reading_after_a_long_pause_is_confirmed_by_a_second_one():
    wires = servo_wires()
    servo = open_servo(wires)
    for _ in range(3):
        servo.read_state()
        wires.world.clock.sleep(100.0)
    sent = len(wires.instructions)
    servo.read_state()
    assert len(wires.instructions) == sent + 2
