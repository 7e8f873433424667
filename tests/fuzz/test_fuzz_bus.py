"""Requests of any program at the servo port of `rig sim-bench`."""

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sim.clock import VirtualClock
from sim.noise import NoiseModel
from sim.servo import ServoBus, SimServo
from sim.servo.protocol2 import with_crc
from sim.world import World
from tests.fuzzing import fuzz_settings

pytestmark = pytest.mark.timeout(1200)

WORDS = st.one_of(st.sampled_from([0, 1, 4, 0x7F, 0xFFFC, 0xFFFF]), st.integers(0, 0xFFFF)).map(
    lambda value: value.to_bytes(2, "little")
)
PARAMETERS = st.one_of(
    st.binary(max_size=12),
    st.builds(bytes.__add__, WORDS, st.builds(bytes.__add__, WORDS, st.binary(max_size=6))),
    st.builds(lambda one, other: b"\1" + one + other, WORDS, WORDS),
)
INSTRUCTIONS = st.one_of(
    st.sampled_from([1, 2, 3, 4, 5, 6, 8, 0x10, 0x20, 0x82, 0x83, 0x8A, 0x92, 0x93, 0x9A]), st.integers(0, 255)
)


@fuzz_settings(0.2)
@given(st.sampled_from([1, 254]), INSTRUCTIONS, PARAMETERS)
@example(254, 0x8A, b"\0\0\xff\xff\1")
@example(254, 0x82, b"\0\0\xff\xff\1")
@example(254, 0x9A, b"\1\0\0\xff\xff")
def test_any_request_leaves_the_bus_alive(bus_id, instruction, parameters):
    clock = VirtualClock()
    bus = ServoBus(clock)
    bus.attach(SimServo(World(noise=NoiseModel.none(), clock=clock), "xl430_w250", bus_id=1, baudrate=57600))
    answers = []
    bus.connect(answers.append)
    body = bytes([instruction]) + parameters.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    length = (len(body) + 2).to_bytes(2, "little")
    bus.send(with_crc(b"\xff\xff\xfd\0" + bytes([bus_id]) + length + body), 57600)
    clock.sleep(3.0)
    assert all(len(frame.data) <= 7 + 0xFFFF for frame in answers)
