"""The host's serial port of a simulated rig head."""

from rig.devices.head.protocol import BAUD
from sim.head.board import BYTE_NS, RECEIVER_BYTES, SimHead
from sim.serial_port import VirtualSerial


class HeadSerial(VirtualSerial):
    """An open port for a driver. After the head was unplugged, a new port must be opened."""

    def __init__(self, head: SimHead) -> None:
        super().__init__(head.clock, "sim-head", BAUD, timeout=0.002)
        self.is_open = True
        self._head = head
        self._plugged_out = False
        head.catch_up()
        head.take(head.clock.now_ns())  # bytes that arrived while the port was closed

    def close(self) -> None:
        self.is_open = False

    def unplug(self) -> None:
        """Unplug the head from the computer."""
        self._head.unplugged = True

    def write(self, data: bytes, /) -> int:
        self._require_open()
        if self.baudrate == BAUD:  # at another rate the head receives no valid packet
            self._head.send(bytes(data))
        return len(data)

    @property
    def _unplugged(self) -> bool:
        self._plugged_out = self._plugged_out or self._head.unplugged
        return self._plugged_out

    def _collect(self) -> None:
        self._head.catch_up()
        arrived = self._head.take(self._clock.now_ns())
        if self.baudrate == BAUD:
            self._received += arrived[: RECEIVER_BYTES - len(self._received)]

    def _arrival_ns(self, count: int) -> int:
        # Steps of one byte's duration miss no byte.
        return self._head.arrival_ns(count) or self._clock.now_ns() + BYTE_NS
