"""Descriptors of USB devices (USB 2.0, chapter 9.6)."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Self

DEVICE, CONFIGURATION, STRING, INTERFACE, ENDPOINT, QUALIFIER = 1, 2, 3, 4, 5, 6
ASSOCIATION, STORE, COMPANION = 11, 15, 0x30
ISOCHRONOUS, BULK, INTERRUPT = 1, 2, 3
ENGLISH = b"\x09\x04"
_CAPABILITY = 0x10
_FIRST_WITH_STORE = 0x0201


class Speed(IntEnum):
    """Speed of a device, with the numbers of the kernel (enum usb_device_speed)."""

    LOW = 1
    FULL = 2
    HIGH = 3
    SUPER = 5


@dataclass(frozen=True, slots=True)
class Identity:
    """The identity of a device; ``kind`` is class, subclass and protocol.

    ``indices`` are those of the texts for manufacturer, name and serial number; ``functions`` those of the texts for
    its interfaces, which are its name.
    """

    vendor: int
    product: int
    release: int
    manufacturer: str
    name: str
    serial: str
    usb: int = 0x200
    kind: tuple[int, int, int] = (0, 0, 0)
    packet_bytes: int = 64
    indices: tuple[int, int, int] = (1, 2, 3)
    functions: frozenset[int] = frozenset()

    @classmethod
    def read(cls, device: bytes, configuration: bytes, texts: tuple[str, str, str]) -> Self:
        """Return the identity of a device from its descriptors; it has those of the texts that have an index there."""
        usb, *kind, packet_bytes, vendor, product, release = struct.unpack_from("<H4B3H", device, 2)
        indices = device[14], device[15], device[16]
        manufacturer, name, serial = (text if index else "" for text, index in zip(texts, indices, strict=True))
        named = {part[-1] for part in parts(configuration) if part[1] in (INTERFACE, ASSOCIATION)}
        return cls(
            *(vendor, product, release, manufacturer, name, serial, usb),
            (kind[0], kind[1], kind[2]),
            packet_bytes,
            indices,
            frozenset(named - {0}),
        )

    def at_super_speed(self) -> Self:
        """Return the identity that the device has at SuperSpeed: its endpoint 0 takes 2⁹ bytes."""
        return replace(self, usb=0x0300, packet_bytes=9)

    @property
    def strings(self) -> tuple[str, ...]:
        return self.manufacturer, self.name, self.serial

    def device(self) -> bytes:
        """Return the device descriptor."""
        indices = (index if text else 0 for index, text in zip(self.indices, self.strings, strict=True))
        ids = (self.vendor, self.product, self.release)
        return struct.pack("<BBH4B3H4B", 18, DEVICE, self.usb, *self.kind, self.packet_bytes, *ids, *indices, 1)

    def qualifier(self) -> bytes:
        """Return the device qualifier of a high-speed device."""
        return struct.pack("<BBH6B", 10, QUALIFIER, self.usb, *self.kind, self.packet_bytes, 1, 0)

    def string(self, index: int) -> bytes | None:
        """Return a string descriptor; None if there is none."""
        if index == 0:
            return bytes([4, STRING]) + ENGLISH
        texts = {**dict.fromkeys(self.functions, self.name), **dict(zip(self.indices, self.strings, strict=True))}
        text = texts.get(index, "").encode("utf-16-le")
        return bytes([2 + len(text), STRING]) + text if text else None

    def store(self) -> bytes | None:
        """Return the binary device object store, which newer devices have (USB 3.2, 9.6.2); None for an older one.

        It says that the device is capable of SuperSpeed, too.
        """
        if self.usb < _FIRST_WITH_STORE:
            return None
        extension = struct.pack("<3BI", 7, _CAPABILITY, 2, 0)
        super_speed = struct.pack("<4BHBBH", 10, _CAPABILITY, 3, 0, 0b1110, 1, 10, 0x7FF)
        return struct.pack("<BBHB", 5, STORE, 5 + len(extension + super_speed), 2) + extension + super_speed


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


def at_super_speed(configuration: bytes) -> bytes:
    """Return a configuration as a device has it at SuperSpeed: each endpoint has a companion (USB 3.2, 9.6.7).

    The additional packets in a microframe of a fast isochronous endpoint become those of one interval.
    """
    body = []
    for part in parts(configuration)[1:]:
        if part[1] == COMPANION:
            continue
        body.append(part)
        if part[1] == ENDPOINT:
            size = int.from_bytes(part[4:6], "little")
            more, isochronous = size >> 11 & 3, part[3] & 3 == ISOCHRONOUS
            packet_bytes = 1024 if more or part[3] & 3 == BULK else size
            body[-1] = part[:4] + packet_bytes.to_bytes(2, "little") + part[6:]
            interval_bytes = 0 if part[3] & 3 == BULK else (size & 0x7FF) * (1 + more)
            body.append(struct.pack("<4BH", 6, COMPANION, 0, more if isochronous else 0, interval_bytes))
    rest = b"".join(body)
    power = configuration[8] // 4  # in 8 mA instead of 2 mA
    return configuration[:2] + (9 + len(rest)).to_bytes(2, "little") + configuration[4:8] + bytes([power]) + rest


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
