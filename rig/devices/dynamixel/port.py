"""The SDK's port on the bench's clock, for any object that reads and writes bytes as pyserial does."""

import errno
import os
import termios
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import serial
from dynamixel_sdk import PortHandler

from rig.core.clock import Clock
from rig.core.errors import DeviceNotFound
from rig.core.next_steps import Do, SomeSteps

READ_SLICE_S = 0.005  # an eighth of a period of the control loop
"""Longest time that one read blocks. It limits the delay of a timeout, and keeps the CPU idle."""

BABBLE_BYTES = 300  # longer than any reply that the rig asks for
"""How many bytes may arrive after a packet's timeout; the SDK itself has no limit."""

QUIET_S, DRAIN_S = 0.005, 0.25
"""How long a bus must be quiet before the next request, and how long to wait for that."""


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
    """Bytes keep arriving, but no packet: another master, a wrong baud rate, or an open bus."""


GUARDIAN = "rig.devices.dynamixel.guardian"
GUARDIAN_S = 5.0  # longer than a dying program holds the port; without supply the guardian must end, too
"""How long the guardian of a killed program tries to switch the torque off."""
_BUSY = (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK)
_BUSY_RETRY_S = 0.05  # the guardian needs a few transactions of the bus to end; shorter: the waiting takes a core


def open_serial(path: str, baud: int, device: str = "servo", clock: Clock | None = None) -> SerialConnection:
    """Open the serial port of ``device`` (a section of the configuration), exclusively for this process.

    With a ``clock``, wait while the guardian of a killed program uses the port.

    Raises `DeviceNotFound`: the next step names the likely reason: no such port, no permission, or another program uses
    it.
    """
    begun_ns = clock.now_ns() if clock else 0
    was_guarded = True  # a guardian may close the port between the attempt to open it and the check of its users
    while True:
        try:
            connection: SerialConnection = serial.Serial(
                path, baud, timeout=READ_SLICE_S, write_timeout=1.0, exclusive=True
            )
        except (serial.SerialException, OSError, ValueError) as error:
            guarded = getattr(error, "errno", None) in _BUSY and _is_used_by_guardian(path)
            waits = getattr(error, "errno", None) in _BUSY and (guarded or was_guarded)
            if clock is None or not waits or clock.now_ns() - begun_ns > 2e9 * GUARDIAN_S:
                raise _not_opened(path, baud, device, error, guarded=guarded) from error
            was_guarded = guarded
            clock.sleep(_BUSY_RETRY_S)
        else:
            return connection


def _not_opened(path: str, baud: int, device: str, error: Exception, *, guarded: bool) -> DeviceNotFound:
    step: SomeSteps
    number = getattr(error, "errno", None)
    if number == errno.EACCES:
        step = "Join the group dialout (`sudo usermod -aG dialout $USER`), then log in again."
    elif guarded:
        step = "Wait some seconds: after a program was killed, its guardian switches the torque off. Then try again."
    elif number in _BUSY:
        step = "Close the other program that uses this port (for example Dynamixel Wizard)."
    else:
        step = (f"Check the USB cable and {device}.port.", Do.FIND())
    reason = os.strerror(number) if number else str(error)
    return DeviceNotFound(
        f"Cannot open the {device}'s port {path}.", next_step=step, evidence={"reason": reason, "baud": baud}
    )


def _is_used_by_guardian(path: str) -> bool:
    port = os.path.realpath(path)
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it ended, or belongs to another user
            is_guardian = GUARDIAN.encode() in (process / "cmdline").read_bytes().split(b"\0")
            if is_guardian and any(os.path.realpath(one) == port for one in (process / "fd").iterdir()):
                return True
    return False


class ClockedPort(PortHandler):  # type: ignore[misc]
    """A `PortHandler` for an open connection, with timeouts on an injected clock.

    Unlike the SDK's own, it uses no CPU time while it waits, and it stops when bytes without a packet keep
    arriving. `reconnect` opens a ``lost`` connection (its adapter was unplugged) again by ``reopen``.
    """

    def __init__(
        self,
        connection: SerialConnection,
        clock: Clock,
        name: str = "",
        reopen: Callable[[], SerialConnection] | None = None,
    ) -> None:
        super().__init__(name)
        self.ser = connection
        self.baudrate = connection.baudrate
        self.is_open = True
        self.tx_time_per_byte = 10_000.0 / self.baudrate
        self.clock = clock
        self.lost = False
        self._reopen = reopen
        self._late_bytes = 0

    def reconnect(self) -> bool:
        """Open a lost connection again; return whether there was one.

        Raises `DeviceNotFound`: the adapter is not connected yet.
        """
        if not self.lost or self._reopen is None:
            return False
        with suppress(serial.SerialException, OSError):
            self.ser.close()
        self.ser = self._reopen()
        self.lost = False
        return True

    def setBaudRate(self, baudrate: int) -> bool:  # noqa: N802 - the SDK's names
        """Set any baud rate that the adapter supports: the SDK's own list lacks 250,000 and 4,500,000.

        Raises `serial.SerialException`, `OSError`, `ValueError`: the adapter does not support it.
        """
        self.ser.baudrate = baudrate
        self.baudrate = baudrate
        self.tx_time_per_byte = 10_000.0 / baudrate
        return True

    def getCurrentTime(self) -> float:  # noqa: N802
        """Return the time in milliseconds, as the SDK expects."""
        return self.clock.now_ns() * 1e-6

    def clearPort(self) -> None:  # noqa: N802
        try:
            self.ser.reset_input_buffer()
        except termios.error as gone:  # unplugged adapter; pyserial does not convert this error
            raise serial.SerialException(*gone.args) from gone

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        return self.ser.write(bytes(packet)) or 0

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Return up to ``length`` bytes; the SDK passes a negative length when it drops an invalid header."""
        if length <= 0:
            return b""
        data: bytes = self.ser.read(length)
        if self.getTimeSinceStart() > self.packet_timeout:
            self._late_bytes += len(data)
            if self._late_bytes > BABBLE_BYTES:
                raise BusBabble
        return data

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        super().setPacketTimeout(packet_length)
        self._late_bytes = 0

    def isPacketTimeout(self) -> bool:  # noqa: N802
        """Return whether the time is over and nothing is left to read: a busy computer may pause this program."""
        return bool(super().isPacketTimeout()) and not self.ser.in_waiting

    def drain(self) -> None:
        """Drop what arrives until the bus has been quiet for `QUIET_S`.

        Otherwise a reply after its timeout would be accepted as the reply to the next request, because Protocol 2.0 has
        no sequence numbers.
        """
        start_ns = last_ns = self.clock.now_ns()
        while (now_ns := self.clock.now_ns()) - last_ns < QUIET_S * 1e9 and now_ns - start_ns < DRAIN_S * 1e9:
            if self.ser.read(256):
                last_ns = self.clock.now_ns()
