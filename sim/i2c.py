"""A simulated I2C bus underneath the unmodified smbus2.

smbus2 opens a path and calls `ioctl` on it; the simulator replaces the name ``smbus2.smbus2.ioctl``. While a simulated
bus is open, calls on its file go to the bus and all others to the kernel, so a real bus works beside it. The entry of
sysfs with the adapter's name is replaced in the same way.

Transactions follow the kernel's user interface (Documentation/i2c/{dev-interface,smbus-protocol,fault-codes}.rst). Not
simulated: ten-bit addresses, packet error checking, several masters, and the protocols of SMBus in which the device
sends the length of a block. A device that stretches the clock (its attribute
``stretches``) is a problem only for a controller that does not wait, see `SimI2cBus.stretch_errors`.
"""

import ctypes
import os
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from errno import EBUSY, EINVAL, EIO, ENOTTY, ENXIO, EOPNOTSUPP, EREMOTEIO, ETIMEDOUT
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import smbus2.smbus2 as smbus

from rig.devices import i2c
from sim.clock import VirtualClock

BIT_NS = 2_500  # one bit at 400 kHz (fast mode); a byte takes nine, with its acknowledge
_SLOW_BIT_NS = 50_000  # at 20 kHz or less, a stretch ends within its bit
TIMEOUT_S = 1.0  # how long the kernel waits for a bus that hangs (the default of ``i2c_adapter.timeout``)

_LACKING = smbus.I2cFunc.SMBUS_PEC | smbus.I2cFunc.SMBUS_PROC_CALL | smbus.I2cFunc.SMBUS_WRITE_BLOCK_DATA
_FUNCTIONS = (smbus.I2cFunc.SMBUS_EMUL | smbus.I2cFunc.I2C) & ~_LACKING

_MAX_MESSAGES = 42  # I2C_RDWR_IOCTL_MAX_MSGS and the kernel's largest message: i2c-dev rejects more, so this bus does
_MAX_MESSAGE_LENGTH = 8192

Messages = Sequence[tuple[int, bytes | int]]
"""The messages of a transaction: an address, and the bytes to write or the number of bytes to read."""


class I2cDevice(Protocol):
    """A device on the bus. If it does not always acknowledge its address, it has a property ``answers``."""

    def start(self, reading: bool) -> None:
        """Receive a (repeated) start with this device's address."""

    def write(self, data: bytes) -> int:
        """Receive the master's bytes and return how many are acknowledged."""

    def read(self, count: int) -> bytes:
        """Return the next ``count`` bytes that the master clocks out."""

    def stop(self) -> None: ...


def acknowledging(
    devices: Mapping[int, I2cDevice], address: int, nacks: int, nack_conditions: Sequence[Callable[[int], bool]]
) -> I2cDevice | None:
    """Return the device that acknowledges ``address``; None while ``nacks`` are due or a condition holds."""
    device = devices.get(address)
    silent = nacks or not getattr(device, "answers", True) or any(rejects(address) for rejects in nack_conditions)
    return None if silent else device


@dataclass(frozen=True, slots=True)
class I2cMessage:
    """The bytes on the wire between a start and the next start or stop; ``time_ns`` is its end."""

    time_ns: int
    address: int
    reading: bool
    data: bytes


