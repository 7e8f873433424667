"""USB/IP: the protocol between Linux's virtual USB host (``vhci-hcd``) and the device at the other end of a socket.

Source: Documentation/usb/usbip_protocol.rst of the kernel, version 1.1.1; isochronous transfers to the device are left
out.
"""

import socket
import struct
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from errno import ECONNRESET, EPIPE
from threading import Lock
from typing import Final, Protocol

CMD_SUBMIT, CMD_UNLINK, RET_SUBMIT, RET_UNLINK = 1, 2, 3, 4
HEADER: Final = 48
MAX_LENGTH: Final = 1 << 20
"""No transfer of the drivers in use is longer."""

_BASE = struct.Struct(">5I")  # command, sequence number, device, direction, endpoint
_SUBMIT = struct.Struct(">Iiiii8s")  # flags, length, start frame, number of packets, interval, setup
_ANSWER = struct.Struct(">5Ii i i i i 8x")  # base; status, actual length, start frame, number of packets, errors
_UNLINKED = struct.Struct(">5Ii24x")
_PACKET = struct.Struct(">4i")  # offset, length, actual length, status
MAX_PACKETS: Final = 1024
_READ_BYTES: Final = 65_536


class NotUsbIp(ValueError):
    """The bytes are no request of USB/IP."""


@dataclass(frozen=True, slots=True)
class Submit:
    """A transfer that the host asks for; ``data`` are the host's bytes, ``length`` how many it can receive.

    An isochronous transfer has ``packets``: where the bytes of each are in the host's buffer, and how many it can
    receive.
    """

    number: int
    endpoint: int
    reading: bool
    length: int
    setup: bytes
    data: bytes = b""
    packets: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, slots=True)
class Unlink:
    """The host does not wait for the transfer ``victim`` any more."""

    number: int
    victim: int


class Receiver:
    """Divides the host's bytes into requests."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def feed(self, data: bytes) -> Iterator[Submit | Unlink]:
        """Yield each request that is complete; raises `NotUsbIp`."""
        self._bytes += data
        while len(self._bytes) >= HEADER:
            command, number, _, direction, endpoint = _BASE.unpack_from(self._bytes)
            if command == CMD_UNLINK:
                victim = int.from_bytes(self._bytes[20:24], "big")
                del self._bytes[:HEADER]
                yield Unlink(number, victim)
                continue
            _, length, _, packets, _, setup = _SUBMIT.unpack_from(self._bytes, _BASE.size)
            count = max(packets, 0)  # some kernels say -1 for none
            valid = direction <= 1 and endpoint <= 15 and 0 <= length <= MAX_LENGTH and count <= direction * MAX_PACKETS
            if command != CMD_SUBMIT or not valid:
                raise NotUsbIp(f"command {command}, endpoint {endpoint}, length {length}, packets {packets}")
            end = HEADER + _PACKET.size * count if direction else HEADER + length
            if len(self._bytes) < end:
                return
            payload = bytes(self._bytes[HEADER:end])
            del self._bytes[:end]
            parts = tuple((offset, size) for offset, size, _, _ in _PACKET.iter_unpack(payload)) if count else ()
            yield Submit(number, endpoint, bool(direction), length, setup, b"" if direction else payload, parts)


def submit(request: Submit) -> bytes:
    """Return a request as the host sends it."""
    base = _BASE.pack(CMD_SUBMIT, request.number, 1, request.reading, request.endpoint)
    packets = b"".join(_PACKET.pack(*packet, 0, 0) for packet in request.packets)
    return base + _SUBMIT.pack(0, request.length, 0, len(request.packets), 0, request.setup) + request.data + packets


def unlink(request: Unlink) -> bytes:
    """Return a request as the host sends it."""
    return _BASE.pack(CMD_UNLINK, request.number, 1, 0, 0) + struct.pack(">I24x", request.victim)


def answer(number: int, status: int, data: bytes = b"", received: int | None = None) -> bytes:
    """Return the end of a transfer: the device's bytes, or how many of the host's were ``received``."""
    return (
        _ANSWER.pack(RET_SUBMIT, number, 0, 0, 0, status, len(data) if received is None else received, 0, 0, 0) + data
    )


def answer_packets(request: Submit, contents: list[bytes]) -> bytes:
    """Return the end of an isochronous transfer with the bytes of its packets, which are not padded."""
    data = b"".join(contents)
    parts = zip(request.packets, contents, strict=True)
    packets = b"".join(_PACKET.pack(*packet, len(content), 0) for packet, content in parts)
    head = _ANSWER.pack(RET_SUBMIT, request.number, 0, 0, 0, 0, len(data), 0, len(contents), 0)
    return head + data + packets


class Stall(Exception):
    """The device does not support a request."""


class Hang(Exception):
    """The device does not answer a request; the host ends it after a while."""


class Device(Protocol):
    """The interface of a device for `Plug`."""

    def control(self, setup: bytes, data: bytes) -> bytes:
        """Return the answer to a control transfer; raises `Stall` or `Hang`."""

    def receive(self, endpoint: int, data: bytes) -> None:
        """Receive the host's bytes."""

    def asked(self, endpoint: int) -> None:
        """Note that the host waits for bytes from an endpoint."""


