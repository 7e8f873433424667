"""Queries of a Video4Linux device that OpenCV does not offer (linux/videodev2.h)."""

import os
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from fcntl import ioctl
from pathlib import Path
from typing import Any

CAPTURE, CAPTURE_MPLANE = 0x0000_0001, 0x0000_1000
M2M_MPLANE, M2M = 0x0000_4000, 0x0000_8000
_DEVICE_CAPS = 0x8000_0000  # linux/videodev2.h and v4l2-controls.h, like all numbers below

POWER_LINE_FREQUENCY = 0x0098_0918
EXPOSURE_DYNAMIC_FRAMERATE = 0x009A_0903
"""V4L2_CID_EXPOSURE_AUTO_PRIORITY: the camera may lower its frame rate for a longer exposure."""
FIRST_CONTROL = 0x0098_0000
"""Numbers of controls are above all property numbers of OpenCV."""

_QUERYCAP = 0x8068_5600
_ENUM_FMT, _ENUM_FRAMESIZES, _ENUM_FRAMEINTERVALS = 0xC040_5602, 0xC02C_564A, 0xC034_564B
_FORMAT = struct.Struct("III32s4s4I")  # index, type, flags, description, pixel format, mbus code, reserved
_SIZE = struct.Struct("I4sI6I2I")  # index, pixel format, type, then width and height, or ranges with steps; reserved
_INTERVAL = struct.Struct("I4sIII6I2I")  # index, pixel format, width, height, type, fractions of a second; reserved
_VIDEO_CAPTURE, _DISCRETE = 1, 1
_MOST_ENTRIES = 64  # a driver that never answers EINVAL must not hold the program
_G_CTRL, _S_CTRL, _QUERYCTRL = 0xC008_561B, 0xC008_561C, 0xC044_5624
_CONTROL = struct.Struct("Ii")
_RANGE = struct.Struct("II32s4iI8x")  # number, type, name; minimum, maximum, step, default value; flags
_NEXT, _DISABLED, _CLASS = 0x8000_0000, 0x0001, 6
_CAPABILITY = struct.Struct("16s32s32s6I")  # driver, card, bus; version, capabilities of the driver and of this node


def capabilities(path: Path) -> int | None:
    """Return the capabilities of a device file (VIDIOC_QUERYCAP); None if it cannot be opened or is no video device."""
    answer = _ask(path, _QUERYCAP, bytes(_CAPABILITY.size))
    if answer is None:
        return None
    driver, node = _CAPABILITY.unpack(answer)[4:6]
    return int(node if driver & _DEVICE_CAPS else driver)


def captures(caps: int) -> bool:
    """Return whether a device with these capabilities delivers images; a converter (memory to memory) does not."""
    return bool(caps & (CAPTURE | CAPTURE_MPLANE)) and not caps & (M2M | M2M_MPLANE)


@dataclass(frozen=True, slots=True)
class VideoMode:
    """A mode that a camera offers: pixel format (FourCC), size in pixels, and highest frame rate (0: not known)."""

    fourcc: str
    width: int
    height: int
    fps: float

    def __str__(self) -> str:
        return f"{self.width}x{self.height} at {self.fps:.3g} frames/s ({self.fourcc})"


UNCOMPRESSED = ("YUYV", "UYVY", "NV12", "NV21", "YU12", "YV12", "BGR3", "RGB3")
COMPRESSED = ("MJPG", "JPEG")
"""Pixel formats that OpenCV converts to colour images; JPEG adds its own errors."""


def modes(path: Path) -> tuple[VideoMode, ...]:
    """Return the modes with pixel formats that OpenCV converts; empty if the device does not list them.

    A size that is a range (stepwise) counts as its largest one. Some cameras list a size twice.
    """
    found = []
    for fourcc in _entries(path, _ENUM_FMT, lambda i: _FORMAT.pack(i, _VIDEO_CAPTURE, 0, b"", b"", 0, 0, 0, 0)):
        code = _FORMAT.unpack(fourcc)[4]
        if code.decode("ascii", "replace") not in UNCOMPRESSED + COMPRESSED:
            continue
        for size in _entries(path, _ENUM_FRAMESIZES, lambda i, code=code: _SIZE.pack(i, code, *(0,) * 9)):  # type: ignore[misc]
            kind, *numbers = _SIZE.unpack(size)[2:]
            width, height = (numbers[0], numbers[1]) if kind == _DISCRETE else (numbers[1], numbers[4])
            rates = [
                _rate(interval)
                for interval in _entries(
                    path,
                    _ENUM_FRAMEINTERVALS,
                    lambda i, code=code, at=(width, height): _INTERVAL.pack(i, code, *at, *(0,) * 9),  # type: ignore[misc]
                )
            ]
            found.append(VideoMode(code.decode(), width, height, max(rates, default=0.0)))
    return tuple(dict.fromkeys(found))


