"""What the descriptors of a webcam say: its units, its streams and their modes.

Sources: USB Device Class Definition for Video Devices 1.1, 3.7 and 3.9; the class's definition of frame-based payloads
1.1, 3.1.
"""

import struct
from dataclasses import dataclass, field
from typing import Final, NamedTuple, Self

from tests.kernel.usb import descriptors
from tests.kernel.usb.descriptors import ISOCHRONOUS, parts

VIDEO, CONTROL, STREAM = 14, 1, 2
"""Class and subclasses of the interfaces."""
CLASS_INTERFACE: Final = 0x24
"""Type of the descriptors of this class."""
HEADER, CAMERA, PROCESSING = 1, 2, 5
UNCOMPRESSED, MJPEG, FRAME_BASED = 4, 6, 0x10
_CAMERA_TERMINAL = b"\x01\x02"
_DEFAULT_INTERVAL: Final = {UNCOMPRESSED + 1: 21, MJPEG + 1: 21, FRAME_BASED + 1: 17}
"""Where the descriptor of a frame has the default time between two frames; the list of all begins at byte 26."""
_V4L2_NAMES: Final = {b"YUY2": "YUYV", b"H265": "HEVC", b"\x7d\xeb\x36\xe4": "BGR3"}
"""Names by the first bytes of the GUID; the others are these bytes."""


class Mode(NamedTuple):
    """A mode of a stream; times between two frames in 100 ns."""

    fourcc: str
    width: int
    height: int
    usual: int
    shortest: int


@dataclass(slots=True)
class Stream:
    """A streaming interface.

    ``modes`` are by the indices of format and frame, ``packet_bytes`` by alternate setting: the most that one of them
    carries in a microframe. Without alternate settings the stream uses bulk transfers.
    """

    endpoint: int = 0
    modes: dict[tuple[int, int], Mode] = field(default_factory=dict)
    packet_bytes: dict[int, int] = field(default_factory=dict)


@dataclass(slots=True)
class Video:
    """The video function of a device: for its camera and its processing unit the number and the bits of the controls,
    and the streams by the numbers of their interfaces.
    """

    version: int = 0
    clock_hz: int = 0
    camera: tuple[int, int] = (0, 0)
    processing: tuple[int, int] = (0, 0)
    streams: dict[int, Stream] = field(default_factory=dict)

    @classmethod
    def described(cls, configuration: bytes) -> Self:
        """Return what a configuration describes."""
        video, stream, kind, setting, form, fourcc = cls(), Stream(), (0, 0), 0, 0, ""
        for part in parts(configuration):
            match part[1], kind, part[2]:
                case descriptors.INTERFACE, _, number:
                    kind, setting = (part[5], part[6]), part[3]
                    if kind == (VIDEO, STREAM):
                        stream = video.streams.setdefault(number, Stream())
                case descriptors.ENDPOINT, (14, 2), address:
                    stream.endpoint = address & 0xF
                    size = int.from_bytes(part[4:6], "little")
                    if part[3] & 3 == ISOCHRONOUS:  # bits 11 and 12: additional packets in a microframe
                        stream.packet_bytes[setting] = (size & 0x7FF) * (1 + (size >> 11 & 3))
                case descriptors.COMPANION, (14, 2), _ if stream.packet_bytes.get(setting):  # SuperSpeed
                    stream.packet_bytes[setting] = int.from_bytes(part[4:6], "little")
                case 0x24, (14, 1), 1:
                    video.version, video.clock_hz = struct.unpack_from("<H2xI", part, 3)
                case 0x24, (14, 1), 2 if part[4:6] == _CAMERA_TERMINAL:
                    video.camera = part[3], int.from_bytes(part[15 : 15 + part[14]], "little")
                case 0x24, (14, 1), 5:
                    video.processing = part[3], int.from_bytes(part[8 : 8 + part[7]], "little")
                case 0x24, (14, 2), 4 | 0x10:
                    form, fourcc = part[3], _V4L2_NAMES.get(part[5:9]) or part[5:9].decode()
                case 0x24, (14, 2), 6:
                    form, fourcc = part[3], "MJPG"
                case 0x24, (14, 2), 5 | 7 | 0x11 as frame:
                    width, height = struct.unpack_from("<2H", part, 5)
                    (usual,) = struct.unpack_from("<I", part, _DEFAULT_INTERVAL[frame])
                    shortest = min(struct.unpack_from(f"<{(len(part) - 26) // 4}I", part, 26))
                    stream.modes[form, part[3]] = Mode(fourcc, width, height, usual, shortest)
        return video
