"""Defects of dynamixel-sdk 4.1, one test for each: the rig is not affected."""

import os
import re
import threading
import time
from contextlib import suppress
from dataclasses import replace
from itertools import count
from pathlib import Path

import dynamixel_sdk.port_handler
import numpy as np
import pytest
import serial
from dynamixel_sdk import COMM_SUCCESS, PortHandler, Protocol2PacketHandler
from hypothesis import example, given
from hypothesis import strategies as st

import rig.devices
from rig.core.clock import SystemClock
from rig.core.errors import DeviceNotFound, DeviceSilent, RequestRejected
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.packets import WRITE, Packets
from rig.devices.dynamixel.port import ClockedPort, open_serial
from rig.devices.dynamixel.registers import Register, control_table
from sim.servo import Sender, SentBytes
from sim.servo.protocol2 import PacketParser, status_packet
from tests.fuzzing import examples, fuzz_settings
from tests.rig.bench_parts import open_bus, servo_wires
from tests.rig.devices.scripted_serial import scripted_bus

TABLE = control_table("xl430_w250")
WORDS = {"Model Number": 1060, "Max Voltage Limit": 140, "Min Voltage Limit": 60, "PWM Limit": 885}
"""Registers of two bytes that differ: taken one for another, they would show."""
tricky = st.lists(st.sampled_from([0xFF, 0xFF, 0xFF, 0xFD, 0xFD, 0x00, 0x55]), max_size=24).map(bytes)


# -- packets that the SDK accepts as answers --------------------------------------------------------------------------


def test_lost_reply_is_not_read_as_zero() -> None:
    wires = servo_wires()
    wires.bus.filters.append(lambda _: None)
    port = ClockedPort(wires.serial, wires.world.clock)
    sdk_value, sdk_result, _ = Protocol2PacketHandler().read2ByteTxRx(port, 1, 144)
    assert (sdk_value, sdk_result == COMM_SUCCESS) == (0, False)  # the defect: 0 is a voltage, an angle, ...
    with pytest.raises(DeviceSilent):
        DynamixelBus(port).read(1, TABLE["Present Input Voltage"])


@examples(17)
@given(
    late_ms=st.floats(36.0, 56.0) | st.floats(0.0, 1500.0),  # after the first time-out, while questions go back to back
    pauses_ms=st.just([0.0] * 12) | st.lists(st.floats(0.0, 60.0), min_size=8, max_size=8),
    which=st.integers(1, 6),
    fifo=st.booleans(),
)
def test_late_reply_answers_no_other_read(late_ms: float, pauses_ms: list[float], which: int, fifo: bool) -> None:
    """The reply may be late, early or delay the next ones; every value is the requested one."""
    wires = servo_wires(baudrate=1_000_000)
    bus = open_bus(wires, retries=4)
    number, free_ns = count(1), 0

    def delay(frame: SentBytes) -> SentBytes:
        nonlocal free_ns
        start_ns = frame.start_ns + (round(late_ms * 1e6) if next(number) == which else 0)
        if fifo:
            start_ns = max(start_ns, free_ns)
            free_ns = start_ns + frame.end_ns - frame.start_ns
        return replace(frame, start_ns=start_ns)

    wires.bus.filters.append(delay)
    for i, pause_ms in enumerate(pauses_ms):
        name = list(WORDS)[i % len(WORDS)]
        with suppress(DeviceSilent):  # a bus that is delayed for a second may count as silent
            assert bus.read(1, TABLE[name]) == WORDS[name]
        with suppress(DeviceSilent):
            bus.write(1, TABLE["LED"], i % 2)
            assert wires.device.memory["LED"] == i % 2
        wires.world.clock.sleep(pause_ms * 1e-3)


