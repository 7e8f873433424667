"""Opens cameras, video files and streams through OpenCV."""

import os
import select
import stat
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import cv2

from rig.core.camera_node import camera_node
from rig.core.errors import DeviceNotFound
from rig.devices import v4l2
from rig.devices.camera import Capture
from rig.devices.picamera2_capture import Picamera2Capture, camera_number

_CONTROLS: Final = {  # linux/v4l2-controls.h
    cv2.CAP_PROP_GAIN: 0x0098_0913,
    cv2.CAP_PROP_WB_TEMPERATURE: 0x0098_091A,
    cv2.CAP_PROP_SHARPNESS: 0x0098_091B,
    cv2.CAP_PROP_BACKLIGHT: 0x0098_091C,
    cv2.CAP_PROP_EXPOSURE: 0x009A_0902,
    cv2.CAP_PROP_FOCUS: 0x009A_090A,
}
"""Numbers of the controls whose values are a range."""


class OpenedCapture(Capture):
    """An open `cv2.VideoCapture`, and what OpenCV lacks if it is that of a device file ``path``."""

    def __init__(self, capture: cv2.VideoCapture, path: str | None = None) -> None:
        self._capture = capture
        self._path = None if path is None else Path(path)
        self._waiter = None if path is None else waiter_for(path)

    def isOpened(self) -> bool:  # noqa: N802
        return self._capture.isOpened()

    def grab(self) -> bool:
        return self._capture.grab()

    def retrieve(self) -> tuple[bool, Any]:
        return self._capture.retrieve()

    def release(self) -> None:
        self._capture.release()

    def wait(self, seconds: float) -> bool | None:
        return None if self._waiter is None else self._waiter(seconds)

    def get(self, propId: int, /) -> float:
        if propId < v4l2.FIRST_CONTROL or self._path is None:
            return self._capture.get(propId)
        value = v4l2.get_control(self._path, propId)
        return -1.0 if value is None else float(value)

    def set(self, propId: int, value: float, /) -> bool:
        if propId < v4l2.FIRST_CONTROL or self._path is None:
            return self._capture.set(propId, value)
        return v4l2.set_control(self._path, propId, round(value))

    def modes(self) -> tuple[v4l2.VideoMode, ...]:
        return () if self._path is None else v4l2.modes(self._path)

    def offered_controls(self) -> tuple[v4l2.VideoControl, ...]:
        return () if self._path is None else v4l2.controls(self._path)

    def limits(self, propId: int, /) -> tuple[float, float] | None:
        if self._path is None or propId not in _CONTROLS:
            return None
        return v4l2.control_limits(self._path, _CONTROLS[propId])


def waiter_for(path: str | Path) -> Callable[[float], bool] | None:
    """Return a function like `Capture.wait` for a device file that this process has opened once; else None.

    OpenCV's own `waitAny` takes the frame, and `grab` then returns the same frame until it is decoded.
    """
    found = []
    try:
        device = Path(path).stat().st_rdev
        for entry in Path("/proc/self/fd").iterdir():
            number = int(entry.name)
            with suppress(OSError):  # the descriptor that listed them
                status = os.fstat(number)
                if stat.S_ISCHR(status.st_mode) and status.st_rdev == device:
                    found.append(number)
    except OSError:
        return None
    if len(found) != 1:
        return None
    poll = select.poll()
    poll.register(found[0], select.POLLIN)
    return lambda seconds: bool(poll.poll(seconds * 1e3))


def open_capture(source: int | str | Path) -> Capture:
    """Open a camera by number or device path, or a video file, an image sequence (``img_%03d.png``) or a stream's URL.

    ``picamera2`` or ``picamera2:1`` is a camera on the ribbon cable of a Raspberry Pi.

    Raises `DeviceNotFound`: the source does not exist, the user may not open it, or another program uses it; the next
    step says which.
    """
    if (number := camera_number(source)) is not None:
        return Picamera2Capture(number)
    path = camera_node(source)
    if path is None:
        step = "Check the path or address, and that OpenCV can decode its format."
        return OpenedCapture(_opened(str(source), cv2.CAP_ANY, step))
    if not Path(path).exists():
        there = sorted(str(p) for p in Path("/dev").glob("video*"))
        raise DeviceNotFound(
            f"The camera {path} does not exist.",
            next_step=f"Connect the camera, or choose one of {', '.join(there)}." if there else "Connect the camera.",
            evidence={"path": path, "found": there},
        )
    if not os.access(path, os.R_OK | os.W_OK):
        raise DeviceNotFound(
            f"You have no permission to open {path}.",
            next_step="Join the group video (`sudo usermod -aG video $USER`), then log out and in again.",
            evidence={"path": path},
        )
    step = f"Close the program that uses it (`fuser -v {path}`), or try the camera's next number."
    return OpenedCapture(_opened(path, cv2.CAP_V4L2, step), path)


def _opened(path: str, backend: int, next_step: str) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(path, backend)
    if not capture.isOpened():
        capture.release()
        raise DeviceNotFound(f"Cannot open {path}.", next_step=next_step, evidence={"path": path})
    return capture
