"""Frames of the rig head: complete ones are found in any parts of the stream, and noise is never accepted."""

import binascii

from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from rig.devices.head import protocol
from rig.devices.head.link import LONGEST, Deframer, HeadFrame, HeadStatistics, encode
from tests.fuzzing import fuzz_settings

BYTE = st.integers(0, 255)
FRAMES = st.builds(HeadFrame, BYTE, BYTE, st.binary(max_size=protocol.MAX_BODY))


@given(FRAMES, st.data())
def test_flipped_bit_is_always_detected(frame, data):
    line = bytearray(encode(frame)[:-1])
    bit = data.draw(st.integers(0, 8 * len(line) - 1))
    line[bit // 8] ^= 1 << bit % 8
    found = HeadStatistics()
    assert list(Deframer(found).feed(bytes(line) + b"\0")) == []
    assert found.crc_errors + found.malformed >= 1


@fuzz_settings(0.4)
@given(st.lists(FRAMES | st.binary(min_size=1, max_size=60), max_size=12), st.data())
def test_frames_are_found_however_the_stream_is_split(parts, data):
    stream, expected = b"\0", []
    for part in parts:
        if isinstance(part, HeadFrame):
            stream += encode(part)
            expected.append(part)
        else:
            stream += part.replace(b"\0", b"\1") + b"\0"  # noise that ends before the next frame
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    deframer = Deframer(HeadStatistics())
    got = [f for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True) for f in deframer.feed(stream[a:b])]
    assert [f for f in got if f in expected] == expected
    for frame in got:  # noise that is a valid frame by chance has a right checksum
        content = bytes([frame.id, frame.sequence]) + frame.body
        assert encode(frame) == cobs.encode(content + binascii.crc_hqx(content, 0xFFFF).to_bytes(2, "big")) + b"\0"


def test_endless_frame_uses_bounded_memory():
    deframer = Deframer(HeadStatistics())
    for _ in range(1000):
        assert list(deframer.feed(b"\xff" * 4096)) == []
    assert len(deframer._line) <= LONGEST
    assert list(deframer.feed(b"\0" + encode(HeadFrame(1, 2, b"3")))) == [HeadFrame(1, 2, b"3")]


def test_every_message_fits_its_frame_and_is_known_by_its_id():
    for number, kind in protocol.MESSAGES.items():
        assert number == kind.ID
        assert kind.LAYOUT.size <= protocol.MAX_BODY
    assert protocol.Heartbeat.LAYOUT.size == protocol.HeartbeatReply.LAYOUT.size  # the same time on the line, both ways