@pytest.mark.parametrize("size", [0, 1, 3, 25])
def test_reply_of_another_length_is_ignored(size: int) -> None:
    """The SDK reads the requested number of bytes, and uses the CRC as the value if there are too few."""
    bus, _ = scripted_bus(status_packet(1, 0, bytes(range(size))))
    with pytest.raises(DeviceSilent):
        bus.read(1, TABLE["Present Input Voltage"])
    assert bus.statistics.late == 1


def test_reply_of_another_servo_is_ignored() -> None:
    bus, _ = scripted_bus(status_packet(2, 0, b"\x78\0") + status_packet(1, 0, b"\x77\0"))
    assert bus.read(1, TABLE["Present Input Voltage"]) == 0x77
    assert bus.statistics.foreign == 1


def test_rejection_without_parameters_raises_no_index_error() -> None:
    """If only an error answers a ping, the SDK reads model and firmware from missing bytes."""
    bus, _ = scripted_bus(status_packet(1, 0x07))
    with pytest.raises(RequestRejected, match="access error"):
        bus.ping(1)


@fuzz_settings(0.3)
@given(data=tricky.filter(lambda data: len(data) >= 2))
def test_unstuffing_keeps_all_bytes(data: bytes) -> None:
    bus, _ = scripted_bus(status_packet(1, 0, data))
    assert bus.read_block(1, 0, len(data)) == data


def test_values_are_signed() -> None:
    bus, _ = scripted_bus(*2 * [status_packet(1, 0, (-5000).to_bytes(4, "little", signed=True))])
    assert Protocol2PacketHandler().read4ByteTxRx(bus.port, 1, 132)[0] == 4294962296
    assert bus.read(1, TABLE["Present Position"]) == -5000


def test_alert_bit_does_not_invalidate_data() -> None:
    bus, _ = scripted_bus(status_packet(1, 0x80, b"\x78\0"))
    assert bus.read(1, TABLE["Present Input Voltage"]) == 120
    assert bus.alert(1)


# -- what the SDK sends ------------------------------------------------------------------------------------------------


@fuzz_settings(0.3)
@given(data=tricky)
@example(data=b"\xff\xff\xff\xff\xfd\xfd")  # without its stuffed headers, the rest would look like a header
def test_header_in_data_is_stuffed(data: bytes) -> None:
    bus, wire = scripted_bus()
    Packets().send(bus.port, 1, WRITE, b"\x54\0" + data)
    (packet,) = PacketParser().feed(wire.written[0])
    assert packet.intact
    assert packet.parameters == b"\x54\0" + data
    after_header = wire.written[0][4:-2]  # the CRC is not stuffed
    assert not re.search(rb"\xff\xff\xfd(?!\xfd)", after_header)


# -- how long the SDK waits --------------------------------------------------------------------------------------------


def test_reading_ends_despite_endless_noise() -> None:
    wires = servo_wires()
    bus = open_bus(wires, retries=1)
    rng = np.random.default_rng(1)

    def babble() -> None:
        wires.bus.disturb(rng.bytes(64), 57_600)
        wires.world.clock.call_at(wires.world.clock.now_ns() + 10_000_000, babble)

    wires.bus.detach(wires.device)

    babble()
    with pytest.raises(DeviceSilent) as caught:
        bus.read(1, TABLE["Present Position"])
    assert caught.value.evidence["reason"] == "Incorrect status packet!"
    assert wires.world.clock.now_ns() < 2e9


def test_timeouts_ignore_the_time_of_day(monkeypatch: pytest.MonkeyPatch) -> None:
    """The SDK's own time-outs use time.time(): if the clock is set back by an hour, it waits for an hour."""

    def asked() -> float:
        raise AssertionError("time-outs must not depend on the time of day")

    monkeypatch.setattr(dynamixel_sdk.port_handler.time, "time", asked)
    wires = servo_wires()
    bus = open_bus(wires, retries=0)
    assert bus.read(1, TABLE["Model Number"]) == 1060
    with pytest.raises(DeviceSilent):
        bus.read(9, TABLE["Model Number"])