def choose_mode(
    offered: Iterable[VideoMode], width: int, height: int, fps: float, fourcc: str | None = None
) -> VideoMode | None:
    """Return the best offered mode: first the size that is nearest, then one that is fast enough, then uncompressed.

    With ``fourcc`` the mode has this pixel format.
    """

    def rank(mode: VideoMode) -> tuple[float, bool, float, int]:
        apart = abs(mode.width - width) + abs(mode.height - height)
        slow = 0 < mode.fps < 0.9 * fps
        return apart, slow, -mode.fps if slow else 0.0, (UNCOMPRESSED + COMPRESSED).index(mode.fourcc)

    known = [mode for mode in offered if mode.fourcc in UNCOMPRESSED + COMPRESSED]
    return min((mode for mode in known if fourcc in (None, mode.fourcc)), key=rank, default=None)


def fourcc_number(fourcc: str) -> int:
    """Return a pixel format of four letters as a number."""
    return int.from_bytes(fourcc.encode("ascii"), "little")


def _entries(path: Path, request: int, question: Callable[[int], bytes]) -> Iterator[bytes]:
    for index in range(_MOST_ENTRIES):
        if (answer := _ask(path, request, question(index))) is None:
            return
        yield answer


def _rate(interval: bytes) -> float:
    numerator, denominator = _INTERVAL.unpack(interval)[5:7]  # of a range, the shortest one
    return float(denominator / numerator) if numerator else 0.0


def get_control(path: Path, control: int) -> int | None:
    """Return the value of a control; None if the device lacks it."""
    answer = _ask(path, _G_CTRL, _CONTROL.pack(control, 0))
    return None if answer is None else int(_CONTROL.unpack(answer)[1])


@dataclass(frozen=True, slots=True)
class VideoControl:
    """A control that a camera offers, with its present value (None: it cannot be read)."""

    number: int
    name: str
    minimum: int
    maximum: int
    step: int
    default: int
    value: int | None


def controls(path: Path) -> tuple[VideoControl, ...]:
    """Return the controls of a device, in the order of their numbers."""
    found: list[VideoControl] = []
    number = 0
    while (answer := _range(path, number | _NEXT)) is not None and answer[0] > number:  # a driver may repeat itself
        number, kind, name, low, high, step, default, flags = answer
        if kind != _CLASS and not flags & _DISABLED:
            text = name.split(b"\0")[0].decode("ascii", "replace")
            found.append(VideoControl(number, text, low, high, step, default, get_control(path, number)))
    return tuple(found)


def control_limits(path: Path, control: int) -> tuple[int, int] | None:
    """Return the smallest value and the step of a control; None if the device lacks it."""
    answer = _range(path, control)
    return None if answer is None else (answer[3], answer[5])


def _range(path: Path, number: int) -> tuple[Any, ...] | None:
    """Return the fields of `_RANGE` of a control; None if there is none."""
    answer = _ask(path, _QUERYCTRL, _RANGE.pack(number, 0, b"", 0, 0, 0, 0, 0))
    return None if answer is None else _RANGE.unpack(answer)


def set_control(path: Path, control: int, value: int) -> bool:
    """Set a control; return whether the device accepted it."""
    return _ask(path, _S_CTRL, _CONTROL.pack(control, value)) is not None


def _ask(path: Path, request: int, argument: bytes) -> bytes | None:
    """Return the answer to an ``ioctl``; None if the file cannot be opened or the device rejects the request."""
    try:
        handle = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        return ioctl(handle, request, argument)
    except OSError:
        return None
    finally:
        os.close(handle)
