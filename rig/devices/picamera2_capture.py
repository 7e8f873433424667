"""A camera on the ribbon cable of a Raspberry Pi, through picamera2: `camera.source = "picamera2"`.

libcamera, which develops the images of these sensors, cannot be reached through OpenCV. `Picamera2Capture` has the
interface of `cv2.VideoCapture`, so that `rig.devices.opencv_camera.OpenCvCamera` locks and reads back its settings as
those of any camera. picamera2 is imported only when such a camera is opened.

Decision: docs/decisions/0007.
"""

import importlib
import re
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError
from contextlib import suppress
from math import log10, prod
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.core.errors import DeviceNotFound
from rig.core.next_steps import Do
from rig.devices import v4l2
from rig.devices.camera import Capture

INSTALL: Final = (
    "Install it: `sudo apt install -y python3-picamera2`, and make the Python environment with access to it: "
    "`python3 -m venv --system-site-packages ~/rig-env`."
)
REPAIR: Final = (
    f"On Raspberry Pi OS 12 (bookworm): `{sys.executable} -m pip install --ignore-installed --no-deps simplejpeg`, "
    "because the system's simplejpeg needs NumPy 1, and this Python has NumPy 2. On Raspberry Pi OS 13 (trixie), or if "
    "that does not help: `sudo apt install --reinstall -y python3-picamera2 python3-libcamera python3-simplejpeg`."
)
_SOURCE: Final = re.compile(r"picamera2(?::(\d+))?")
_FORMAT: Final = "RGB888"  # libcamera's name for the order B, G, R
_FRAME_WAIT_S: Final = 3.0  # longer: an unplugged camera is noticed late; shorter: a long exposure looks like one
_SETTLE_FRAMES: Final = 12
"""Frames after which changed settings are certainly in force: sensor and image processor delay them by several."""
_NOMINAL_FPS: Final = 30.0  # until the frame durations of the sensor's mode are known
_MANUAL_FOCUS, _CONTINUOUS_FOCUS = 0, 2  # libcamera's AfMode
_Setting = tuple[str, Callable[[float], Any], Callable[[Any], float]]
"""libcamera's name of a setting, what is requested of it, and what its value means."""
_REQUESTED: Final[Mapping[int, _Setting]] = {
    cv2.CAP_PROP_AUTO_EXPOSURE: ("AeEnable", lambda v: v != 1, lambda on: 3.0 if on else 1.0),
    cv2.CAP_PROP_AUTO_WB: ("AwbEnable", bool, float),
    cv2.CAP_PROP_AUTOFOCUS: (
        "AfMode",
        lambda v: _CONTINUOUS_FOCUS if v else _MANUAL_FOCUS,
        lambda mode: float(mode != _MANUAL_FOCUS),
    ),
    cv2.CAP_PROP_SHARPNESS: ("Sharpness", float, lambda v: round(float(v), 2)),
}
"""Settings that no frame reports: libcamera keeps to what was requested."""
_REPORTED: Final[Mapping[int, _Setting]] = {
    cv2.CAP_PROP_EXPOSURE: ("ExposureTime", lambda v: round(v * 100), lambda v: max(float(round(v / 100)), 1.0)),
    cv2.CAP_PROP_GAIN: ("AnalogueGain", lambda v: 10 ** (v / 20), lambda v: max(round(20 * log10(v), 1), 0.0)),
    cv2.CAP_PROP_WB_TEMPERATURE: ("ColourTemperature", round, lambda v: float(round(v, -1))),
    cv2.CAP_PROP_FOCUS: ("LensPosition", float, lambda v: round(v, 2)),
}
"""Settings that the metadata of a frame report."""


def camera_number(source: object) -> int | None:
    """Return the number of the camera that ``picamera2`` or ``picamera2:1`` names; None for another source."""
    found = _SOURCE.fullmatch(str(source))
    return int(found[1] or 0) if found else None


