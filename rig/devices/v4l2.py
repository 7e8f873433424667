"""Questions to a Video4Linux device that OpenCV does not ask (linux/videodev2.h)."""

import os
import struct
from fcntl import ioctl
from pathlib import Path

CAPTURE, CAPTURE_MPLANE = 0x0000_0001, 0x0000_1000
M2M_MPLANE, M2M = 0x0000_4000, 0x0000_8000
_DEVICE_CAPS = 0x8000_0000

POWER_LINE_FREQUENCY = 0x0098_0918
EXPOSURE_DYNAMIC_FRAMERATE = 0x009A_0903
"""V4L2_CID_EXPOSURE_AUTO_PRIORITY: the camera may lower its frame rate for a longer exposure."""
FIRST_CONTROL = 0x0098_0000
"""Numbers of controls are above all property numbers of OpenCV."""

_QUERYCAP = 0x8068_5600
_G_CTRL, _S_CTRL = 0xC008_561B, 0xC008_561C
_CONTROL = struct.Struct("Ii")
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


def get_control(path: Path, control: int) -> int | None:
    """Return the value of a control; None if the device lacks it."""
    answer = _ask(path, _G_CTRL, _CONTROL.pack(control, 0))
    return None if answer is None else int(_CONTROL.unpack(answer)[1])


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
