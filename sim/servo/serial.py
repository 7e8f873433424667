"""A simulated serial port on the simulated servo bus."""

import errno

import serial

from sim.serial_port import VirtualSerial
from sim.servo.bus import SentBytes, ServoBus


class SimSerial(VirtualSerial):
    """The host's adapter on the bus, open.

    Raises `serial.SerialException`: the bus already has a host.
    """

    _unplugged = False

    def __init__(self, bus: ServoBus, baudrate: int = 57_600, timeout: float = 0.0) -> None:
        super().__init__(bus.clock, "sim", baudrate, timeout)
        self._bus = bus
        self._coming: list[tuple[int, int, int, int]] = []
        """Bytes on their way: start of their frame, arrival (ns), baud rate and value, in the order of the frames."""
        self.open()

    def open(self) -> None:
        if self.is_open:
            raise serial.SerialException("Port is already open.")
        if self._unplugged:
            raise serial.SerialException(errno.ENOENT, f"could not open port {self.port}: No such file or directory")
        if not self._bus.connect(self._deliver):
            raise serial.SerialException(
                errno.EBUSY, f"Could not exclusively lock port {self.port}: another host is on this bus"
            )
        self.is_open = True

    def close(self) -> None:
        if self.is_open:
            self.is_open = False
            self._bus.disconnect()
            self._received.clear()
            self._coming.clear()

    def unplug(self) -> None:
        """Unplug the adapter: bytes on their way are lost, and every later call fails."""
        self.close()
        self._unplugged = True

    def replug(self) -> None:
        """Plug the adapter in; the port must be opened again."""
        self._unplugged = False

    def write(self, data: bytes, /) -> int:
        self._require_open()
        self._bus.send(bytes(data), self.baudrate)
        return len(data)

    def _deliver(self, frame: SentBytes) -> None:
        arrivals = (frame.arrival_ns(count) for count in range(1, len(frame.data) + 1))
        each = zip(arrivals, frame.data, strict=True)
        self._coming += [(frame.start_ns, arrival_ns, frame.baudrate, byte) for arrival_ns, byte in each]
        self._coming.sort(key=lambda coming: coming[0])  # a frame may be delayed

    def _collect(self) -> None:
        """Receive the bytes that have arrived; those with another baud rate than the port's are lost."""
        now_ns = self._clock.now_ns()
        while self._coming and self._coming[0][1] <= now_ns:
            _, _, baudrate, byte = self._coming.pop(0)
            if baudrate == self.baudrate:
                self._received.append(byte)

    def _arrival_ns(self, count: int) -> int | None:
        # Frames that overlap are received one after the other.
        return max((arrival_ns for _, arrival_ns, _, _ in self._coming[:count]), default=None)
