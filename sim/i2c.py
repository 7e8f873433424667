"""A simulated I2C bus underneath the unmodified smbus2.

smbus2 opens a path and calls `ioctl` on it; the simulator replaces the name ``smbus2.smbus2.ioctl``. While a simulated
bus is open, calls on its file go to the bus and all others to the kernel, so a real bus works beside it. The entry of
sysfs with the adapter's name is replaced in the same way.

Transactions follow the kernel's user interface (Documentation/i2c/{dev-interface,smbus-protocol,fault-codes}.rst). Not
simulated: ten-bit addresses, packet error checking, several masters. A device that stretches the clock (its attribute
``stretches``) is a problem only for a controller that does not wait, see `SimI2cBus.stretch_errors`.
"""

import ctypes
import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from errno import EBUSY, EINVAL, EIO, ENOTTY, ENXIO, EOPNOTSUPP, EPROTO, EREMOTEIO, ETIMEDOUT
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import smbus2.smbus2 as smbus

from rig.devices import i2c
from sim.clock import VirtualClock

BIT_NS = 2_500  # one bit at 400 kHz (fast mode); a byte takes nine, with its acknowledge
_SLOW_BIT_NS = 50_000  # at 20 kHz or less, a stretch ends within its bit
TIMEOUT_S = 1.0  # how long the kernel waits for a bus that hangs (the default of ``i2c_adapter.timeout``)

FUNCTIONS = (
    smbus.I2cFunc.SMBUS_EMUL
    | smbus.I2cFunc.SMBUS_READ_BLOCK_DATA
    | smbus.I2cFunc.I2C
    | smbus.I2cFunc.SMBUS_BLOCK_PROC_CALL
) & ~smbus.I2cFunc.SMBUS_PEC
"""Capabilities of the adapter, for the ioctl I2C_FUNCS."""

_MAX_MESSAGES = 42  # I2C_RDWR_IOCTL_MAX_MSGS and the kernel's largest message: i2c-dev rejects more, so this bus does
_MAX_MESSAGE_LENGTH = 8192


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