def test_waiting_uses_no_cpu() -> None:
    """The test uses a real (pseudo) terminal; the SDK itself uses the CPU during its whole time-out."""
    far, near = os.openpty()
    wire = open_serial(os.ttyname(near), 57_600)
    bus = DynamixelBus(ClockedPort(wire, SystemClock()), retries=2)
    wall_s, cpu_s = SystemClock().now_ns() * 1e-9, time.process_time()
    with pytest.raises(DeviceSilent):
        bus.ping(1)
    wall_s, cpu_s = SystemClock().now_ns() * 1e-9 - wall_s, time.process_time() - cpu_s
    bus.close()
    os.close(near)
    os.close(far)
    assert wall_s > 0.1
    assert cpu_s < 0.35 * wall_s


def test_defective_sdk_functions_are_not_called() -> None:
    """`broadcastPing` waits 0.8 s at 1 MBd and 1.4 s at 57,600 for any answers (only a scan may take this long);
    `fastSyncRead` raises IndexError.
    """
    sources = [path.read_text(encoding="utf-8") for path in Path(rig.devices.__file__).parent.rglob("*.py")]
    assert len(sources) > 15
    assert not [text for text in sources if ".broadcastPing(" in text or "fastSyncRead" in text]


# -- the port ----------------------------------------------------------------------------------------------------------


def test_failed_port_is_released() -> None:
    wires = servo_wires()
    bus = open_bus(wires, retries=0)
    wires.serial.unplug()
    for _ in range(2):  # the SDK would answer PORT_BUSY the second time
        with pytest.raises(DeviceSilent) as caught:
            bus.ping(1)
        assert "port failed" in caught.value.evidence["reason"]
    wires.serial.replug()
    wires.serial.open()
    assert bus.ping(1) == 1060


def test_threads_use_the_bus_one_after_the_other() -> None:
    """The SDK reports to a second thread that the port is busy, or mixes up their packets."""
    wires = servo_wires()
    bus = open_bus(wires, retries=0)
    wrong: list[object] = []

    def read(name: str) -> None:
        try:
            wrong.extend(value for _ in range(40) if (value := bus.read(1, TABLE[name])) != WORDS[name])
        except Exception as error:  # in a thread, no caller would see it
            wrong.append(error)

    threads = [threading.Thread(target=read, args=(name,)) for name in WORDS]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


@pytest.mark.parametrize("baud", [57_600, 250_000])
def test_any_baud_rate_is_accepted(baud: int) -> None:
    assert PortHandler("").getCFlagBaud(250_000) == -1  # the defect: a list of known ones
    far, near = os.openpty()
    wire = open_serial(os.ttyname(near), baud)
    assert wire.baudrate == baud
    port = ClockedPort(wire, SystemClock())
    assert port.setBaudRate(4_500_000)
    assert (wire.baudrate, port.getBaudRate()) == (4_500_000, 4_500_000)
    assert port.tx_time_per_byte == pytest.approx(10 / 4500)
    wire.close()
    os.close(near)
    os.close(far)


def test_port_in_use_is_reported_as_busy() -> None:
    far, near = os.openpty()
    first = open_serial(os.ttyname(near), 57_600)
    serial.Serial(os.ttyname(near), 57_600).close()  # the defect: without the lock, two programs send at once
    with pytest.raises(DeviceNotFound) as caught:
        open_serial(os.ttyname(near), 57_600)
    assert "Close the other program" in caught.value.next_step
    first.close()
    os.close(near)
    os.close(far)


def test_missing_servo_fails_in_bounded_time() -> None:
    wires = servo_wires()
    bus = open_bus(wires, retries=3)
    wires.bus.detach(wires.device)
    with pytest.raises(DeviceSilent):
        bus.write(1, Register("Goal Position", 116, 4, signed=True), 2048)
    assert wires.world.clock.now_ns() < 0.5e9
    assert len([frame for frame in wires.sent if frame.source is Sender.HOST]) == 4