class KernelBus(AbstractContextManager["KernelBus"]):
    """What the kernel does with the calls on the device file of a bus: it makes messages of them.

    ``smbus2.SMBus(path)`` opens the bus. ``kernel_drivers`` are the addresses that a kernel driver uses.
    """

    def __init__(self) -> None:
        global _kernel_ioctl
        self.kernel_drivers: set[int] = set()
        self._addressed: dict[int, int] = {}
        self._fd: int | None = os.memfd_create("sim-i2c")  # without a name, so that a killed program leaves no file
        self.path = f"/dev/fd/{self._fd}"
        self._key = _file_key(os.fstat(self._fd))
        if not _routed:
            _kernel_ioctl, _seam.ioctl, _sysfs.adapter_name = _seam.ioctl, _routed_ioctl, _routed_name
        _routed[self._key] = self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove the bus; a second call does nothing."""
        if _routed.pop(self._key, None) and not _routed:
            _seam.ioctl, _sysfs.adapter_name = _kernel_ioctl, _kernel_name
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None

    @abstractmethod
    def transfer(self, messages: Messages) -> list[bytes]:
        """Transfer messages and a stop; return the bytes of each read. Raises OSError with the kernel's number."""

    def ioctl(self, fd: int, request: int, argument: Any) -> int:
        """Serve one ``ioctl`` of ``/dev/i2c-N``; raises OSError with the kernel's number."""
        match request:
            case smbus.I2C_FUNCS:
                argument.value = _FUNCTIONS
            case smbus.I2C_SLAVE | smbus.I2C_SLAVE_FORCE:
                if not 0 <= argument <= 0x7F:
                    raise _os_error(EINVAL)
                if request == smbus.I2C_SLAVE and argument in self.kernel_drivers:
                    raise _os_error(EBUSY)
                self._addressed[fd] = argument
            case smbus.I2C_PEC:
                if argument:
                    raise _os_error(EOPNOTSUPP)
            case smbus.I2C_SMBUS:
                self._smbus(self._addressed.get(fd, 0), argument)
            case smbus.I2C_RDWR:
                messages = [argument.msgs[i] for i in range(argument.nmsgs)]
                reading = [m for m in messages if m.flags & smbus.I2C_M_RD]
                contents = [m.len if m in reading else ctypes.string_at(m.buf, m.len) for m in messages]
                read = self.transfer(list(zip((m.addr for m in messages), contents, strict=True)))
                for m, data in zip(reading, read, strict=True):
                    ctypes.memmove(m.buf, data, len(data))
            case _:
                raise _os_error(ENOTTY)
        return 0

    def _smbus(self, address: int, message: Any) -> None:
        reading = message.read_write == smbus.I2C_SMBUS_READ
        command, data = bytes([message.command]), message.data.contents

        def write(sent: bytes) -> None:
            self.transfer([(address, sent)])

        def read(count: int, *, of_register: bool = True) -> bytes:
            return self.transfer([*([(address, command)] if of_register else []), (address, count)])[-1]

        match message.size:
            case smbus.I2C_SMBUS_QUICK:
                self.transfer([(address, 0 if reading else b"")])
            case smbus.I2C_SMBUS_BYTE if reading:
                data.byte = read(1, of_register=False)[0]
            case smbus.I2C_SMBUS_BYTE:
                write(command)
            case smbus.I2C_SMBUS_BYTE_DATA if reading:
                data.byte = read(1)[0]
            case smbus.I2C_SMBUS_BYTE_DATA:
                write(command + bytes([data.byte]))
            case smbus.I2C_SMBUS_WORD_DATA if reading:
                data.word = int.from_bytes(read(2), "little")
            case smbus.I2C_SMBUS_WORD_DATA:
                write(command + data.word.to_bytes(2, "little"))
            case smbus.I2C_SMBUS_I2C_BLOCK_DATA if reading:
                count = _length(data)
                data.block[1 : count + 1] = list(read(count))
            case smbus.I2C_SMBUS_I2C_BLOCK_DATA:
                write(command + bytes(data.block[1 : _length(data) + 1]))
            case _:
                raise _os_error(EOPNOTSUPP)


