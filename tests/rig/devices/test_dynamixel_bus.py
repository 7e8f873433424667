"""The bus driver, through the unmodified SDK, on a line that misbehaves."""

import os
from dataclasses import replace

import pytest
from dynamixel_sdk import Protocol2PacketHandler
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.core.clock import SystemClock
from rig.core.errors import DeviceSilent, RequestRejected
from rig.devices.dynamixel.bus import DynamixelBus, watchdog_units
from rig.devices.dynamixel.port import ClockedPort, open_serial
from rig.devices.dynamixel.registers import control_table
from sim.servo import Frame
from tests.rig.bench_parts import open_bus, servo_wires

TABLE = control_table("xl430_w250")


def test_the_bytes_on_the_wire_are_the_sdks():
    wires = servo_wires()
    open_bus(wires).write(1, TABLE["Goal Velocity"], -5)
    sdk = Protocol2PacketHandler()
    sent = wires.instructions[0]
    assert sent[:7] == bytes([0xFF, 0xFF, 0xFD, 0x00, 0x01, 0x09, 0x00])
    assert sent[7] == 3  # Write
    assert sent[8:14] == bytes([104, 0, 0xFB, 0xFF, 0xFF, 0xFF])
    assert int.from_bytes(sent[14:], "little") == sdk.updateCRC(0, list(sent), len(sent) - 2)


def test_values_come_back_signed():
    wires = servo_wires()
    bus = open_bus(wires)
    bus.write(1, TABLE["Goal Velocity"], -5)
    assert bus.read(1, TABLE["Goal Velocity"]) == -5


def test_a_crc_error_on_the_wire_is_retried_and_counted():
    wires = servo_wires()
    bus = open_bus(wires)
    spoiled = []

    def flip_once(frame: Frame) -> Frame:
        if spoiled:
            return frame
        spoiled.append(frame)
        return replace(frame, data=frame.data[:-1] + bytes([frame.data[-1] ^ 0x01]))

    wires.bus.filters.append(flip_once)
    assert bus.ping(1) == 1060
    assert (bus.statistics.corrupt, bus.statistics.retries, bus.statistics.transactions) == (1, 1, 2)
    assert len(wires.instructions) == 2  # the question really went out again


def test_a_line_that_always_spoils_ends_in_device_silent_with_the_sdks_reason():
    wires = servo_wires()
    bus = open_bus(wires, retries=2)
    wires.bus.filters.append(lambda frame: replace(frame, data=frame.data[:-1] + bytes([frame.data[-1] ^ 0xFF])))
    with pytest.raises(DeviceSilent) as caught:
        bus.read(1, TABLE["Present Position"])
    assert caught.value.evidence["reason"] == "Incorrect status packet!"
    assert caught.value.evidence["attempts"] == 3
    assert bus.statistics.corrupt == 3


def test_a_lost_reply_is_asked_for_again():
    wires = servo_wires()
    bus = open_bus(wires)
    lost = iter([None])
    wires.bus.filters.append(lambda frame: next(lost, frame))
    assert bus.read(1, TABLE["Present Input Voltage"]) > 0
    assert bus.statistics.timeouts == 1


def test_a_reply_that_comes_too_late_is_never_taken_for_the_next_answer():
    wires = servo_wires()
    bus = open_bus(wires)
    late = iter([50_000_000])  # past the timeout, while the next question could already be out

    def delay_once(frame: Frame) -> Frame:
        return replace(frame, start_ns=frame.start_ns + next(late, 0))

    wires.bus.filters.append(delay_once)
    model, torque = bus.read(1, TABLE["Model Number"]), bus.read(1, TABLE["Torque Enable"])
    assert (model, torque) == (1060, 0)
    assert bus.statistics.retries >= 1


def test_a_babbling_line_ends_instead_of_hanging():
    wires = servo_wires()
    bus = open_bus(wires, retries=1)

    def babble(frame: Frame) -> Frame:
        return replace(frame, data=b"\x00" * 60_000)

    wires.bus.filters.append(babble)
    before_ns = wires.world.clock.now_ns()
    with pytest.raises(DeviceSilent):
        bus.ping(1)
    assert wires.world.clock.now_ns() - before_ns < 2e9
    assert not bus.port.is_using


