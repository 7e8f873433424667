"""The servo's codec, compared with the SDK's and with the e-manual's examples."""

import pytest
from dynamixel_sdk import Protocol2PacketHandler
from hypothesis import example, given
from hypothesis import strategies as st

from rig.devices.dynamixel.packets import Packets
from sim.servo.protocol2 import (
    BROADCAST_ID,
    InstructionPacket,
    PacketParser,
    crc16,
    status_packet,
    with_crc,
)
from tests.fuzzing import examples

SDK = Protocol2PacketHandler()
quick = examples(17)

# Bytes that make headers, stuffing and near misses of both likely.
tricky_bytes = st.lists(st.sampled_from([0xFF, 0xFF, 0xFF, 0xFD, 0xFD, 0x00, 0x01, 0x55, 0xAB]), max_size=40).map(bytes)
payloads = st.binary(max_size=40) | tricky_bytes
ids = st.integers(0, 252) | st.just(BROADCAST_ID)


def instruction_frame(bus_id: int, instruction: int, parameters: bytes) -> bytes:
    """Return the packet as a host sends it, stuffed by the SDK's `addStuffing` (whose result its `txPacket` drops)."""
    length = len(parameters) + 3
    packet = [0xFF, 0xFF, 0xFD, 0, bus_id, length & 0xFF, length >> 8, instruction, *parameters, 0, 0]
    stuffed = SDK.addStuffing(packet)
    size = 7 + (stuffed[5] | stuffed[6] << 8)
    return with_crc(bytes(stuffed[: size - 2]))


packets = st.builds(InstructionPacket, ids, st.integers(1, 0x9A), payloads)


@quick
@given(st.binary(max_size=200))
def test_crc_equals_the_sdks(data: bytes) -> None:
    assert crc16(data) == SDK.updateCRC(0, data, len(data))


@pytest.mark.parametrize(
    ("frame", "packet"),
    [
        ("FF FF FD 00 01 03 00 01 19 4E", InstructionPacket(1, 0x01, b"")),
        ("FF FF FD 00 FE 03 00 01 31 42", InstructionPacket(0xFE, 0x01, b"")),
        ("FF FF FD 00 01 07 00 02 84 00 04 00 1D 15", InstructionPacket(1, 0x02, b"\x84\0\x04\0")),
        ("FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89", InstructionPacket(1, 0x03, b"\x74\0\0\x02\0\0")),
        ("FF FF FD 00 01 04 00 06 01 A1 E6", InstructionPacket(1, 0x06, b"\x01")),
        ("FF FF FD 00 01 03 00 08 2F 4E", InstructionPacket(1, 0x08, b"")),
        ("FF FF FD 00 01 08 00 10 01 44 58 4C 22 B1 DC", InstructionPacket(1, 0x10, b"\x01DXL\x22")),
        ("FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA", InstructionPacket(0xFE, 0x82, b"\x84\0\x04\0\x01\x02")),
    ],
)
def test_emanual_instruction_packets_are_understood(frame: str, packet: InstructionPacket) -> None:
    assert PacketParser().feed(bytes.fromhex(frame)) == [packet]


@pytest.mark.parametrize(
    ("bus_id", "status", "frame"),
    [
        (1, (0, b"\x06\x04\x26"), "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D"),
        (2, (0, b"\x06\x04\x26"), "FF FF FD 00 02 07 00 55 00 06 04 26 6F 6D"),
        (1, (0, b"\xa6\0\0\0"), "FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0"),
        (1, (0,), "FF FF FD 00 01 04 00 55 00 A1 0C"),
        (2, (0, b"\x24"), "FF FF FD 00 02 05 00 55 00 24 8B A9"),
    ],
)
def test_status_packets_equal_the_emanuals(bus_id: int, status: tuple[int, bytes], frame: str) -> None:
    assert status_packet(bus_id, *status) == bytes.fromhex(frame)


@quick
@given(bus_id=st.integers(0, 252), error=st.integers(0, 255), data=payloads)
@example(bus_id=1, error=0, data=b"\xff\xff\xfd\xff\xfd\xfd")
def test_byte_stuffing_removes_headers_and_can_be_undone(bus_id: int, error: int, data: bytes) -> None:
    frame = status_packet(bus_id, error, data)
    assert b"\xff\xff\xfd\x00" not in frame[4:-2]
    assert SDK.updateCRC(0, frame, len(frame) - 2) == frame[-2] | frame[-1] << 8
    assert bytes(Packets().removeStuffing(list(frame))[7:-2]) == bytes((0x55, error)) + data


@quick
@given(sent=st.lists(st.tuples(payloads, packets), max_size=6), cuts=st.lists(st.integers(0, 400), max_size=8))
def test_packets_are_found_in_noise_and_in_pieces(sent: list[tuple[bytes, InstructionPacket]], cuts: list[int]) -> None:
    stream = b"".join(noise + instruction_frame(p.bus_id, p.instruction, p.parameters) for noise, p in sent)
    stream += bytes(1100)  # completes any packet that the noise has begun
    parser = PacketParser()
    found = []
    start = 0
    for cut in [*sorted(cuts), len(stream)]:
        found += parser.feed(stream[start:cut])
        start = max(start, cut)
    assert [p for p in found if p.intact] == [p for _, p in sent]


@quick
@given(packet=packets, data=st.data())
def test_flipped_bit_is_never_accepted(packet: InstructionPacket, data: st.DataObject) -> None:
    frame = bytearray(instruction_frame(packet.bus_id, packet.instruction, packet.parameters))
    bit = data.draw(st.integers(0, 8 * len(frame) - 1))
    frame[bit // 8] ^= 1 << bit % 8
    assert not [p for p in PacketParser().feed(bytes(frame) + bytes(1100)) if p.intact]


@pytest.mark.parametrize("reserved", [0x01, 0xFD, 0xFF])
def test_only_a_reserved_byte_of_zero_makes_a_header(reserved: int) -> None:
    frame = with_crc(bytes((0xFF, 0xFF, 0xFD, reserved, 1, 3, 0, 1)))
    assert PacketParser().feed(frame + bytes(1100)) == []


@quick
@given(noise=st.binary(max_size=300))
def test_noise_delays_at_most_one_packet(noise: bytes) -> None:
    parser = PacketParser()
    parser.feed(noise)
    parser.reset()
    assert parser.feed(instruction_frame(1, 1, b"")) == [InstructionPacket(1, 1, b"")]
