"""The simulated bus under the real smbus2."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, suppress
from errno import EINVAL, EIO, ENOTTY, ENXIO, EOPNOTSUPP, EREMOTEIO, ETIMEDOUT
from pathlib import Path
from typing import Any

import pytest
import smbus2
from hypothesis import given
from hypothesis import strategies as st
from smbus2 import SMBus, i2c_msg

from sim.clock import VirtualClock
from sim.i2c import SimI2cBus

AT = 0x50
BYTE_S = 9 / 400_000


class Memory:
    """256 registers behind a pointer; records the signals, and accepts at most `accepts` bytes of a message."""

    def __init__(self) -> None:
        self.cells = bytearray(256)
        self.pointer = 0
        self.seen: list[Any] = []
        self.accepts = 1000

    def start(self, reading: bool) -> None:
        self.seen.append("R" if reading else "W")

    def write(self, data: bytes) -> int:
        self.seen.append(data)
        data = data[: self.accepts]
        for i, byte in enumerate(data):
            if i:
                self.cells[self.pointer] = byte
                self.pointer = (self.pointer + 1) % 256
            else:
                self.pointer = byte
        return len(data)

    def read(self, count: int) -> bytes:
        answer = bytes(self.cells[(self.pointer + i) % 256] for i in range(count))
        self.pointer = (self.pointer + count) % 256
        return answer

    def stop(self) -> None:
        self.seen.append("P")


class Wires:
    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.bus = SimI2cBus(self.clock)
        self.memory = Memory()
        self.bus.attach(AT, self.memory)
        self.master = SMBus(self.bus.path)

    def close(self) -> None:
        self.master.close()
        self.bus.close()


@pytest.fixture
def wires() -> Iterator[Wires]:
    w = Wires()
    yield w
    w.close()


@pytest.fixture(scope="module")
def shared() -> Iterator[Wires]:
    w = Wires()
    yield w
    w.close()


@given(register=st.integers(0, 200), data=st.binary(min_size=2, max_size=32))
def test_bytes_words_and_blocks_are_written_and_read(shared: Wires, register: int, data: bytes) -> None:
    master, word = shared.master, int.from_bytes(data[:2], "little")
    master.write_byte_data(AT, register, data[0])
    assert (master.read_byte_data(AT, register), shared.memory.cells[register]) == (data[0], data[0])
    master.write_byte(AT, register)
    assert master.read_byte(AT) == data[0]
    master.write_word_data(AT, register, word)
    assert (master.read_word_data(AT, register), shared.memory.cells[register : register + 2]) == (word, data[:2])
    master.write_i2c_block_data(AT, register, list(data))
    assert bytes(master.read_i2c_block_data(AT, register, len(data))) == data


@given(register=st.integers(0, 100), data=st.binary(min_size=1, max_size=150), count=st.integers(1, 150))
def test_combined_transaction_has_one_stop(shared: Wires, register: int, data: bytes, count: int) -> None:
    shared.memory.seen.clear()
    answer = i2c_msg.read(AT, count)
    shared.master.i2c_rdwr(i2c_msg.write(AT, [register, *data]), i2c_msg.write(AT, [register]), answer)
    assert bytes(answer)[: len(data)] == data[:count]
    assert shared.memory.seen == ["W", bytes([register, *data]), "W", bytes([register]), "R", "P"]


def test_quick_finds_attached_devices(wires: Wires) -> None:
    found = []
    for address in range(0x08, 0x78):
        with suppress(OSError):
            wires.master.write_quick(address)
            found.append(address)
    assert found == [AT]


def test_messages_of_smbus2_are_recorded_and_each_byte_takes_its_time(wires: Wires) -> None:
    wires.master.read_i2c_block_data(AT, 0, 14)  # address and register, address and 14 bytes
    assert wires.clock.now_ns() == round(17 * BYTE_S * 1e9)
    wires.bus.wire.clear()
    wires.master.write_word_data(AT, 0x21, 0x4433)
    wires.master.read_byte_data(AT, 0x21)
    assert [(m.address, m.reading, m.data) for m in wires.bus.wire] == [
        (AT, False, b"\x21\x33\x44"),
        (AT, False, b"\x21"),
        (AT, True, b"\x33"),
    ]


def fails(number: int) -> AbstractContextManager[object]:
    return pytest.raises(OSError, match=rf"\[Errno {number}\]")


def test_faults_carry_the_kernels_numbers(wires: Wires) -> None:
    def read() -> list[int]:
        return wires.master.read_i2c_block_data(AT, 0, 4)

    wires.bus.nack(2)
    for _ in range(2):
        with fails(ENXIO):
            read()
    assert read() == [0, 0, 0, 0]

    device = wires.bus.detach(AT)
    with fails(ENXIO):
        read()
    wires.bus.attach(AT, device)

    wires.bus.cut_read(2)
    with fails(EIO):
        read()
    assert wires.memory.pointer == 2  # this number of bytes was read
    assert read() == [0, 0, 0, 0]

    wires.bus.stuck = True
    before_ns = wires.clock.now_ns()
    with fails(ETIMEDOUT):
        read()
    assert wires.clock.now_ns() - before_ns == 1_000_000_000


def test_rejected_byte_is_a_remote_error(wires: Wires) -> None:
    wires.memory.accepts = 2
    with fails(EREMOTEIO):
        wires.master.write_i2c_block_data(AT, 5, [1, 2, 3])
    assert wires.memory.cells[5:8] == b"\x01\0\0"
    assert wires.memory.seen[-1] == "P"  # the bus is free again


def test_unsupported_functions_are_reported(wires: Wires) -> None:
    assert wires.master.funcs & smbus2.I2cFunc.I2C
    with pytest.raises(OSError, match="not a feature"):
        wires.master.enable_pec()
    for request, argument, number in [
        (smbus2.smbus2.I2C_PEC, 1, EOPNOTSUPP),
        (smbus2.smbus2.I2C_SLAVE, 0x80, EINVAL),
        (0x0799, 0, ENOTTY),
    ]:
        with fails(number):
            smbus2.smbus2.ioctl(wires.master.fd, request, argument)
    for messages in ([], [i2c_msg.read(AT, 1)] * 43, [i2c_msg.read(AT, 8193)]):
        with fails(EINVAL):
            wires.master.i2c_rdwr(*messages)


def test_addresses_are_checked_and_several_buses_work_side_by_side(wires: Wires) -> None:
    with pytest.raises(ValueError, match="taken"):
        wires.bus.attach(AT, Memory())
    with pytest.raises(ValueError, match="reserved"):
        wires.bus.attach(0x78, Memory())
    with SimI2cBus(wires.clock) as other, SMBus(other.path) as master:
        memory = Memory()
        other.attach(AT, memory)
        master.write_byte_data(AT, 1, 11)
        wires.master.write_byte_data(AT, 1, 22)
        assert (memory.cells[1], wires.memory.cells[1]) == (11, 22)


def test_other_files_still_reach_the_kernel(wires: Wires, tmp_path: Path) -> None:
    plain = tmp_path / "i2c-7"
    plain.touch()
    with fails(ENOTTY):  # the kernel's word on a plain file
        SMBus(str(plain))


def test_ioctl_is_restored_after_the_last_bus() -> None:
    script = """
import fcntl, pathlib, smbus2
from sim.clock import VirtualClock
from sim.i2c import SimI2cBus
first, second = SimI2cBus(VirtualClock()), SimI2cBus(VirtualClock())
first.close()
assert smbus2.smbus2.ioctl is not fcntl.ioctl
second.close()
second.close()
assert smbus2.smbus2.ioctl is fcntl.ioctl
assert not pathlib.Path(first.path).exists() and not pathlib.Path(second.path).exists()
"""
    subprocess.run([sys.executable, "-c", script], check=True)  # of its own: other tests may hold buses here