class SimI2cBus(AbstractContextManager["SimI2cBus"]):
    """A bus with a path that ``smbus2.SMBus(path)`` opens.

    Tests use `attach`, `detach` (unplug), `nack`, `nack_conditions` (called with an address; True: no acknowledge),
    `cut_read`, `stuck`, `stuck_error` (ETIMEDOUT as the adapter of a Raspberry Pi, or EIO as an i2c-tiny-usb), `name`
    (the kernel's name of the adapter), `kernel_drivers` (addresses that a kernel driver uses), `errors` (address to the
    number of the error at each transfer), and `wire`, the last acknowledged messages. `bit_ns` is the time of a bit.
    `held` returns when the computer is ready for a transfer that is due at a time, in ns.
    `stretch_errors` is the share of reads in which the controller does not wait for a stretched clock, as that of a
    Raspberry Pi 4 does above 20 kHz: it takes a bit too early, and all later bits are late by one.
    """

    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock
        self._devices: dict[int, I2cDevice] = {}
        self._addressed: dict[int, int] = {}
        self._nacks = 0
        self._cut: int | None = None
        self.name = ""
        self.stuck = False
        self.stuck_error = ETIMEDOUT
        self.bit_ns = BIT_NS
        self.held: Callable[[int], int] = int
        self.stretch_errors = 0.0
        self._rng = np.random.default_rng(0)
        self.kernel_drivers: set[int] = set()
        self.errors: dict[int, int] = {}
        self.nack_conditions: list[Callable[[int], bool]] = []
        self.wire: deque[I2cMessage] = deque(maxlen=1000)
        self._file = RoutedFile(self)
        self.path = self._file.path

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove the bus; a second call does nothing."""
        self._file.close()

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

    # -- bus side: for an adapter that transfers single messages --------------------------------------------------

    def message(self, address: int, content: bytes | int, *, last: bool) -> bytes:
        """Transfer one message: write the bytes ``content``, or read a number of bytes; a stop follows the ``last``.

        Raises OSError with the kernel's number for what happened on the wire: ETIMEDOUT at once if the bus hangs.
        """
        if self.stuck:
            raise _os_error(ETIMEDOUT)
        read = b""

        def transfer() -> None:
            nonlocal read
            if isinstance(content, int):
                read = self._read(address, content)
            else:
                self._write(address, content)

        self._transaction(transfer, stops=last)
        return read

    # -- bus side: what the kernel does ---------------------------------------------------------------------------

    def ioctl(self, fd: int, request: int, argument: Any) -> int:
        """Serve one ``ioctl`` of ``/dev/i2c-N``; raises OSError with the kernel's number."""
        match request:
            case smbus.I2C_FUNCS:
                argument.value = FUNCTIONS
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
                self._transaction(lambda: self._smbus(self._addressed.get(fd, 0), argument))
            case smbus.I2C_RDWR:
                messages = [argument.msgs[i] for i in range(argument.nmsgs)]
                if not 0 < len(messages) <= _MAX_MESSAGES or any(m.len > _MAX_MESSAGE_LENGTH for m in messages):
                    raise _os_error(EINVAL)
                self._transaction(lambda: self._combined(messages))
            case _:
                raise _os_error(ENOTTY)
        return 0

    def _transaction(self, messages: Callable[[], None], *, stops: bool = True) -> None:
        self._clock.advance_to(self.held(self._clock.now_ns()))
        if self.stuck:
            self._clock.sleep(TIMEOUT_S)
            raise _os_error(self.stuck_error)
        try:
            messages()
        except OSError:
            stops = True
            raise
        finally:
            for device in list(self._devices.values()) if stops else ():
                device.stop()

    def _combined(self, messages: list[Any]) -> None:
        for m in messages:
            if m.flags & smbus.I2C_M_RD:
                ctypes.memmove(m.buf, self._read(m.addr, m.len), m.len)
            else:
                self._write(m.addr, ctypes.string_at(m.buf, m.len))

    def _smbus(self, address: int, message: Any) -> None:
        reading = message.read_write == smbus.I2C_SMBUS_READ
        command, data = bytes([message.command]), message.data.contents
        match message.size:
            case smbus.I2C_SMBUS_QUICK:
                self._start(address, reading)
            case smbus.I2C_SMBUS_BYTE if reading:
                data.byte = self._read(address, 1)[0]
            case smbus.I2C_SMBUS_BYTE:
                self._write(address, command)
            case smbus.I2C_SMBUS_BYTE_DATA if reading:
                data.byte = self._write_read(address, command, 1)[0]
            case smbus.I2C_SMBUS_BYTE_DATA:
                self._write(address, command + bytes([data.byte]))
            case smbus.I2C_SMBUS_WORD_DATA if reading:
                data.word = int.from_bytes(self._write_read(address, command, 2), "little")
            case smbus.I2C_SMBUS_WORD_DATA:
                self._write(address, command + data.word.to_bytes(2, "little"))
            case smbus.I2C_SMBUS_PROC_CALL:
                sent = command + data.word.to_bytes(2, "little")
                data.word = int.from_bytes(self._write_read(address, sent, 2), "little")
            case smbus.I2C_SMBUS_BLOCK_DATA if reading:
                self._read_counted(address, command, data.block)
            case smbus.I2C_SMBUS_BLOCK_DATA:
                self._write(address, command + bytes(data.block[: _length(data) + 1]))
            case smbus.I2C_SMBUS_BLOCK_PROC_CALL:
                self._read_counted(address, command + bytes(data.block[: _length(data) + 1]), data.block)
            case smbus.I2C_SMBUS_I2C_BLOCK_DATA if reading:
                count = _length(data)
                data.block[1 : count + 1] = list(self._write_read(address, command, count))
            case smbus.I2C_SMBUS_I2C_BLOCK_DATA:
                self._write(address, command + bytes(data.block[1 : _length(data) + 1]))
            case _:
                raise _os_error(EOPNOTSUPP)

    def _write_read(self, address: int, sent: bytes, count: int) -> bytes:
        self._write(address, sent)
        return self._read(address, count)

    def _read_counted(self, address: int, sent: bytes, block: Any) -> None:
        """Read a block whose first byte is its length (``I2C_M_RECV_LEN``)."""
        self._write(address, sent)
        count = self._read(address, 1)[0]
        if not 1 <= count <= smbus.I2C_SMBUS_BLOCK_MAX:
            raise _os_error(EPROTO)
        block[: count + 1] = [count, *self._clock_out(self._devices[address], address, count)]

    # -- the wire -------------------------------------------------------------------------------------------------

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
        return self._clock_out(self._start(address, reading=True), address, count)

    def _clock_out(self, device: I2cDevice, address: int, count: int) -> bytes:
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
_routed: "dict[_FileKey, Adapter]" = {}
_kernel_ioctl: Any = None
_kernel_name = i2c.adapter_name


class Adapter(Protocol):
    """Answers the ``ioctl`` calls on the device file of an I2C bus."""

    def ioctl(self, fd: int, request: int, argument: Any) -> int:
        """Serve one call; raises OSError with the kernel's number."""


class RoutedFile:
    """A file at ``path`` whose ``ioctl`` calls go to an adapter when smbus2 opens it."""

    def __init__(self, adapter: Adapter) -> None:
        global _kernel_ioctl
        self._fd: int | None = os.memfd_create("sim-i2c")  # without a name, so that a killed program leaves no file
        self.path = f"/dev/fd/{self._fd}"
        self._key = _file_key(os.fstat(self._fd))
        if not _routed:
            _kernel_ioctl, _seam.ioctl, _sysfs.adapter_name = _seam.ioctl, _routed_ioctl, _routed_name
        _routed[self._key] = adapter

    def close(self) -> None:
        """Remove the file; a second call does nothing."""
        if _routed.pop(self._key, None) and not _routed:
            _seam.ioctl, _sysfs.adapter_name = _kernel_ioctl, _kernel_name
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None


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