def camera_id(number: int) -> str | None:
    """Return the identity of a camera: its sensor and its connector; None without the camera or picamera2."""
    try:
        cameras = import_picamera2().Picamera2.global_camera_info()
    except DeviceNotFound:
        return None
    return f"{cameras[number]['Model']} at {cameras[number]['Id']}" if number < len(cameras) else None


def import_picamera2() -> Any:
    """Return the module picamera2. Raises `DeviceNotFound` if it is not installed, or cannot be imported."""
    try:
        return importlib.import_module("picamera2")
    except ModuleNotFoundError as error:
        raise DeviceNotFound(
            "The camera of the Raspberry Pi needs picamera2, which this Python does not have.",
            next_step=INSTALL,
            evidence={"reason": str(error)},
        ) from error
    except Exception as error:  # a package below it can raise anything, for example ValueError for another NumPy
        raise DeviceNotFound(
            "The camera of the Raspberry Pi needs picamera2, which is installed, but cannot be imported.",
            next_step=REPAIR,
            evidence={"reason": f"{type(error).__name__}: {error}"},
        ) from error


class Picamera2Capture(Capture):
    """An open camera of a Raspberry Pi, as a `rig.devices.camera.Capture`.

    Units are those of OpenCV's V4L2 backend where there are any: exposure in 100 µs, white balance in kelvin. Gain is
    in decibels (20 log10 of libcamera's AnalogueGain), focus in dioptres (LensPosition), sharpness as libcamera's.
    `get` returns the value in the metadata of a frame, -1 for a setting that the camera lacks.

    ``number`` is that of `rpicam-hello --list-cameras`: the place in the list, which is not libcamera's own number
    ("Num").

    Raises `DeviceNotFound`: picamera2 is not installed or cannot be imported, there is no such camera, or another
    program uses it. `grab` and `wait` raise it if the camera cannot be started, or is not one of a Raspberry Pi.
    """

    def __init__(self, number: int) -> None:
        library = import_picamera2()
        cameras = library.Picamera2.global_camera_info()
        if number >= len(cameras):
            raise DeviceNotFound(
                f"libcamera finds no camera {number}.",
                next_step="Switch the computer off and check the ribbon cable; `rpicam-hello --list-cameras` lists the "
                "cameras that are found.",
                evidence={"found": [str(one.get("Model")) for one in cameras]},
            )
        try:
            self._camera = library.Picamera2(number)
        except RuntimeError as error:
            raise DeviceNotFound(
                f"The camera {number} of the Raspberry Pi cannot be opened.",
                next_step="Close the program that uses it, for example rpicam-hello.",
                evidence={"reason": str(error.__context__ or error)},
            ) from error
        self._modes = [mode for mode in self._camera.sensor_modes if "crop_limits" in mode]  # a USB camera has none
        self._size = (640, 480)
        self._fps = _NOMINAL_FPS
        self._fixed_rate = False
        self._asked: dict[str, Any] = {}
        if "AfMode" in self._controls:  # the lens starts at a fixed distance; `OpenCvCamera` locks the found focus
            self._asked["AfMode"] = _CONTINUOUS_FOCUS
        self._request: Any = None
        self._metadata: Mapping[str, Any] = {}
        self._open, self._running, self._settling = True, False, False
        self._silent_s = 0.0
        """How long there has been no frame."""
        self._waiting = False
        """Whether `wait` has taken a frame that `grab` has not returned yet."""

    # -- interface of cv2.VideoCapture --------------------------------------------------------------------------------

    def isOpened(self) -> bool:  # noqa: N802
        return self._open

    def grab(self) -> bool:
        """Take the next frame; False if none arrives in time."""
        if not self._open:
            return False
        if not self._waiting:
            self._take(_FRAME_WAIT_S)
        self._waiting = False
        return self._request is not None

    def wait(self, seconds: float) -> bool:
        """Wait for a frame for at most this time; return whether `grab` then returns at once."""
        if self._open and not self._waiting:
            self._take(seconds)
            self._waiting = self._request is not None
        return self._waiting or not self._open

    def _take(self, seconds: float) -> None:
        """Take the next frame in place of the last one; there is no frame if none arrives in time."""
        self._start()
        self._release_request()
        job = self._camera.capture_request(wait=False)
        with suppress(TimeoutError, CancelledError):
            try:
                self._request = job.get_result(timeout=seconds)
            except TimeoutError:
                self._camera.cancel_all_and_flush()  # or it would later take a buffer that is never given back
                self._request = job.get_result(timeout=_FRAME_WAIT_S)  # it may have taken one at the last moment
        self._silent_s = 0.0 if self._request is not None else self._silent_s + seconds
        if self._request is not None:
            self._metadata = self._request.get_metadata()
        elif self._silent_s >= _FRAME_WAIT_S:  # libcamera gives a silent sensor up, until the camera starts again
            self._stop()

    def retrieve(self) -> tuple[bool, NDArray[np.uint8] | None]:
        """Return the frame that was grabbed last, uint8 (H, W, 3) BGR."""
        if self._request is None:
            return False, None
        return True, np.array(self._request.make_array("main"), dtype=np.uint8)

    def release(self) -> None:
        """Stop the camera and close it; a second call does nothing."""
        if self._open:
            self._open = False
            self._stop()
            self._camera.close()

    def get(self, propId: int, /) -> float:
        match propId:
            case cv2.CAP_PROP_FRAME_WIDTH:
                return float(self._size[0])
            case cv2.CAP_PROP_FRAME_HEIGHT:
                return float(self._size[1])
            case cv2.CAP_PROP_FPS:
                return min(self._fps, float(self._mode.get("fps", self._fps)))
            case cv2.CAP_PROP_POS_MSEC:
                return self._exposed_ms()
            case v4l2.EXPOSURE_DYNAMIC_FRAMERATE if "FrameDurationLimits" in self._controls:
                return float(not self._fixed_rate)
            case _ if propId in _REQUESTED and (name := _REQUESTED[propId][0]) in self._controls:
                # Until something is requested, the automatics are on, and a value is the default one.
                initial = True if name in ("AeEnable", "AwbEnable") else self._controls[name][2]
                return _REQUESTED[propId][2](self._asked.get(name, initial))
            case _ if propId in _REPORTED and (name := _REPORTED[propId][0]) in self._controls:
                return self._reported(name, _REPORTED[propId][2])
        return -1.0

    def limits(self, propId: int, /) -> tuple[float, float] | None:
        if propId != cv2.CAP_PROP_GAIN or "AnalogueGain" not in self._controls:
            return None
        return round(20 * log10(self._controls["AnalogueGain"][0]), 1), 0.1

    def set(self, propId: int, value: float, /) -> bool:
        match propId:
            case cv2.CAP_PROP_FRAME_WIDTH:
                return self._resize(round(value), self._size[1])
            case cv2.CAP_PROP_FRAME_HEIGHT:
                return self._resize(self._size[0], round(value))
            case cv2.CAP_PROP_FPS:
                self._fps = value
                return self._control("FrameDurationLimits", (round(1e6 / value),) * 2) if self._fixed_rate else True
            case v4l2.EXPOSURE_DYNAMIC_FRAMERATE if not value:
                self._fixed_rate = self._control("FrameDurationLimits", (round(1e6 / self._fps),) * 2)
                return self._fixed_rate
        if (setting := {**_REQUESTED, **_REPORTED}.get(propId)) is None:
            return False
        name, requested, _ = setting
        return self._control(name, requested(value))

    # -- libcamera ----------------------------------------------------------------------------------------------------

    @property
    def _controls(self) -> Mapping[str, tuple[Any, Any, Any]]:
        """The controls of the camera: lowest, highest and default value."""
        controls: Mapping[str, tuple[Any, Any, Any]] = self._camera.camera_controls
        return controls

    def _control(self, name: str, value: Any) -> bool:
        """Request a setting, within its range; return whether the camera has it."""
        if name not in self._controls:
            return False
        low, high, _ = self._controls[name]
        if isinstance(value, int | float) and not isinstance(value, bool):
            value = type(value)(min(max(value, low), high))
        self._asked[name] = value
        if self._running:
            self._camera.set_controls({name: value})
            self._settling = True
        return True

    def _reported(self, name: str, meant: Callable[[float], float]) -> float:
        """Return a setting from the metadata of a frame that was exposed with the present settings."""
        if self._open and (self._settling or not self._metadata):
            for _ in range(_SETTLE_FRAMES):
                if not self.grab():
                    break
            self._settling = False
        value = self._metadata.get(name)
        return -1.0 if value is None else float(meant(value))

    def _resize(self, width: int, height: int) -> bool:
        if (width, height) != self._size:
            self._size = (width, height)
            self._stop()
        return True

    @property
    def _mode(self) -> Mapping[str, Any]:
        """The mode of the sensor: with its widest field of view, then with enough pixels, then the fastest one.

        By itself, picamera2 chooses the mode that is nearest in size. At 640x480 that one uses only 0.39 of the width
        of a Camera Module 2, and 0.67 of that of a Camera Module 3.
        """

        def rank(mode: Mapping[str, Any]) -> tuple[int, bool, int, int]:
            pixels = prod(mode["size"])
            few = mode["size"][0] < self._size[0] or mode["size"][1] < self._size[1]
            return -prod(mode["crop_limits"][2:]), few, -pixels if few else pixels, -mode["bit_depth"]

        return min(self._modes, key=rank, default={})

    def _start(self) -> None:
        """Start the camera with all requested settings."""
        if self._running:
            return
        mode = self._mode
        config = self._camera.create_video_configuration(
            main={"size": self._size, "format": _FORMAT},
            sensor={"output_size": mode["size"], "bit_depth": mode["bit_depth"]} if mode else {},
            controls=dict(self._asked),
            buffer_count=4,
        )
        try:
            self._camera.configure(config)
            main = self._camera.camera_configuration()["main"]
            if main["format"] == _FORMAT:
                self._camera.start()
        except (RuntimeError, OSError) as error:
            raise DeviceNotFound(
                "The camera of the Raspberry Pi cannot be started.",
                next_step="Check its cable. If the reason is memory, set a smaller camera.width and camera.height.",
                evidence={"reason": str(error)},
            ) from error
        if main["format"] != _FORMAT:
            raise DeviceNotFound(
                f"libcamera delivers {main['format']} images of this camera, so it is not on a ribbon cable.",
                next_step=("Open a USB camera by its device file. To list them,", Do.FIND()),
                evidence={"format": main["format"]},
            )
        self._size = tuple(main["size"])  # libcamera may align it
        self._running = self._settling = True

    def _stop(self) -> None:
        """Stop the camera if it runs; `_start` starts it again."""
        self._release_request()
        if self._running:
            self._running, self._silent_s = False, 0.0
            with suppress(RuntimeError, OSError):  # it is gone
                self._camera.stop()

    def _release_request(self) -> None:
        """Give the buffer of the last frame back; without free buffers the camera stops."""
        self._waiting = False
        if self._request is not None:
            self._request.release()
            self._request = None

    def _exposed_ms(self) -> float:
        """Return the start of the exposure on the monotonic clock.

        The driver dates the start of the readout of the first row (SensorTimestamp), which is the end of its exposure.
        """
        stamp_ns = self._metadata.get("SensorTimestamp")
        if stamp_ns is None:
            return 0.0
        return float(stamp_ns) * 1e-6 - float(self._metadata.get("ExposureTime", 0)) * 1e-3
