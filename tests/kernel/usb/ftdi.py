"""A played FT232H with the identity of a U2D2: a serial adapter for the driver ``ftdi_sio``.

Sources: the kernel's drivers/usb/serial/ftdi_sio.h; FTDI AN232B-04 (latency timer) and AN232B-05 (baud rates).
"""

import os
from collections.abc import Callable
from contextlib import suppress
from enum import IntEnum
from typing import Final

from rig.devices.dynamixel.port import SerialConnection
from sim.realtime.pace import RealTime
from tests.kernel.usb.descriptors import BULK, Identity, configuration, endpoint, interface
from tests.kernel.usb.device import Request, UsbDevice
from tests.kernel.usb.usbip import Stall

FROM_DEVICE, TO_DEVICE = 1, 2
PACKET_BYTES: Final = 512
STATUS: Final = b"\x01\x60"  # modem and line status, before the bytes of each packet
DEFAULT_LATENCY_MS: Final = 16

_DISCARD_RECEIVED = 1
_EIGHTHS: Final = (0, 4, 2, 1, 3, 5, 6, 7)
"""The fraction of the divisor in eighths, by its code."""
_RATES: Final = (
    *(9_600, 19_200, 57_600, 115_200, 200_000, 250_000, 500_000),
    *(1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000),
)
_RATE_ERROR: Final = 0.03


class Command(IntEnum):
    """Requests of an FTDI chip."""

    RESET = 0
    MODEM_CONTROL = 1
    FLOW_CONTROL = 2
    BAUD = 3
    DATA = 4
    MODEM_STATUS = 5
    SET_LATENCY = 9
    GET_LATENCY = 10
    READ_EEPROM = 0x90
    OTHER = -1

    @classmethod
    def _missing_(cls, _: object) -> "Command":
        return cls.OTHER


def baud_rate(value: int, index: int) -> int:
    """Return the baud rate that the divisor of a request means: the nominal one, if a servo could receive it."""
    eighths = (value & 0x3FFF) * 8 + _EIGHTHS[value >> 14 | (index >> 8 & 1) << 2]
    base = 12_000_000 if index & 0x200 else 3_000_000
    rate = base * 8 / eighths if eighths else base
    nominal = min(_RATES, key=lambda known: abs(known - rate))
    return nominal if abs(nominal - rate) < _RATE_ERROR * nominal else round(rate)


class FtdiAdapter(UsbDevice):
    """A serial adapter in front of a simulated connection, in real time.

    Received bytes wait until a packet is full or the latency timer has run out. The bench's `RealTime` pumps the
    adapter, as it does with a pseudo-terminal.

    Parameters
    ----------
    connection
        The simulated connection.
    serial
        Its serial number.
    """

    def __init__(self, connection: SerialConnection, serial: str = "FT7WBGZ1") -> None:
        self.identity = Identity(0x0403, 0x6014, 0x0900, "FTDI", "USB <-> Serial Converter", serial)
        ends = (endpoint(0x80 | FROM_DEVICE, BULK, PACKET_BYTES), endpoint(TO_DEVICE, BULK, PACKET_BYTES))
        self.configuration = configuration([interface(0, (255, 255, 255), 2, 2), *ends], milliamps=90)
        self.latency_ms = DEFAULT_LATENCY_MS
        self.time: RealTime | None = None
        self._connection = connection
        self._received = bytearray()
        self._due_ns = 0
        self._awake = os.eventfd(0, os.EFD_NONBLOCK)
        super().__init__()

    def close(self) -> None:
        super().close()
        if self._awake >= 0:
            os.close(self._awake)
            self._awake = -1

    def plugged(self) -> None:
        self.latency_ms = DEFAULT_LATENCY_MS

    def unplugged(self) -> None:
        self._received.clear()

    # -- the host ---------------------------------------------------------------------------------------------------

    def request(self, request: Request) -> bytes:
        match Command(request.number), request.reading:
            case Command.MODEM_CONTROL | Command.FLOW_CONTROL | Command.DATA, False:
                return b""
            case Command.RESET, False:
                if request.value == _DISCARD_RECEIVED:
                    self._with_time(self._received.clear)
                return b""
            case Command.BAUD, False:
                self._connection.baudrate = baud_rate(request.value, request.index)
                return b""
            case Command.SET_LATENCY, False:
                self.latency_ms = request.value & 0xFF
                return b""
            case Command.MODEM_STATUS, True:
                return STATUS
            case Command.GET_LATENCY, True:
                return bytes([self.latency_ms])
            case Command.READ_EEPROM, True:
                return b"\xff\xff"
        raise Stall

    def receive(self, endpoint: int, data: bytes) -> None:
        """Send the host's bytes to the servo."""
        self._with_time(lambda: self._connection.write(data))
        os.eventfd_write(self._awake, 1)

    # -- as a port of `RealTime` ------------------------------------------------------------------------------------

    def fileno(self) -> int:
        """Return the file descriptor that becomes readable when the host has written."""
        return self._awake

    def pump(self) -> bool:
        """Give received bytes to the host, if it is time; return whether there were any."""
        with suppress(BlockingIOError):
            os.eventfd_read(self._awake)
        assert self.time is not None
        now_ns = self.time.now_ns()
        if waiting := self._connection.in_waiting:
            if not self._received:
                self._due_ns = now_ns + self.latency_ms * 1_000_000
            self._received += self._connection.read(waiting)
        if self.plug is None:
            self._received.clear()
        if not self._received:
            return bool(waiting)
        full = len(self._received) >= PACKET_BYTES - len(STATUS)
        if (full or now_ns >= self._due_ns) and self.plug is not None and self.plug.deliver(FROM_DEVICE, self._packet):
            self._due_ns = now_ns + self.latency_ms * 1_000_000
        return True

    def _packet(self, length: int) -> bytes:
        count = min(length, PACKET_BYTES) - len(STATUS)
        data = bytes(self._received[:count])
        del self._received[:count]
        return STATUS + data

    def _with_time(self, action: Callable[[], object]) -> None:
        assert self.time is not None
        with self.time.present():
            action()
