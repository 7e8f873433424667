"""The bus driver, through the unmodified SDK, on a bus with faults."""

import os
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.core.clock import SystemClock
from rig.core.errors import DeviceSilent, RequestRejected
from rig.devices.dynamixel.bus import DynamixelBus, watchdog_units
from rig.devices.dynamixel.port import ClockedPort, open_serial
from rig.devices.dynamixel.registers import control_table
from sim.servo import SentBytes
from sim.servo.bus import Sender
from tests.rig.bench_parts import open_bus

TABLE = control_table("xl430_w250")


@pytest.fixture
def bus(wires):
    return open_bus(wires)


def test_crc_error_is_retried_and_counted(wires, bus):
    spoiled = []

    def flip_once(frame: SentBytes) -> SentBytes:
        if spoiled:
            return frame
        spoiled.append(frame)
        return replace(frame, data=frame.data[:-1] + bytes([frame.data[-1] ^ 0x01]))

    wires.bus.filters.append(flip_once)
    assert bus.ping(1) == 1060
    assert (bus.statistics.corrupt, bus.statistics.retries, bus.statistics.transactions) == (1, 1, 2)
    assert len(wires.instructions) == 2  # the request was sent again


def test_rejection_names_the_status_error_and_is_not_retried(wires, bus):
    bus.write(1, TABLE["Torque Enable"], 1)
    with pytest.raises(RequestRejected, match="access error"):
        bus.write(1, TABLE["Operating Mode"], 4)
    assert bus.statistics.retries == 0


@given(timeout_s=st.floats(0.001, 10))
def test_watchdog_units_round_up_and_never_disable_it(timeout_s):
    units = watchdog_units(timeout_s)
    assert 1 <= units <= 127
    assert units * 0.02 >= min(timeout_s, 2.54) - 1e-9


def test_adapter_unplugged_from_a_real_port_raises_device_silent():
    """The real pyserial, on a pseudo-terminal whose other end is closed, raises an error that is no OSError."""
    far, near = os.openpty()
    path = os.ttyname(near)
    os.close(near)
    bus = DynamixelBus(ClockedPort(open_serial(path, 57_600), SystemClock(), path), retries=0)
    os.close(far)
    with pytest.raises(DeviceSilent, match="does not answer") as caught:
        bus.ping(1)
    assert "port failed" in caught.value.evidence["reason"]


def test_reply_to_an_interrupted_request_never_answers_the_next_one(wires, bus):
    """Ctrl+C interrupts a transaction, and torque off sends new requests; Protocol 2.0 has no sequence numbers."""

    def interrupt() -> None:
        raise KeyboardInterrupt

    def late_and_interrupted(frame: SentBytes) -> SentBytes:
        wires.bus.filters.clear()
        wires.world.clock.call_at(wires.world.clock.now_ns(), interrupt)
        return replace(frame, start_ns=frame.start_ns + 1_000_000)

    wires.bus.filters.append(late_and_interrupted)
    with pytest.raises(KeyboardInterrupt):
        bus.read(1, TABLE["Present Temperature"])
    assert bus.read(1, TABLE["Torque Enable"]) == 0


def test_block_has_the_time_at_which_its_reply_began(wires, bus):
    begun = []
    wires.bus.taps.append(lambda frame: begun.append(frame.start_ns) if frame.source is Sender.DEVICE else None)
    for number in range(8):  # replies of different lengths
        if number == 4:
            wires.device.memory["Goal Velocity"] = 0x00FDFFFF  # FF FF FD: another byte follows on the bus
        bus.read_block(1, 100, 30)
        assert bus.sampled_ns == pytest.approx(begun[-1], abs=2000)
