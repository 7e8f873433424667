"""The device's side of Dynamixel Protocol 1.0: it receives instruction packets and sends status packets.

Source: e-manual "DYNAMIXEL Protocol 1.0". Packets are FF FF, id, length, instruction or error, parameters, and the
inverted sum of all bytes except the header; nothing is stuffed, and the sum has 8 bits.
"""

from enum import IntFlag

from sim.servo.protocol2 import BROADCAST_ID, InstructionPacket, PacketParser, StatusPacket

_HEADER = b"\xff\xff"
_FIXED = 4  # header, id, length
MAX_ID = 0xFD
MAX_LENGTH = 143  # largest valid value of a length field (the size of Protocol 1.0 buffers)


class Error(IntFlag):
    """Bits of a status packet's error byte."""

    VOLTAGE = 0x01
    ANGLE_LIMIT = 0x02
    OVERHEATING = 0x04
    RANGE = 0x08
    CHECKSUM = 0x10
    OVERLOAD = 0x20
    INSTRUCTION = 0x40


def checksum(body: bytes) -> int:
    """Return the inverted sum of ``body`` (id to the last parameter)."""
    return ~sum(body) & 0xFF


class PacketParser1(PacketParser):
    """Finds instruction packets of Protocol 1.0."""

    def feed(self, data: bytes) -> list[InstructionPacket]:
        """Return the packets that ``data`` completes."""
        buffer = self._buffer
        buffer += data
        packets: list[InstructionPacket] = []
        while (start := buffer.find(_HEADER)) >= 0:
            del buffer[:start]
            if len(buffer) < _FIXED:
                return packets
            bus_id, length = buffer[2], buffer[3]
            if not ((bus_id <= MAX_ID or bus_id == BROADCAST_ID) and 2 <= length <= MAX_LENGTH):
                del buffer[0]  # FF FF FF: the header may begin one byte later
                continue
            end = _FIXED + length
            if len(buffer) < end:
                return packets
            frame = bytes(buffer[:end])
            intact = checksum(frame[2:-1]) == frame[-1]
            packets.append(InstructionPacket(bus_id, frame[4], frame[5:-1] if intact else b"", intact))
            del buffer[: end if intact else len(_HEADER)]
        del buffer[: max(len(buffer) - len(_HEADER) + 1, 0)]
        return packets


def status_packet1(bus_id: int, status: StatusPacket) -> bytes:
    """Return the status packet."""
    body = bytes((bus_id, len(status.data) + 2, status.error)) + status.data
    return _HEADER + body + bytes((checksum(body),))
