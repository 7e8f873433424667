"""Descriptors of USB devices (USB 2.0, chapter 9.6)."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

DEVICE, CONFIGURATION, STRING, INTERFACE, ENDPOINT, QUALIFIER = 1, 2, 3, 4, 5, 6
BULK, INTERRUPT = 2, 3
ENGLISH = b"\x09\x04"


class Speed(IntEnum):
    """Speed of a device, with the numbers of the kernel (enum usb_device_speed)."""

    LOW = 1
    FULL = 2
    HIGH = 3


@dataclass(frozen=True, slots=True)
class Identity:
    """The identity of a device; ``kind`` is class, subclass and protocol."""

    vendor: int
    product: int
    release: int
    manufacturer: str
    name: str
    serial: str
    usb: int = 0x200
    kind: tuple[int, int, int] = (0, 0, 0)
    packet_bytes: int = 64

    @property
    def strings(self) -> tuple[str, ...]:
        return self.manufacturer, self.name, self.serial

    def device(self) -> bytes:
        """Return the device descriptor."""
        indices = (number if text else 0 for number, text in enumerate(self.strings, 1))
        ids = (self.vendor, self.product, self.release)
        return struct.pack("<BBH4B3H4B", 18, DEVICE, self.usb, *self.kind, self.packet_bytes, *ids, *indices, 1)

    def qualifier(self) -> bytes:
        """Return the device qualifier of a high-speed device."""
        return struct.pack("<BBH6B", 10, QUALIFIER, self.usb, *self.kind, self.packet_bytes, 1, 0)

    def string(self, index: int) -> bytes | None:
        """Return a string descriptor; None if there is none."""
        if index == 0:
            return bytes([4, STRING]) + ENGLISH
        if index > len(self.strings) or not self.strings[index - 1]:
            return None
        text = self.strings[index - 1].encode("utf-16-le")
        return bytes([2 + len(text), STRING]) + text


def interface(number: int, kind: tuple[int, int, int], endpoints: int = 0, name: int = 0) -> bytes:
    """Return the descriptor of an interface of class, subclass and protocol ``kind``."""
    return struct.pack("9B", 9, INTERFACE, number, 0, endpoints, *kind, name)


def endpoint(address: int, kind: int, packet_bytes: int) -> bytes:
    """Return the descriptor of an endpoint; bit 7 of ``address`` is set if it sends to the host."""
    return struct.pack("<BBBBHB", 7, ENDPOINT, address, kind, packet_bytes, 0)


def configuration(body: Sequence[bytes], interfaces: int = 1, milliamps: int = 100) -> bytes:
    """Return the configuration descriptor with its interfaces and endpoints."""
    rest = b"".join(body)
    return struct.pack("<BBHBBBBB", 9, CONFIGURATION, 9 + len(rest), interfaces, 1, 0, 0x80, milliamps // 2) + rest


def parts(descriptors: bytes) -> list[bytes]:
    """Divide a configuration into its descriptors; raises ValueError if their lengths do not add up."""
    found = []
    while descriptors:
        length = descriptors[0]
        if not 2 <= length <= len(descriptors):
            raise ValueError(f"a descriptor of {length} bytes, {len(descriptors)} bytes before the end")
        found.append(descriptors[:length])
        descriptors = descriptors[length:]
    return found
