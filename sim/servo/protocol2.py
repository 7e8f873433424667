"""The device's side of Dynamixel Protocol 2.0: it receives instruction packets and sends status packets.

Source: e-manual "DYNAMIXEL Protocol 2.0" (packet format, byte stuffing) and "CRC Calculation" (CRC-16 of 0x8005).
"""

from dataclasses import dataclass
from enum import IntEnum

BROADCAST_ID = 0xFE
MAX_ID = 0xFC
ALERT = 0x80  # bit of a status packet's error byte: Hardware Error Status is not 0

MAX_LENGTH = 1024  # largest valid value of a length field; a larger one is noise that looks like a header

_HEADER = b"\xff\xff\xfd"
_STUFFED = _HEADER + b"\xfd"
_FIXED = 7  # header, reserved, id, length
_STATUS = 0x55


class Instruction(IntEnum):
    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08


class StatusError(IntEnum):
    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


@dataclass(frozen=True, slots=True)
class InstructionPacket:
    """An instruction of the host; if it is not ``intact`` (its CRC is wrong), only the id is valid."""

    bus_id: int
    instruction: int
    parameters: bytes
    intact: bool = True


def _crc_of_byte(byte: int) -> int:
    crc = byte << 8
    for _ in range(8):
        crc = (crc << 1 ^ 0x8005) & 0xFFFF if crc & 0x8000 else crc << 1
    return crc


_CRC_TABLE = tuple(_crc_of_byte(byte) for byte in range(256))


def crc16(data: bytes) -> int:
    """Return the CRC-16 of ``data`` (polynomial 0x8005, not reflected)."""
    crc = 0
    for byte in data:
        crc = (crc << 8) & 0xFFFF ^ _CRC_TABLE[crc >> 8 ^ byte]
    return crc


def word(data: bytes, start: int = 0) -> int:
    """Return the two bytes at ``start``, low byte first."""
    return data[start] | data[start + 1] << 8


def with_crc(frame: bytes) -> bytes:
    return frame + crc16(frame).to_bytes(2, "little")


class PacketParser:
    """Finds instruction packets in a stream of bytes that arrives in pieces of any size, with noise."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def reset(self) -> None:
        """Drop an incomplete packet."""
        self._buffer.clear()

    def feed(self, data: bytes) -> list[InstructionPacket]:
        """Return the packets that ``data`` completes."""
        buffer = self._buffer
        buffer += data
        packets: list[InstructionPacket] = []
        while (start := buffer.find(_HEADER)) >= 0:
            del buffer[:start]
            if len(buffer) < _FIXED:
                return packets
            length = int.from_bytes(buffer[5:7], "little")
            plausible = (
                buffer[3] == 0 and (buffer[4] <= MAX_ID or buffer[4] == BROADCAST_ID) and 3 <= length <= MAX_LENGTH
            )
            if not plausible:
                del buffer[: len(_HEADER)]
                continue
            end = _FIXED + length
            if len(buffer) < end:
                return packets
            frame = bytes(buffer[:end])
            if crc16(frame[:-2]) == int.from_bytes(frame[-2:], "little"):
                body = frame[_FIXED:-2].replace(_STUFFED, _HEADER)
                packets.append(InstructionPacket(frame[4], body[0], body[1:]))
                del buffer[:end]
            else:
                packets.append(InstructionPacket(frame[4], frame[_FIXED], b"", intact=False))
                del buffer[: len(_HEADER)]  # a damaged length may include the next packet: search inside
        del buffer[: max(len(buffer) - len(_HEADER) + 1, 0)]
        return packets


def status_packet(bus_id: int, error: int, data: bytes = b"") -> bytes:
    """Return the answer of a device, byte-stuffed: the error byte and the parameters."""
    body = (bytes((_STATUS, error)) + data).replace(_HEADER, _STUFFED)
    return with_crc(_HEADER + bytes((0, bus_id)) + (len(body) + 2).to_bytes(2, "little") + body)
