"""The interface of a camera, and that of a source of frames which OpenCV opens."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rig.devices.v4l2 import VideoControl, VideoMode


@dataclass(frozen=True, slots=True)
class CameraIdentity:
    """The camera's name and its mode.

    ``name`` holds the configured source, which can mean another camera after replugging. ``device`` identifies the
    camera itself (`rig.bench.computer.Computer.camera_device`); None if it is not known.
    """

    name: str
    width: int
    height: int
    fps: float
    device: str | None = None

    def is_same_camera(self, other: "CameraIdentity") -> bool:
        """Return whether both are the same camera, by their names if one of the devices is not known."""
        if self.device is None or other.device is None:
            return self.name == other.name
        return self.device == other.device


@dataclass(frozen=True, slots=True)
class CameraLocks:
    """Settings that must not change between enrollment and identification; None if the camera does not report one."""

    exposure_us: float | None
    """Exposure time in microseconds."""
    gain: float | None
    """Gain, in the camera's own unit."""
    white_balance_k: float | None
    """Colour temperature of the white balance in kelvin."""
    auto_exposure: bool | None
    """Whether the camera changes the exposure time by itself."""
    auto_white_balance: bool | None
    """Whether the camera changes the white balance by itself."""
    focus: float | None = None
    """Focus, in the camera's own unit."""
    autofocus: bool | None = None
    """Whether the camera changes the focus by itself."""
    sharpness: float | None = None
    """Sharpening of the image, in the camera's own unit."""
    backlight_compensation: float | None = None
    """Backlight compensation, in the camera's own unit."""
    power_line_frequency: float | None = None
    """Flicker filter: 0 off, 1 for 50 Hz, 2 for 60 Hz, 3 automatic."""
    dynamic_frame_rate: bool | None = None
    """Whether the camera changes the frame rate by itself."""


@dataclass(frozen=True, slots=True)
class Frame:
    """An image; ``exposed_ns`` is the start of its exposure on the bench's clock.

    ``stamped`` says that the camera's own time stamp gave the time, and not the frame's arrival. ``repeated`` says that
    the image is that of the frame before (`rig.views.stream`).
    """

    image_bgr: NDArray[np.uint8]
    exposed_ns: int
    stamped: bool = True
    repeated: bool = False


class Camera(Protocol):
    """A source of frames."""

    observers: list[Callable[[NDArray[np.uint8]], object]]
    """Called with each image that `capture` returns: for displays."""

    @property
    def identity(self) -> CameraIdentity: ...

    def capture(self, after_ns: int, meanwhile: Callable[[], object] | None = None) -> Frame:
        """Return the first frame whose exposure began at or after ``after_ns``; older frames are dropped.

        ``meanwhile`` is called several times per second while the method waits for a slow camera. If it raises an
        error, the wait ends, and the next call waits again.
        """

    def read_locks(self) -> CameraLocks:
        """Return the settings as the camera reports them now."""

    def close(self) -> None: ...


class Capture(Protocol):
    """The part of `cv2.VideoCapture` that the driver uses, and what it lacks; another source subclasses it."""

    def isOpened(self) -> bool: ...  # noqa: N802

    def grab(self) -> bool: ...
    def retrieve(self) -> tuple[bool, Any]: ...
    def get(self, propId: int, /) -> float:
        """Return a property or, by its V4L2 number, a control; -1 if the camera lacks it."""

    def set(self, propId: int, value: float, /) -> bool: ...
    def release(self) -> None: ...
    def modes(self) -> tuple[VideoMode, ...]:
        """Return the modes that the source offers; empty if it does not tell."""
        return ()

    def offered_controls(self) -> tuple[VideoControl, ...]:
        """Return the controls that the source offers, with their present values; empty if it does not tell."""
        return ()

    def limits(self, propId: int, /) -> tuple[float, float] | None:  # noqa: ARG002
        """Return the smallest value and the step of a setting; None if the source does not tell."""
        return None

    def wait(self, seconds: float) -> bool | None:  # noqa: ARG002
        """Wait for a frame for at most this time; return whether `grab` then returns at once (it may fail).

        None if the source cannot wait.
        """
        return None
