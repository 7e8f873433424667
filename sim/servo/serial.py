"""A simulated serial port on the simulated servo bus: pyserial's interface on the virtual clock."""

import errno
from bisect import insort

import serial

from sim.servo.bus import SentBytes, ServoBus


class SimSerial:
    """An open port with the interface of `serial.Serial`; reads wait on the bus's clock.

    ``baudrate`` and ``timeout`` are as in `serial.Serial`: ``timeout`` in seconds, 0: return the available bytes, None:
    wait without a limit.

    Raises `serial.SerialException`: the bus already has a host.
    """

    def __init__(self, bus: ServoBus, baudrate: int = 57_600, timeout: float | None = None, port: str = "sim") -> None:
        self.port = self.name = port
        self.baudrate = baudrate
        self.timeout = timeout
        self._bus = bus
        self._received = bytearray()
        self._coming: list[SentBytes] = []
        self._taken = 0  # bytes of the first coming frame that have been received
        self._sent_until_ns = 0
        self._unplugged = False
        self.is_open = False
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
            self._taken = 0

    def unplug(self) -> None:
        """Unplug the adapter: bytes on their way are lost, and every later call fails."""
        self.close()
        self._unplugged = True

    def replug(self) -> None:
        """Plug the adapter in; the port must be opened again."""
        self._unplugged = False

    @property
    def in_waiting(self) -> int:
        if self._unplugged:
            raise OSError(errno.EIO, "Input/output error")
        self._require_open()
        self._collect()
        return len(self._received)

    def read(self, size: int = 1) -> bytes:
        """Return up to ``size`` bytes: all as soon as they have arrived, fewer at the timeout.

        Raises `serial.SerialException`: the port is closed or unplugged. `RuntimeError`: there is no timeout, and no
        scheduled event can deliver the missing bytes.
        """
        self._require_open()
        clock = self._bus.clock
        deadline_ns = None if self.timeout is None else clock.now_ns() + round(self.timeout * 1e9)
        self._collect()
        while len(self._received) < size and (deadline_ns is None or clock.now_ns() < deadline_ns):
            wake_ns = [t for t in (deadline_ns, clock.next_event_ns(), self._arrival_ns(size)) if t is not None]
            if not wake_ns:
                raise RuntimeError("this read would never return, because no byte arrives: give the port a timeout")
            clock.advance_to(min(wake_ns))
            self._require_open()
            self._collect()
        data = bytes(self._received[:size])
        del self._received[:size]
        return data

    def write(self, data: bytes, /) -> int:
        self._require_open()
        self._sent_until_ns = self._bus.send(bytes(data), self.baudrate)
        return len(data)

    def flush(self) -> None:
        """Wait until all written bytes are sent."""
        self._require_open()
        if self._sent_until_ns > self._bus.clock.now_ns():
            self._bus.clock.advance_to(self._sent_until_ns)

    def reset_input_buffer(self) -> None:
        """Drop the received bytes; bytes on their way arrive later."""
        self._require_open()
        self._collect()
        self._received.clear()

    def _require_open(self) -> None:
        if self._unplugged:
            raise serial.SerialException(errno.EIO, f"device {self.port} disconnected")
        if not self.is_open:
            raise serial.PortNotOpenError()

    def _deliver(self, frame: SentBytes) -> None:
        insort(self._coming, frame, key=lambda f: f.start_ns)  # a frame may be delayed

    def _collect(self) -> None:
        """Receive the bytes that have arrived; those with another baud rate than the port's are lost."""
        now_ns = self._bus.clock.now_ns()
        while self._coming:
            frame = self._coming[0]
            arrived = frame.arrived(now_ns)
            if frame.baudrate == self.baudrate:
                self._received += frame.data[self._taken : arrived]
            self._taken = arrived
            if arrived < len(frame.data):
                return
            del self._coming[0]
            self._taken = 0

    def _arrival_ns(self, size: int) -> int | None:
        """Return the time at which ``size`` bytes, or all bytes on their way, will have arrived."""
        missing = size - len(self._received)
        taken = self._taken
        arrival_ns = None
        for frame in self._coming:
            available = len(frame.data) - taken
            # Frames that overlap are received one after the other.
            arrival_ns = max(arrival_ns or 0, frame.arrival_ns(taken + min(missing, available)))
            missing -= available
            if missing <= 0:
                break
            taken = 0
        return arrival_ns
