"""The host's serial port of a simulated rig head: pyserial's interface on the virtual clock."""

import errno

import serial

from rig.devices.head.protocol import BAUD
from sim.head.board import BYTE_NS, RECEIVER_BYTES, SimHead


class HeadSerial:
    """An open `serial.Serial` for a driver; reads wait on the virtual clock.

    ``timeout`` is in seconds. After the head is unplugged, every call fails. When it is plugged in again, a new port
    must be opened.

    Raises `serial.SerialException`: another port is open on this head.
    """

    def __init__(self, head: SimHead) -> None:
        self.port = self.name = "sim-head"
        self.baudrate = BAUD
        self.timeout = 0.002
        self.is_open = True
        self._head = head
        self._plugged_out = False
        self._received = bytearray()
        head.catch_up()
        head.take(head.clock.now_ns())  # bytes that arrived while the port was closed

    def close(self) -> None:
        self.is_open = False

    def unplug(self) -> None:
        """Unplug the head from the computer."""
        self._head.unplugged = True

    @property
    def in_waiting(self) -> int:
        self._collect()
        return len(self._received)

    def read(self, size: int = 1) -> bytes:
        """Return ``size`` bytes when they have arrived, or fewer at the timeout."""
        clock = self._head.clock
        deadline_ns = clock.now_ns() + round(self.timeout * 1e9)
        self._collect()
        while len(self._received) < size and clock.now_ns() < deadline_ns:
            # Steps of one byte's duration miss no byte.
            arrival_ns = self._head.arrival_ns(size - len(self._received)) or clock.now_ns() + BYTE_NS
            clock.advance_to(min(arrival_ns, deadline_ns))
            self._collect()
        data = bytes(self._received[:size])
        del self._received[:size]
        return data

    def write(self, data: bytes, /) -> int:
        self._require_open()
        if self.baudrate == BAUD:  # at another rate the head receives no valid packet
            self._head.send(bytes(data))
        return len(data)

    def reset_input_buffer(self) -> None:
        self._collect()
        self._received.clear()

    def _collect(self) -> None:
        self._require_open()
        self._head.catch_up()
        arrived = self._head.take(self._head.clock.now_ns())
        if self.baudrate == BAUD:
            self._received += arrived[: RECEIVER_BYTES - len(self._received)]

    def _require_open(self) -> None:
        self._plugged_out = self._plugged_out or self._head.unplugged
        if self._plugged_out:
            raise serial.SerialException(errno.EIO, f"device {self.port} disconnected")
        if not self.is_open:
            raise serial.PortNotOpenError()