class Plug:
    """The connection of a device with its host, until either end closes it.

    Transfers to the host end in the order in which the host asked for them. The end of a transfer and its cancellation
    exclude each other: a host that gets both closes the connection.
    """

    def __init__(self, connection: socket.socket, device: Device) -> None:
        self._connection = connection
        self._device = device
        self._lock = Lock()
        self._waiting: dict[int, deque[Submit]] = {}

    def run(self) -> None:
        """Serve the host until the connection ends."""
        receiver = Receiver()
        with suppress(OSError):  # the connection was closed
            while data := self._connection.recv(_READ_BYTES):
                for request in receiver.feed(data):
                    self._serve(request)

    def close(self) -> None:
        """Pull the plug."""
        with suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)

    def waiting(self, endpoint: int) -> int:
        """Return how many transfers of an endpoint the host waits for."""
        return len(self._waiting.get(endpoint, ()))

    def deliver(self, endpoint: int, produce: Callable[[int], bytes]) -> bool:
        """End the oldest transfer from an endpoint with the bytes of ``produce(length)``; False: there is none.

        For an isochronous transfer it is called for each packet.
        """
        with self._lock:
            queue = self._waiting.get(endpoint)
            if not queue:
                return False
            request = queue.popleft()
            if request.packets:
                self._send(answer_packets(request, [produce(length)[:length] for _, length in request.packets]))
            else:
                self._send(answer(request.number, 0, produce(request.length)[: request.length]))
            return True

    def _serve(self, request: Submit | Unlink) -> None:
        match request:
            case Unlink():
                self._cancel(request)
            case Submit(endpoint=0):
                self._control(request)
            case Submit(reading=True):
                self._wait(request)
                self._device.asked(request.endpoint)
            case Submit():
                self._device.receive(request.endpoint, request.data)
                self._send_locked(answer(request.number, 0, received=len(request.data)))

    def _control(self, request: Submit) -> None:
        try:
            data = self._device.control(request.setup, request.data)
        except Stall:
            self._send_locked(answer(request.number, -EPIPE, received=0))
        except Hang:
            self._wait(request)
        else:
            received = None if request.reading else len(request.data)
            self._send_locked(answer(request.number, 0, data[: request.length], received))

    def _wait(self, request: Submit) -> None:
        with self._lock:
            self._waiting.setdefault(request.endpoint, deque()).append(request)

    def _cancel(self, request: Unlink) -> None:
        with self._lock:
            status = 0
            for queue in self._waiting.values():
                for waiting in [one for one in queue if one.number == request.victim]:
                    queue.remove(waiting)
                    status = -ECONNRESET
            self._send(_UNLINKED.pack(RET_UNLINK, request.number, 0, 0, 0, status))

    def _send_locked(self, data: bytes) -> None:
        with self._lock:
            self._send(data)

    def _send(self, data: bytes) -> None:
        with suppress(OSError):  # the connection has ended; `run` ends too
            self._connection.sendall(data)
