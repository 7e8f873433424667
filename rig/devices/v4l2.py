"""Questions to a Video4Linux device that OpenCV does not ask (linux/videodev2.h)."""

import os
import struct
from fcntl import ioctl
from pathlib import Path

CAPTURE, CAPTURE_MPLANE = 0x0000_0001, 0x0000_1000
M2M_MPLANE, M2M = 0x0000_4000, 0x0000_8000
_DEVICE_CAPS = 0x8000_0000

_QUERYCAP = 0x8068_5600
_CAPABILITY = struct.Struct("16s32s32s6I")  # driver, card, bus; version, capabilities of the driver and of this node


def capabilities(path: Path) -> int | None:
    """Return the capabilities of a device file (VIDIOC_QUERYCAP); None if it cannot be opened or is no video device."""
    try:
        handle = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        answer = _CAPABILITY.unpack(ioctl(handle, _QUERYCAP, bytes(_CAPABILITY.size)))
    except OSError:
        return None
    finally:
        os.close(handle)
    driver, node = answer[4], answer[5]
    return int(node if driver & _DEVICE_CAPS else driver)


def captures(caps: int) -> bool:
    """Return whether a device with these capabilities delivers images; a converter (memory to memory) does not."""
    return bool(caps & (CAPTURE | CAPTURE_MPLANE)) and not caps & (M2M | M2M_MPLANE)
