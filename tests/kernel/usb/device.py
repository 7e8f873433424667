"""A played USB device: its standard requests (USB 2.0, chapter 9.4), and its life from plug to plug."""

import socket
import struct
from contextlib import suppress
from dataclasses import dataclass
from threading import Thread
from typing import Final

from tests.kernel.usb import descriptors
from tests.kernel.usb.descriptors import Identity, Speed
from tests.kernel.usb.usbip import NotUsbIp, Plug, Stall

TO_HOST: Final = 0x80
STANDARD, CLASS, VENDOR = 0x00, 0x20, 0x40
TO_INTERFACE, TO_ENDPOINT = 0x01, 0x02
_GET_STATUS, _CLEAR_FEATURE, _SET_FEATURE = 0, 1, 3
_GET_DESCRIPTOR, _GET_CONFIGURATION, _SET_CONFIGURATION, _GET_INTERFACE, _SET_INTERFACE = 6, 8, 9, 10, 11
_ENDPOINT_HALT = 0
_FIXED: Final = {
    _GET_STATUS: b"\x00\x00",
    _GET_CONFIGURATION: b"\x01",
    _GET_INTERFACE: b"\x00",
    **dict.fromkeys((_SET_CONFIGURATION, _SET_FEATURE), b""),
}
"""Answers that are always the same: each device has one configuration, and Linux never asks for a setting."""
_SETUP = struct.Struct("<BBHHH")


@dataclass(frozen=True, slots=True)
class Request:
    """A control transfer: its setup packet, and the host's bytes."""

    kind: int
    number: int
    value: int
    index: int
    length: int
    data: bytes = b""

    @property
    def reading(self) -> bool:
        return bool(self.kind & TO_HOST)


class UsbDevice:
    """A device that a USB/IP host can use, at one host at a time.

    A subclass gives ``identity``, ``speed`` and ``configuration``, answers its own requests in `request`, and gets the
    host's bytes in `receive`. It sends bytes by ``plug.deliver``.
    """

    identity: Identity
    speed: Speed = Speed.HIGH
    configuration: bytes

    def __init__(self) -> None:
        self.plug: Plug | None = None
        """The connection; None while it is not plugged in."""
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        """TCP port on this computer at which a host plugs the device in."""
        self._thread = Thread(target=self._serve, name=type(self).__name__, daemon=True)
        self._thread.start()

    # -- life -------------------------------------------------------------------------------------------------------

    def unplug(self) -> None:
        """Pull the device's cable."""
        if self.plug is not None:
            self.plug.close()

    def close(self) -> None:
        """End the device."""
        self._listener.close()
        self.unplug()

    def _serve(self) -> None:
        while True:
            try:
                connection = self._listener.accept()[0]
            except OSError:  # closed
                return
            with connection:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self.plug = Plug(connection, self)
                self.plugged()
                with suppress(NotUsbIp):
                    self.plug.run()
                self.plug = None
                self.unplugged()

    # -- for subclasses ---------------------------------------------------------------------------------------------

    def plugged(self) -> None:
        """Begin with the settings of the power-up."""

    def unplugged(self) -> None:
        """End what the host has started."""

    def request(self, request: Request) -> bytes:
        """Answer a request of the device's class or vendor; raises `Stall` or `Hang`."""
        raise Stall

    def receive(self, endpoint: int, data: bytes) -> None:
        """Receive the host's bytes."""

    def asked(self, endpoint: int) -> None:
        """Note that the host waits for bytes from an endpoint."""

    def halt_cleared(self, endpoint: int) -> None:
        """Start an endpoint again."""

    def interface_set(self, interface: int, setting: int) -> None:
        """Change to an alternate setting of an interface."""

    # -- standard requests ------------------------------------------------------------------------------------------

    def control(self, setup: bytes, data: bytes) -> bytes:
        """Return the answer to a control transfer; raises `Stall` or `Hang`."""
        request = Request(*_SETUP.unpack(setup), data)
        if request.kind & 0x60 != STANDARD:
            return self.request(request)
        if request.number == _GET_DESCRIPTOR:
            answer = self._descriptor(request.value >> 8, request.value & 0xFF)
            return self.request(request) if answer is None else answer
        if request.number in _FIXED:
            return _FIXED[request.number]
        if request.number == _SET_INTERFACE:
            self.interface_set(request.index, request.value)
            return b""
        if request.number == _CLEAR_FEATURE:
            if request.kind == TO_ENDPOINT and request.value == _ENDPOINT_HALT:
                self.halt_cleared(request.index)
            return b""
        raise Stall

    def _descriptor(self, kind: int, index: int) -> bytes | None:
        match kind:
            case descriptors.DEVICE:
                return self.identity.device()
            case descriptors.CONFIGURATION:
                return self.configuration
            case descriptors.STRING:
                text = self.identity.string(index)
                if text is None:
                    raise Stall
                return text
            case descriptors.QUALIFIER if self.speed is Speed.HIGH:
                return self.identity.qualifier()
            case descriptors.STORE:
                return self.identity.store()
        return None
