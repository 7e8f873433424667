"""The interface of pyserial on the virtual clock, for the ports of simulated devices."""

import errno
from abc import abstractmethod

import serial

from sim.clock import VirtualClock


class VirtualSerial:
    """An open port with the part of `serial.Serial` that drivers use; reads wait on the virtual clock.

    ``timeout`` is in seconds. While the device is unplugged, every call fails as on a real port.
    """

    def __init__(self, clock: VirtualClock, name: str, baudrate: int, timeout: float) -> None:
        self.port = self.name = name
        self.baudrate = baudrate
        self.timeout = timeout
        self.is_open = False
        self._clock = clock
        self._received = bytearray()

    @property
    @abstractmethod
    def _unplugged(self) -> bool: ...

    @abstractmethod
    def _collect(self) -> None:
        """Move the bytes that have arrived to the received ones."""

    @abstractmethod
    def _arrival_ns(self, count: int) -> int | None:
        """Return when ``count`` further bytes, or all on their way, will have arrived; None: unknown."""

    @property
    def in_waiting(self) -> int:
        if self._unplugged:
            raise OSError(errno.EIO, "Input/output error")
        self._require_open()
        self._collect()
        return len(self._received)

    def read(self, size: int = 1) -> bytes:
        """Return ``size`` bytes as soon as they have arrived, fewer at the timeout.

        Raises `serial.SerialException`: the port is closed or unplugged.
        """
        clock = self._clock
        deadline_ns = clock.now_ns() + round(self.timeout * 1e9)
        while True:
            self._require_open()
            self._collect()
            missing = size - len(self._received)
            if missing <= 0 or clock.now_ns() >= deadline_ns:
                break
            wake_ns = self._arrival_ns(missing)
            if wake_ns is None:  # an event, such as the answer of a device, may bring bytes
                wake_ns = clock.next_event_ns()
            clock.advance_to(deadline_ns if wake_ns is None else min(wake_ns, deadline_ns))
        data = bytes(self._received[:size])
        del self._received[:size]
        return data

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
