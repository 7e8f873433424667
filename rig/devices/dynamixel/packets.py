"""Instructions and replies of Dynamixel Protocol 2.0, through the SDK's packet handler.

The SDK finds packets in the stream and checks their checksums. This module corrects its byte stuffing, and keeps the
whole reply with its length, which the SDK's own read functions ignore.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from dynamixel_sdk import COMM_SUCCESS, Protocol2PacketHandler

from rig.devices.dynamixel.port import ClockedPort

PING, READ, WRITE, REBOOT = 0x01, 0x02, 0x03, 0x08

HEADER: Final = b"\xff\xff\xfd"
_STUFFED = HEADER + b"\xfd"
_MALFORMED = -1  # id of an inconsistent reply; no device has it


@dataclass(frozen=True, slots=True)
class Reply:
    """A status packet: the device's id, why it rejected the instruction (0: it did not), its parameters.

    ``alert`` is not 0 if the hardware has a fault: Hardware Error Status has the details. ``size`` is the length of the
    packet on the bus in bytes.
    """

    bus_id: int
    error: int
    alert: int
    data: bytes
    size: int


REJECTIONS: Final = {
    1: "result fail",
    2: "instruction error",
    3: "CRC error",
    4: "data range error",
    5: "data length error",
    6: "data limit error",
    7: "access error",
}
"""Meanings of the error of a `Reply`."""
CORRUPTED: Final = 3  # the error by which the device reports that the instruction arrived damaged


class Packets(Protocol2PacketHandler):  # type: ignore[misc]
    """The SDK's packet handler with these corrections."""

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
        size = len(packet) + bytes(packet[7:-2]).count(HEADER)  # each is followed by a stuffed byte on the bus
        return Reply(packet[4], body[0] & 0x7F, body[0] & 0x80, bytes(body[1:]), size), result

    def instruction(self, packet: bytes) -> tuple[int, int, bytes]:
        """Return id, instruction and parameters of a packet from `send`; ValueError for other bytes."""
        if len(packet) < 10 or not packet.startswith(HEADER):
            raise ValueError(f"{packet.hex()} is no instruction")
        whole = self.removeStuffing(list(packet))
        return whole[4], whole[7], bytes(whole[8:-2])

    def addStuffing(self, packet: list[int]) -> list[int]:  # noqa: N802 - the SDK's names
        """Stuff ``packet`` in place: the SDK's own version makes a new list, which its `txPacket` ignores."""
        return _restuff(packet, bytes(packet[7:-2]).replace(HEADER, _STUFFED))

    def removeStuffing(self, packet: list[int]) -> list[int]:  # noqa: N802
        """Return ``packet`` without stuffing, with the length in its header.

        The SDK's own version compares with bytes that it has already moved. After one stuffed byte it takes FF FD FD
        for another one, loses a byte of the value, and returns a byte of the CRC as the last one.
        """
        end = 7 + (packet[5] | packet[6] << 8)
        return _restuff(packet[:end], bytes(packet[7 : end - 2]).replace(_STUFFED, HEADER))


def read_parameters(address: int, size: int) -> bytes:
    return address.to_bytes(2, "little") + size.to_bytes(2, "little")


def _restuff(packet: list[int], body: Sequence[int] | bytes) -> list[int]:
    length = len(body) + 2
    packet[5:-2] = [length & 0xFF, length >> 8, *body]
    return packet


def reason(result: int) -> str:
    """Return the SDK's text for a result."""
    return str(Protocol2PacketHandler().getTxRxResult(result)).removeprefix("[TxRxResult] ")
