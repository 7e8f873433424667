"""An answer that arrives twice is never accepted as a new reading, with any delay."""

import random

import pytest

from rig.config import load_config
from rig.core.errors import RigError
from rig.devices.dynamixel.servo import open_servo as open_configured
from sim.devices import SimDevices
from sim.noise import NoiseModel
from sim.servo import Sender
from sim.world import World
from tests.rig.bench_parts import open_servo, servo_wires

NIGHTLY = [0.008, 0.011, 0.015, 0.022, 0.08, 0.12, 0.16, 0.2, 0.3, 0.32, 0.64, 1.0, 2.1, 5.0]


@pytest.mark.parametrize("poll_s", [0.04, pytest.param(0.012, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("spread", [False, True], ids=["fixed", "random"])
@pytest.mark.parametrize(
    "delay_s", [0.005, 0.04, 0.045, 0.5, 2.5, *(pytest.param(d, marks=pytest.mark.nightly) for d in NIGHTLY)]
)
def test_old_answers_are_never_readings(delay_s, spread, poll_s):
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


def test_repeated_answer_to_a_write_does_not_hide_that_the_next_one_was_lost():
    config = load_config()
    with SimDevices.connected(config, World(noise=NoiseModel.none())) as devices:
        clock, bus = devices.world.clock, devices.servo_bus
        servo = open_configured(devices.adapter, config.servo, clock, config.table.mode)
        hear = bus.send

        def repeat(frame):
            if len(frame.data) <= 11:  # the answer to a write
                clock.call_at(frame.start_ns + 4_500_000, lambda: bus.disturb(frame.data, frame.baudrate))
            return frame

        bus.filters.append(repeat)
        servo.move_to(10.0)
        clock.sleep(0.1)
        servo.read_state()  # the repeated answer is found: from now on the bus is in doubt
        for goal in range(300, 360, 2):
            clock.sleep(3.0)  # no answer is owed any more
            servo.move_to(goal * servo.resolution_deg)

            def lose_first(data, baudrate):
                bus.send = hear
                return hear(b"", baudrate)

            bus.send = lose_first
            servo.move_to((goal + 1) * servo.resolution_deg)
            assert devices.servo.memory["Goal Position"] == goal + 1


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


def test_readings_of_a_busy_computer_are_new_and_not_older_than_their_time_says(monkeypatch):
    """The computer may pause before a request leaves the program, or after the answer has arrived."""
    wires, rng = servo_wires(NoiseModel.none()), random.Random(1)
    servo, clock = open_servo(wires), wires.world.clock
    write, read = wires.serial.write, wires.serial.read
    pauses_s = [0.0, 0.0]  # before the request, and after the answer

    def paused_write(data):
        clock.sleep(pauses_s[0])
        return write(data)

    def paused_read(size):
        data = read(size)
        clock.sleep(pauses_s[1] if data else 0.0)
        return data

    monkeypatch.setattr(wires.serial, "write", paused_write)
    monkeypatch.setattr(wires.serial, "read", paused_read)
    servo.read_state()
    for n in range(200):
        clock.sleep(rng.uniform(0.0, 0.05))
        busy = n % 10 > 0
        pauses_s[:] = [rng.uniform(0.0, 0.3) * (rng.random() < 0.5) * busy for _ in range(2)]
        sent = len(wires.sent)
        state = servo.read_state()
        assert sum(frame.source is Sender.HOST for frame in wires.sent[sent:]) == 1
        assert abs(state.time_ns - wires.sent[-1].start_ns) < 60e6