class SimI2cBus(KernelBus):
    """A bus with simulated devices.

    Tests use `attach`, `detach` (unplug), `nack`, `nack_conditions` (called with an address; True: no acknowledge),
    `cut_read`, `stuck`, `stuck_error` (ETIMEDOUT as the adapter of a Raspberry Pi, or EIO as an i2c-tiny-usb), `name`
    (the kernel's name of the adapter), `errors` (address to the
    number of the error at each transfer), and `wire`, the last acknowledged messages. `bit_ns` is the time of a bit.
    `held` returns when the computer is ready for a transfer that is due at a time, in ns.
    `stretch_errors` is the share of reads in which the controller does not wait for a stretched clock, as that of a
    Raspberry Pi 4 does above 20 kHz: it takes a bit too early, and all later bits are late by one.
    """

    def __init__(self, clock: VirtualClock) -> None:
        super().__init__()
        self._clock = clock
        self._devices: dict[int, I2cDevice] = {}
        self._nacks = 0
        self._cut: int | None = None
        self.name = ""
        self.stuck = False
        self.stuck_error = ETIMEDOUT
        self.bit_ns = BIT_NS
        self.held: Callable[[int], int] = int
        self.stretch_errors = 0.0
        self._rng = np.random.default_rng(0)
        self.errors: dict[int, int] = {}
        self.nack_conditions: list[Callable[[int], bool]] = []
        self.wire: deque[I2cMessage] = deque(maxlen=1000)

    # -- world side -----------------------------------------------------------------------------------------------

    def attach(self, address: int, device: I2cDevice) -> None:
        if not 0x08 <= address <= 0x77:
            raise ValueError(f"address {address:#04x} is reserved: use 0x08 to 0x77")
        if address in self._devices:
            raise ValueError(f"address {address:#04x} is taken: detach what is there first")
        self._devices[address] = device

    def detach(self, address: int) -> I2cDevice:
        """Unplug the device at ``address`` and return it."""
        return self._devices.pop(address)

    def nack(self, count: int = 1) -> None:
        """Leave the next ``count`` addresses without an acknowledge."""
        self._nacks = count

    def cut_read(self, after_bytes: int) -> None:
        """Interrupt the next read of more than ``after_bytes`` bytes after that number of bytes."""
        self._cut = after_bytes

    # -- bus side -------------------------------------------------------------------------------------------------

    def transfer(self, messages: Messages) -> list[bytes]:
        sizes = [content if isinstance(content, int) else len(content) for _, content in messages]
        if not 0 < len(sizes) <= _MAX_MESSAGES or max(sizes) > _MAX_MESSAGE_LENGTH:
            raise _os_error(EINVAL)
        self._clock.advance_to(self.held(self._clock.now_ns()))
        if self.stuck:
            self._clock.sleep(TIMEOUT_S)
            raise _os_error(self.stuck_error)
        return self._transaction(messages)

    def message(self, address: int, content: bytes | int, *, last: bool) -> bytes:
        """Transfer one message for an adapter that transfers them singly; a stop follows the ``last``.

        Raises OSError with the kernel's number for what happened on the wire: ETIMEDOUT at once if the bus hangs.
        """
        if self.stuck:
            raise _os_error(ETIMEDOUT)
        self._clock.advance_to(self.held(self._clock.now_ns()))
        return b"".join(self._transaction([(address, content)], stops=last))

    def _transaction(self, messages: Messages, *, stops: bool = True) -> list[bytes]:
        read = []
        try:
            for address, content in messages:
                if isinstance(content, int):
                    read.append(self._read(address, content))
                else:
                    self._write(address, content)
        except OSError:
            stops = True
            raise
        finally:
            for device in list(self._devices.values()) if stops else ():
                device.stop()
        return read

    def _start(self, address: int, reading: bool) -> I2cDevice:
        self._pass(1)
        if address in self.errors:
            raise _os_error(self.errors[address])
        device = acknowledging(self._devices, address, self._nacks, self.nack_conditions)
        if device is None:
            self._nacks = max(self._nacks - 1, 0)
            raise _os_error(ENXIO)
        device.start(reading)
        return device

    def _write(self, address: int, data: bytes) -> None:
        device = self._start(address, reading=False)
        self._pass(len(data))
        acknowledged = device.write(data)
        self.wire.append(I2cMessage(self._clock.now_ns(), address, False, data[:acknowledged]))
        if acknowledged < len(data):
            raise _os_error(EREMOTEIO)

    def _read(self, address: int, count: int) -> bytes:
        device = self._start(address, reading=True)
        cut, moved = self._cut, count
        if cut is not None and count > cut:
            self._cut, moved = None, cut
        data = device.read(moved)
        stretched = getattr(device, "stretches", False) and self.bit_ns < _SLOW_BIT_NS and self.stretch_errors > 0
        if stretched and self._rng.random() < self.stretch_errors:
            data = ((1 << 8 * moved | int.from_bytes(data, "big")) >> 1).to_bytes(moved, "big")
        self._pass(moved)
        if moved < count:
            raise _os_error(EIO)
        self.wire.append(I2cMessage(self._clock.now_ns(), address, True, data))
        return data

    def _pass(self, byte_count: int) -> None:
        self._clock.advance_to(self._clock.now_ns() + 9 * self.bit_ns * byte_count)


def _length(data: Any) -> int:
    count = int(data.block[0])
    if not 1 <= count <= smbus.I2C_SMBUS_BLOCK_MAX:
        raise _os_error(EINVAL)
    return count


def _os_error(number: int) -> OSError:
    return OSError(number, os.strerror(number))


# -- the seam -----------------------------------------------------------------------------------------------------

_FileKey = tuple[int, int]
_seam: Any = smbus
_sysfs: Any = i2c
_routed: dict[_FileKey, KernelBus] = {}
_kernel_ioctl: Any = None
_kernel_name = i2c.adapter_name


def open_files() -> int:
    """Return the number of simulated I2C buses that are open."""
    return len(_routed)


def _file_key(status: os.stat_result) -> _FileKey:
    return status.st_dev, status.st_ino


def _routed_ioctl(fd: int, request: int, argument: Any = 0, *rest: Any) -> Any:
    adapter = _routed.get(_file_key(os.fstat(fd)))
    return adapter.ioctl(fd, request, argument) if adapter else _kernel_ioctl(fd, request, argument, *rest)


def _routed_name(path: str) -> str:
    adapter = _routed.get(_file_key(Path(path).stat()))
    return getattr(adapter, "name", "") if adapter else _kernel_name(path)
