"""The SDK's port on the bench's clock, around any object that reads and writes bytes as pyserial's does."""

import errno
import termios
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

import serial
from dynamixel_sdk import PortHandler

from rig.core.clock import Clock
from rig.core.errors import DeviceNotFound

READ_SLICE_S = 0.002
"""How long one read of the wire blocks: bounds how late a timeout is noticed, and keeps the CPU idle meanwhile."""

BABBLE_GRACE_MS = 50.0
"""How far past its timeout a packet may drag on while bytes keep coming; the SDK itself would go on for ever."""


class SerialConnection(Protocol):
    """The part of `serial.Serial` that the port uses."""

    baudrate: int

    @property
    def in_waiting(self) -> int: ...
    def read(self, size: int = 1) -> bytes: ...
    def write(self, data: bytes, /) -> int | None: ...
    def reset_input_buffer(self) -> None: ...
    def close(self) -> None: ...


class BusBabble(Exception):
    """Bytes keep coming, but no packet: another master, a wrong baud rate, an open line."""


def open_serial(path: str, baud: int, device: str = "servo") -> SerialConnection:
    """Open the serial port of a ``device`` (the section of the configuration) for this process alone.

    Raises
    ------
    DeviceNotFound
        With the likely reason: no such port, no permission, another program holds it.
    """
    try:
        wire: SerialConnection = serial.Serial(path, baud, timeout=READ_SLICE_S, write_timeout=1.0, exclusive=True)
    except (serial.SerialException, OSError, ValueError) as error:
        reason = getattr(error, "errno", None)
        if reason == errno.EACCES:
            step = "Add yourself to the group dialout (sudo usermod -aG dialout $USER) and log in again."
        elif reason in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK):
            step = "Close the other program that uses this port (e.g. Dynamixel Wizard, another rig)."
        else:
            step = f"Check the USB cable and {device}.port; `rig find` lists the ports."
        raise DeviceNotFound(
            f"Cannot open the {device}'s port {path}.", next_step=step, evidence={"reason": str(error), "baud": baud}
        ) from error
    return wire


class ClockedPort(PortHandler):  # type: ignore[misc]
    """A `PortHandler` for an open wire whose timeouts run on an injected clock.

    Other than the SDK's own it neither spins while it waits nor waits for ever while the line babbles. A wire that is
    ``lost`` (its adapter was unplugged) is opened anew by `reconnect`, where ``reopen`` says how.
    """

    def __init__(
        self, wire: SerialConnection, clock: Clock, name: str = "", reopen: Callable[[], SerialConnection] | None = None
    ) -> None:
        super().__init__(name)
        self.ser = wire
        self.baudrate = wire.baudrate
        self.is_open = True
        self.tx_time_per_byte = 10_000.0 / self.baudrate
        self.clock = clock
        self.lost = False
        self._reopen = reopen

    def reconnect(self) -> bool:
        """Open a lost wire anew; return whether there was one to open.

        Raises
        ------
        DeviceNotFound
            The adapter is not back yet.
        """
        if not self.lost or self._reopen is None:
            return False
        with suppress(serial.SerialException, OSError):
            self.ser.close()
        self.ser = self._reopen()
        self.lost = False
        return True

    def setBaudRate(self, baudrate: int) -> bool:  # noqa: N802 - the SDK's names
        """Change the baud rate to any that the adapter takes: the SDK's own list lacks 250,000 and 4,500,000.

        Raises
        ------
        serial.SerialException, OSError, ValueError
            The adapter does not take it.
        """
        self.ser.baudrate = baudrate
        self.baudrate = baudrate
        self.tx_time_per_byte = 10_000.0 / baudrate
        return True

    def getCurrentTime(self) -> float:  # noqa: N802
        """Return the time in milliseconds, as the SDK wants it."""
        return self.clock.now_ns() * 1e-6

    def clearPort(self) -> None:  # noqa: N802
        try:
            self.ser.reset_input_buffer()
        except termios.error as gone:  # a pulled adapter; pyserial lets this one through, and it is no OSError
            raise serial.SerialException(*gone.args) from gone

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        return self.ser.write(bytes(packet)) or 0

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Return up to ``length`` bytes; the SDK asks for fewer than none when it drops what was no header."""
        if length <= 0:
            return b""
        data: bytes = self.ser.read(length)
        if data and self.getTimeSinceStart() > self.packet_timeout + BABBLE_GRACE_MS:
            raise BusBabble
        return data

    def drain(self, quiet_s: float = 0.005, limit_s: float = 0.25) -> None:
        """Throw away what arrives until the line has been quiet for ``quiet_s``.

        A reply that comes after its timeout would otherwise be taken for the answer to the next request: Protocol 2.0
        has no sequence numbers.
        """
        start_ns = last_ns = self.clock.now_ns()
        while (now_ns := self.clock.now_ns()) - last_ns < quiet_s * 1e9 and now_ns - start_ns < limit_s * 1e9:
            if self.ser.read(256):
                last_ns = self.clock.now_ns()
