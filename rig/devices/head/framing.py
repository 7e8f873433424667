"""Frames of the rig head: COBS, ended by a zero byte, with id, sequence, body and CRC-16 inside (see PROTOCOL.md)."""

from binascii import crc_hqx
from collections.abc import Iterator
from dataclasses import dataclass

from cobs import cobs

from rig.devices.head.protocol import MAX_BODY

HEADER, CRC = 2, 2
LONGEST = MAX_BODY + HEADER + CRC + 2
"""Bytes of the longest frame on the wire, including its zero."""


class FrameError(ValueError):
    """The bytes between two zeros are not a frame."""


class CrcError(FrameError):
    """A frame whose checksum is wrong."""


@dataclass(frozen=True, slots=True)
class Frame:
    """The content of a frame."""

    id: int
    sequence: int
    body: bytes


def encode(frame: Frame) -> bytes:
    """Return the frame's bytes on the wire, including the zero that ends them."""
    content = bytes([frame.id, frame.sequence]) + frame.body
    encoded: bytes = cobs.encode(content + crc_hqx(content, 0xFFFF).to_bytes(CRC, "big"))
    return encoded + b"\0"


def decode(line: bytes) -> Frame:
    """Return the frame in ``line``, the bytes between two zeros.

    Raises
    ------
    CrcError
        The checksum is wrong.
    FrameError
        The bytes are not COBS, too few or too many.
    """
    if len(line) >= LONGEST:
        raise FrameError(f"{len(line)} bytes, longer than any frame")
    try:
        content = cobs.decode(line)
    except cobs.DecodeError as error:
        raise FrameError(str(error)) from error
    if len(content) < HEADER + CRC:
        raise FrameError(f"{len(content)} bytes, shorter than any frame")
    if crc_hqx(content, 0xFFFF):  # over data and its CRC the remainder is 0
        raise CrcError(f"wrong checksum in {line.hex()}")
    return Frame(content[0], content[1], content[HEADER:-CRC])


class Deframer:
    """Splits a stream of bytes into frames, and counts invalid ones."""

    def __init__(self) -> None:
        self.frames = 0
        self.crc_errors = 0
        self.malformed = 0
        self._line = bytearray()

    def feed(self, data: bytes) -> Iterator[Frame]:
        """Add bytes and yield the frames that they complete."""
        *lines, rest = (bytes(self._line) + data).split(b"\0")
        # A frame that is too long is invalid: keep only enough of it to detect that.
        self._line[:] = rest[:LONGEST]
        for line in lines:
            if not line:
                continue
            try:
                frame = decode(line)
            except CrcError:
                self.crc_errors += 1
            except FrameError:
                self.malformed += 1
            else:
                self.frames += 1
                yield frame

    def missing(self, length: int) -> int:
        """Return how many bytes the present frame lacks, at least 1, if it has ``length`` bytes with its zero."""
        return max(length - len(self._line), 1)

    def reset(self) -> None:
        """Drop an incomplete frame."""
        self._line.clear()