def test_a_refusal_names_the_status_error_and_is_not_retried():
    wires = servo_wires()
    bus = open_bus(wires)
    bus.write(1, TABLE["Torque Enable"], 1)
    with pytest.raises(RequestRejected, match="access error"):
        bus.write(1, TABLE["Operating Mode"], 4)
    assert bus.statistics.retries == 0


def test_the_alert_bit_is_no_failure():
    wires = servo_wires()
    bus = open_bus(wires)
    wires.device.set_voltage(3.0)
    wires.world.clock.sleep(1.0)
    assert bus.read(1, TABLE["Hardware Error Status"]) & 1
    assert bus.alert(1)


def test_an_unplugged_adapter_is_silent_and_leaves_the_port_usable():
    wires = servo_wires()
    bus = open_bus(wires)
    wires.serial.unplug()
    with pytest.raises(DeviceSilent, match="does not answer") as caught:
        bus.ping(1)
    assert "port failed" in caught.value.evidence["reason"]
    assert not bus.port.is_using


def test_waiting_for_a_device_that_is_not_there_takes_virtual_time_only():
    wires = servo_wires()
    bus = open_bus(wires, retries=0)
    with pytest.raises(DeviceSilent):
        bus.ping(7)
    assert 0.03 < wires.world.clock.now_ns() * 1e-9 < 0.2


@settings(max_examples=40, deadline=None)
@given(noise=st.lists(st.binary(min_size=0, max_size=30), min_size=1, max_size=4))
def test_garbage_in_place_of_replies_never_becomes_a_value(noise):
    wires = servo_wires()
    bus = open_bus(wires, retries=len(noise))
    garbage = iter(noise)
    wires.bus.filters.append(lambda frame: replace(frame, data=next(garbage, frame.data)))
    assert bus.read(1, TABLE["Model Number"]) == 1060
    assert bus.statistics.retries == len(noise)


@given(timeout_s=st.floats(0.001, 10))
def test_the_watchdogs_register_holds_at_least_the_time_asked_for_and_never_switches_it_off(timeout_s):
    units = watchdog_units(timeout_s)
    assert 1 <= units <= 127
    assert units * 0.02 >= min(timeout_s, 2.54) - 1e-9


def test_an_adapter_pulled_out_of_a_real_port_is_silent():
    """pyserial itself, on a pseudo-terminal whose other end goes away: it then raises what is no OSError."""
    far, near = os.openpty()
    path = os.ttyname(near)
    os.close(near)
    bus = DynamixelBus(ClockedPort(open_serial(path, 57_600), SystemClock(), path), retries=0)
    os.close(far)
    with pytest.raises(DeviceSilent, match="does not answer") as caught:
        bus.ping(1)
    assert "port failed" in caught.value.evidence["reason"]


def test_an_adapter_pulled_while_the_line_is_drained_is_silent(monkeypatch):
    wires = servo_wires()
    bus = open_bus(wires)
    wires.bus.detach(wires.device)
    drain = bus.port.drain

    def pull_and_drain() -> None:
        wires.serial.unplug()
        drain()

    monkeypatch.setattr(bus.port, "drain", pull_and_drain)
    with pytest.raises(DeviceSilent, match="does not answer"):
        bus.ping(1)


def test_the_answer_to_a_question_that_was_cut_short_is_never_taken_for_the_next_one():
    """Ctrl+C in the middle of a transaction, and then torque off with its own questions: Protocol 2.0 numbers none."""
    wires = servo_wires()
    bus = open_bus(wires)

    def interrupt() -> None:
        raise KeyboardInterrupt

    def late_and_interrupted(frame: Frame) -> Frame:
        wires.bus.filters.clear()
        wires.world.clock.call_at(wires.world.clock.now_ns(), interrupt)
        return replace(frame, start_ns=frame.start_ns + 1_000_000)

    wires.bus.filters.append(late_and_interrupted)
    with pytest.raises(KeyboardInterrupt):
        bus.read(1, TABLE["Present Temperature"])
    assert bus.read(1, TABLE["Torque Enable"]) == 0
