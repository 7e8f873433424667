"""The bus and the serial port: times of each byte, and disturbances."""

import errno

import pytest
import serial
from dynamixel_sdk import COMM_SUCCESS
from hypothesis import given
from hypothesis import strategies as st

from sim.servo import Sender, SentBytes, SimSerial
from sim.servo.bus import ABANDON_S, superpose
from tests.fuzzing import examples
from tests.sim.servo.servo_bench import Line

PING = bytes.fromhex("FFFFFD000103000119 4E".replace(" ", ""))


@pytest.mark.parametrize(("baudrate", "delay"), [(57_600, 250), (57_600, 0), (1_000_000, 10), (9_600, 254)])
def test_time_of_a_ping_is_that_of_its_bytes_and_the_return_delay(baudrate: int, delay: int) -> None:
    line = Line(baudrate)
    line.add()
    line.put(Return_Delay_Time=delay)
    line.frames.clear()
    start_ns = line.clock.now_ns()
    line.sdk.ping(line.port, 1)
    request, reply = line.frames
    byte_ns = 10e9 / baudrate
    assert request.start_ns == start_ns
    assert reply.start_ns == pytest.approx(start_ns + 10 * byte_ns + delay * 2_000, abs=1)
    assert line.clock.now_ns() == pytest.approx(reply.start_ns + 14 * byte_ns, abs=1)


def test_writes_follow_one_another_on_the_bus(line: Line) -> None:
    for part in (PING[:3], PING[3:8], PING[8:]):
        line.serial.write(part)
    assert line.serial.read(14)[:5] == PING[:5]
    requests = [frame for frame in line.frames if frame.source is Sender.HOST]
    assert [frame.start_ns for frame in requests] == [0, 30_000, 80_000]


def test_read_returns_when_complete_or_at_the_timeout(line: Line) -> None:
    line.serial.timeout = 0
    line.serial.write(PING)
    assert line.serial.read(14) == b""
    assert line.clock.now_ns() == 0
    line.serial.timeout = 0.01
    assert len(line.serial.read(5)) == 5
    assert line.clock.now_ns() == 100_000 + 500_000 + 50_000
    assert len(line.serial.read(100)) == 9
    assert line.clock.now_ns() == 650_000 + 10_000_000


# -- disturbances ---------------------------------------------------------------------------------------------------


def test_incomplete_packet_is_dropped_and_does_not_damage_the_next(line: Line) -> None:
    line.serial.write(PING[:7])
    line.sleep(ABANDON_S + 0.001)
    assert line.sdk.ping(line.port, 1)[1] == COMM_SUCCESS
    line.serial.write(PING[:7])
    results = [line.sdk.ping(line.port, 1)[1] for _ in range(2)]
    assert results[-1] == COMM_SUCCESS


@examples(10)
@given(st.binary(min_size=1, max_size=12), st.binary(min_size=1, max_size=12))
def test_two_simultaneous_senders_can_only_pull_the_bus_low(one: bytes, other: bytes) -> None:
    frames = [SentBytes(Sender.DEVICE, 0, 1_000_000, one), SentBytes(Sender.DEVICE, 0, 1_000_000, other)]
    (mixed,) = superpose(frames)
    assert len(mixed.data) <= len(one) + len(other) + 1
    assert superpose(frames[:1]) == frames[:1]
    assert all(mixed.data[0] & ~one[0] & 1 << bit == 0 for bit in range(8))


# -- the port as pyserial's ----------------------------------------------------------------------------------------


def test_unplugged_port_fails_like_pyserial(line: Line) -> None:
    line.serial.write(PING)
    line.serial.unplug()
    with pytest.raises(serial.SerialException):
        line.serial.read(1)
    with pytest.raises(serial.SerialException):
        line.serial.write(b"x")
    with pytest.raises(OSError, match="Input/output") as caught:
        _ = line.serial.in_waiting
    assert caught.value.errno == errno.EIO
    line.sleep(0.1)
    again = SimSerial(line.bus, 1_000_000, timeout=0.01)
    assert again.read(14) == b""  # what was on its way is lost
    again.write(PING)
    assert len(again.read(14)) == 14


def test_unplugging_ends_a_waiting_read(line: Line) -> None:
    line.serial.timeout = 5.0
    line.clock.call_at(1_000_000_000, line.serial.unplug)
    with pytest.raises(serial.SerialException):
        line.serial.read(1)
    assert line.clock.now_ns() == 1_000_000_000
