"""Instructions and replies of both Dynamixel protocols, through the SDK's packet handlers.

The SDK finds packets in the stream and checks their checksums. This module corrects its byte stuffing, and keeps the
whole reply with its length, which the SDK's own read functions ignore.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from dynamixel_sdk import COMM_SUCCESS, Protocol1PacketHandler, Protocol2PacketHandler

from rig.devices.dynamixel.port import ClockedPort

PING, READ, WRITE, REBOOT = 0x01, 0x02, 0x03, 0x08

_HEADER = b"\xff\xff\xfd"
_STUFFED = _HEADER + b"\xfd"
_MALFORMED = -1  # id of an inconsistent reply; no device has it


@dataclass(frozen=True, slots=True)
class Reply:
    """A status packet: the device's id, why it rejected the instruction (0: it did not), its parameters.

    ``alert`` is not 0 if the hardware has a fault: in Protocol 2.0 the alert bit (Hardware Error Status has the
    details), in Protocol 1.0 the bits of the faults, as in Hardware Error Status. ``size`` is the length of the packet
    on the bus in bytes.
    """

    bus_id: int
    error: int
    alert: int
    data: bytes
    size: int


class Packets2(Protocol2PacketHandler):  # type: ignore[misc]
    """Protocol 2.0.

    ``rejections`` are the meanings of the error of a `Reply`, and ``corrupted`` is the error by which the device
    reports that the instruction arrived damaged. ``start`` are the first bytes of a packet. Reads in a row have
    ``read_lengths`` different lengths, so that a repeated answer to an earlier one does not fit. An echoed instruction
    that reads one of ``echo_sizes`` bytes is a valid reply to itself. The readings are ``undated`` if no servo of the
    protocol has a clock that shows their age. ``reboots`` is whether there is an instruction to restart.
    """

    read_lengths: ClassVar[int] = 4
    echo_sizes: ClassVar[tuple[int, ...]] = ()
    undated: ClassVar[bool] = False
    reboots: ClassVar[bool] = True
    rejections: ClassVar[dict[int, str]] = {
        1: "result fail",
        2: "instruction error",
        3: "CRC error",
        4: "data range error",
        5: "data length error",
        6: "data limit error",
        7: "access error",
    }
    corrupted: ClassVar[int] = 3
    start: ClassVar[bytes] = _HEADER

    def send(self, port: ClockedPort, bus_id: int, instruction: int, parameters: bytes) -> int:
        """Drop unread bytes and send an instruction; return the SDK's result."""
        length = len(parameters) + 3
        packet = [0, 0, 0, 0, bus_id, length & 0xFF, length >> 8, instruction, *parameters, 0, 0]
        return int(self.txPacket(port, packet))

    def receive(self, port: ClockedPort) -> tuple[Reply | None, int]:
        """Wait for the next intact status packet; return it, or None and the SDK's result."""
        packet, result = self.rxPacket(port, False)
        if result != COMM_SUCCESS:
            return None, result
        body = packet[8:-2]
        if not body:
            return Reply(_MALFORMED, 0, 0, b"", len(packet)), result
        size = len(packet) + bytes(packet[7:-2]).count(_HEADER)  # each is followed by a stuffed byte on the bus
        return Reply(packet[4], body[0] & 0x7F, body[0] & 0x80, bytes(body[1:]), size), result

    def reply_size(self, size: int) -> int:
        """Return the length of a status packet with ``size`` parameters, in bytes."""
        return 11 + size

    def read_parameters(self, address: int, size: int) -> bytes:
        return address.to_bytes(2, "little") + size.to_bytes(2, "little")

    def write_parameters(self, address: int, data: bytes) -> bytes:
        return address.to_bytes(2, "little") + data

    def instruction(self, packet: bytes) -> tuple[int, int, bytes]:
        """Return id, instruction and parameters of a packet from `send`; ValueError for other bytes."""
        if len(packet) < 10 or not packet.startswith(_HEADER):
            raise ValueError(f"{packet.hex()} is no instruction")
        whole = self.removeStuffing(list(packet))
        return whole[4], whole[7], bytes(whole[8:-2])

    def addStuffing(self, packet: list[int]) -> list[int]:  # noqa: N802 - the SDK's names
        """Stuff ``packet`` in place: the SDK's own version makes a new list, which its `txPacket` ignores."""
        return _restuff(packet, bytes(packet[7:-2]).replace(_HEADER, _STUFFED))

    def removeStuffing(self, packet: list[int]) -> list[int]:  # noqa: N802
        """Return ``packet`` without stuffing, with the length in its header.

        The SDK's own version compares with bytes that it has already moved. After one stuffed byte it takes FF FD FD
        for another one, loses a byte of the value, and returns a byte of the CRC as the last one.
        """
        end = 7 + (packet[5] | packet[6] << 8)
        return _restuff(packet[:end], bytes(packet[7 : end - 2]).replace(_STUFFED, _HEADER))


class Packets1(Protocol1PacketHandler):  # type: ignore[misc]
    """Protocol 1.0, whose error byte combines rejections with the state of the hardware.

    Its checksum has 8 bits: one in 256 corrupted replies passes as valid. On a bus with echo, an instruction that reads
    two bytes returns as a valid status packet; `DynamixelBus` never sends one.
    """

    read_lengths: ClassVar[int] = 16
    echo_sizes: ClassVar[tuple[int, ...]] = (2,)
    undated: ClassVar[bool] = True
    reboots: ClassVar[bool] = False
    rejections: ClassVar[dict[int, str]] = {
        0x10: "checksum error",
        0x02: "outside the angle limits",
        0x08: "value out of range",
        0x40: "instruction error",
    }
    corrupted: ClassVar[int] = 0x10
    start: ClassVar[bytes] = b"\xff\xff"

    def send(self, port: ClockedPort, bus_id: int, instruction: int, parameters: bytes) -> int:
        return int(self.txPacket(port, [0, 0, bus_id, len(parameters) + 2, instruction, *parameters, 0]))

    def receive(self, port: ClockedPort) -> tuple[Reply | None, int]:
        packet, result = self.rxPacket(port)
        if result != COMM_SUCCESS:
            return None, result
        end = 4 + packet[3]
        if packet[3] < 2 or len(packet) < end:
            return Reply(_MALFORMED, 0, 0, b"", len(packet)), result
        rejected = next((bit for bit in self.rejections if packet[4] & bit), 0)
        return Reply(packet[2], rejected, packet[4] & 0x25, bytes(packet[5 : end - 1]), end), result

    def reply_size(self, size: int) -> int:
        return 6 + size

    def read_parameters(self, address: int, size: int) -> bytes:
        return bytes((address, size))

    def write_parameters(self, address: int, data: bytes) -> bytes:
        return bytes((address,)) + data

    def instruction(self, packet: bytes) -> tuple[int, int, bytes]:
        if len(packet) < 6 or not packet.startswith(self.start):
            raise ValueError(f"{packet.hex()} is no instruction")
        return packet[2], packet[4], packet[5:-1]


Packets = Packets1 | Packets2


def _restuff(packet: list[int], body: Sequence[int] | bytes) -> list[int]:
    length = len(body) + 2
    packet[5:-2] = [length & 0xFF, length >> 8, *body]
    return packet


def reason(result: int) -> str:
    """Return the SDK's text for a result."""
    return str(Protocol2PacketHandler().getTxRxResult(result)).removeprefix("[TxRxResult] ")
