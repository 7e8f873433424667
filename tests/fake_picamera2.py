"""A fake of the Python package picamera2 in front of the simulated camera: a Raspberry Pi with a Camera Module 2 or 3.

It has the part of picamera2's interface that `rig.devices.picamera2_capture` uses, with the behaviour that a driver can
handle wrongly: settings take effect some frames later, only the metadata of a frame contain the settings in force, a
name that the camera lacks is an error, there are only as many frames as released buffers, the time stamp is that of the
readout, most modes of the sensor see a part of its field only, a camera's place in the list is not libcamera's number,
and after a time without frames it must be stopped and started. The list ends with a USB webcam.
`tests/kernel/test_picamera2.py` has the same behaviour from picamera2 itself.
"""

from collections import deque
from concurrent.futures import CancelledError
from math import log10
from types import ModuleType
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.core.clock import Clock
from sim.camera import SimCapture

DELAY_FRAMES: Final = 7
"""Frames until a setting is in force: as many as wait in buffers, and the delay of the sensor."""
WEBCAM: Final = "HD Pro Webcam C920"
_LONGEST_US: Final = 33_000
_CONTROLS: Final[dict[str, tuple[Any, Any, Any]]] = {
    "AeEnable": (False, True, True),
    "AfMode": (0, 2, 0),
    "AnalogueGain": (1.0, 16.0, 1.0),
    "AwbEnable": (False, True, True),
    "ColourTemperature": (2800, 6500, 5000),
    "ExposureTime": (100, _LONGEST_US, 20_000),
    "FrameDurationLimits": (33_333, 120_000, 33_333),
    "LensPosition": (0.0, 15.0, 1.0),
    "Sharpness": (0.0, 16.0, 1.0),
}
MODES: Final[dict[str, tuple[tuple[tuple[int, int], float, tuple[int, int, int, int]], ...]]] = {
    "imx219": (
        ((640, 480), 103.33, (1000, 752, 1280, 960)),
        ((1640, 1232), 41.85, (0, 0, 3280, 2464)),
        ((1920, 1080), 47.57, (680, 692, 1920, 1080)),
        ((3280, 2464), 21.19, (0, 0, 3280, 2464)),
    ),
    "imx708": (
        ((1536, 864), 120.13, (768, 432, 3072, 1728)),
        ((2304, 1296), 56.03, (0, 0, 4608, 2592)),
        ((4608, 2592), 14.35, (0, 0, 4608, 2592)),
    ),
}
"""Modes of a Camera Module 2 and of a 3, as picamera2 lists them: size, frames/s, and part of the sensor."""
_FOCUS_PER_DIOPTRE: Final = 17.0  # the simulated lens has 0 to 255


class Picamera2:
    """A camera that is not started; ``sensor`` sees the simulated world. See picamera2's manual for the methods."""

    sensor: SimCapture
    clock: Clock
    model = "imx708"
    in_use = False

    def __init__(self, camera_num: int = 0) -> None:
        if camera_num >= len(self.global_camera_info()):
            raise RuntimeError(f"No camera number {camera_num} found")
        if type(self).in_use:
            try:
                raise RuntimeError("Failed to acquire camera: Device or resource busy")
            except RuntimeError as busy:
                raise RuntimeError("Camera __init__ sequence did not complete.") from busy
        type(self).in_use = True
        self._webcam = camera_num > 0
        self._config: dict[str, Any] | None = None
        self._started = self._closed = self._given_up = False
        self._pending: deque[tuple[int, dict[str, Any]]] = deque()
        self._jobs: list[Job] = []
        self._frames = 0
        self.held = 0
        self.field = 1.0
        """Share of the sensor's width that the mode sees."""
        self.sensor.reopen()

    @classmethod
    def global_camera_info(cls) -> list[dict[str, Any]]:
        return [
            {"Model": cls.model, "Location": 2, "Rotation": 180, "Id": f"/base/axi/pcie/i2c/{cls.model}@1a", "Num": 1},
            {"Model": WEBCAM, "Location": 2, "Id": "/base/axi/pcie/usb-1:1.0-046d:082d", "Num": 0},
        ]

    @property
    def camera_controls(self) -> dict[str, tuple[Any, Any, Any]]:
        return {} if self._closed else {"ExposureTime": (100, 33_300, 10_000)} if self._webcam else dict(_CONTROLS)

    @property
    def sensor_modes(self) -> list[dict[str, Any]]:
        assert not self._started  # it configures the camera in each mode
        if self._webcam:
            return [{"format": "MJPEG"}]
        return [
            {"format": f"SRGGB{bits}", "bit_depth": bits, "size": size, "fps": fps, "crop_limits": crop}
            for bits in (10, 8)
            for size, fps, crop in MODES[self.model]
        ]

    def create_video_configuration(
        self,
        main: dict[str, Any] | None = None,
        controls: dict[str, Any] | None = None,
        buffer_count: int = 6,
        sensor: dict[str, Any] | None = None,
    ) -> dict[str, Any]:
        asked = {"format": "XBGR8888", "size": (1280, 720)} | (main or {})
        asked["size"] = tuple(pixels - pixels % 2 for pixels in asked["size"])
        return {
            "main": asked,
            "sensor": sensor or {},
            "controls": controls or {},
            "buffer_count": buffer_count,
        }

    def configure(self, config: dict[str, Any]) -> None:
        if self._started:
            raise RuntimeError("Camera must be stopped before configuring")
        if config["main"]["format"] != "RGB888":
            raise RuntimeError("the fake has one pixel format")
        width = config["main"]["size"][0]
        self._check(config["controls"])
        self.sensor.set(cv2.CAP_PROP_FRAME_WIDTH, 640 if width > 480 else 320)
        size = tuple(int(self.sensor.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        nearest = config["sensor"].get("output_size", config["main"]["size"])

        def distance(mode: tuple[tuple[int, int], float, tuple[int, int, int, int]]) -> float:
            """libcamera's measure of a mode: pixels that lack, pixels too many, and another shape."""
            shape = (mode[0][0] / mode[0][1], nearest[0] / nearest[1])
            pairs = (*zip(mode[0], nearest, strict=True), tuple(1500 * one for one in shape))
            return sum(2 * (asked - has) if asked > has else (has - asked) / 4 for has, asked in pairs)

        _, _, (_, _, seen, _) = min(MODES[self.model], key=distance)
        self.field = seen / MODES[self.model][-1][0][0]
        pixel_format = "MJPEG" if self._webcam else "RGB888"
        self._config = config | {"main": config["main"] | {"size": size, "format": pixel_format}}

    def camera_configuration(self) -> dict[str, Any]:
        assert self._config is not None
        return self._config

    def start(self) -> None:
        if self._config is None:
            raise RuntimeError("Camera has not been configured")
        self._started, self._given_up = True, False
        self._pending.clear()
        self._apply(self._config["controls"])

    def stop(self) -> None:
        self._started = False

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            type(self).in_use = False

    def set_controls(self, controls: dict[str, Any]) -> None:
        self._check(controls)
        self._pending.append((self._frames + DELAY_FRAMES, dict(controls)))

    def capture_request(self, wait: bool | float | None = None) -> "CompletedRequest | Job":
        """Return the next frame within the seconds to wait; without these, a job that takes it."""
        self._jobs.append(job := Job(self))
        return job.get_result(wait) if wait else job

    def cancel_all_and_flush(self) -> None:
        """Cancel the jobs that wait for a frame."""
        for job in self._jobs:
            job.cancelled = True
        self._jobs.clear()

    def complete(self, last: "Job", timeout_s: float) -> "CompletedRequest":
        """Let the jobs take their frames in turn up to the last one, and return its frame."""
        if self.sensor.hangs:  # libcamera gives the sensor up
            self._given_up = True
        while last in self._jobs:
            free = self._config is not None and self.held < self._config["buffer_count"]
            if not (self._started and free) or self._given_up or not self.sensor.grab():
                self.clock.sleep(timeout_s)
                raise TimeoutError
            while self._pending and self._pending[0][0] <= self._frames:
                self._apply(self._pending.popleft()[1])
            self._frames += 1
            self._jobs.pop(0).frame = CompletedRequest(self)
        assert last.frame is not None
        return last.frame

    def _check(self, controls: dict[str, Any]) -> None:
        for name in controls:
            if name not in self.camera_controls:
                raise RuntimeError(f"Control {name} is not advertised by libcamera")

    def _apply(self, controls: dict[str, Any]) -> None:
        """Set the sensor; a value is in force only while its automatic is off."""
        sensor = self.sensor
        automatics = {"AeEnable": cv2.CAP_PROP_AUTO_EXPOSURE, "AwbEnable": cv2.CAP_PROP_AUTO_WB}
        for name, prop in automatics.items():
            if name in controls:
                sensor.set(prop, (3 if controls[name] else 1) if name == "AeEnable" else int(controls[name]))
        if "AfMode" in controls:
            sensor.set(cv2.CAP_PROP_AUTOFOCUS, int(controls["AfMode"] != 0))
        if "ExposureTime" in controls:
            sensor.set(cv2.CAP_PROP_EXPOSURE, controls["ExposureTime"] / 100)
        if "AnalogueGain" in controls:
            sensor.set(cv2.CAP_PROP_GAIN, round(20 * log10(controls["AnalogueGain"])))
        if "ColourTemperature" in controls:
            sensor.set(cv2.CAP_PROP_WB_TEMPERATURE, controls["ColourTemperature"])
        if "LensPosition" in controls and not sensor.get(cv2.CAP_PROP_AUTOFOCUS):
            sensor.set(cv2.CAP_PROP_FOCUS, round(controls["LensPosition"] * _FOCUS_PER_DIOPTRE))


class Job:
    """A request that waits for a frame. It keeps waiting after its time-out, until it is cancelled."""

    def __init__(self, camera: Picamera2) -> None:
        self._camera = camera
        self.frame: CompletedRequest | None = None
        self.cancelled = False

    def get_result(self, timeout: float) -> "CompletedRequest":
        if self.cancelled:
            raise CancelledError
        return self.frame or self._camera.complete(self, timeout)


class CompletedRequest:
    """A frame in its buffer, until it is released."""

    def __init__(self, camera: Picamera2) -> None:
        sensor = camera.sensor
        self._camera = camera
        self._released = False
        camera.held += 1
        exposure_us = int(sensor.get(cv2.CAP_PROP_EXPOSURE) * 100) - 8  # whole lines of the sensor
        begun_ns = round(sensor.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        self._metadata = {
            "SensorTimestamp": begun_ns + exposure_us * 1000,
            "ExposureTime": exposure_us,
            "AnalogueGain": 10 ** (sensor.get(cv2.CAP_PROP_GAIN) / 20),
            "ColourTemperature": int(sensor.get(cv2.CAP_PROP_WB_TEMPERATURE)),
            "LensPosition": sensor.get(cv2.CAP_PROP_FOCUS) / _FOCUS_PER_DIOPTRE,
        }

    def get_metadata(self) -> dict[str, Any]:
        return dict(self._metadata)

    def make_array(self, name: str) -> NDArray[np.uint8]:
        assert name == "main"
        assert not self._released
        _, image = self._camera.sensor.retrieve()
        assert image is not None
        lost = [round(pixels * (1 - self._camera.field) / 2) for pixels in image.shape[:2]]
        seen = image[lost[0] : image.shape[0] - lost[0], lost[1] : image.shape[1] - lost[1]]
        return np.asarray(cv2.resize(seen, image.shape[1::-1]), np.uint8)

    def release(self) -> None:
        if self._released:
            raise RuntimeError("CompletedRequest: lock now has negative ref_count")
        self._released = True
        self._camera.held -= 1


def module(sensor: SimCapture, clock: Clock, model: str = "imx708") -> ModuleType:
    """Return a module ``picamera2`` whose camera of a model is ``sensor``; a test puts it into `sys.modules`."""
    sensor.remembers = False  # libcamera reports the settings of each frame
    fake: Any = ModuleType("picamera2")
    fake.Picamera2 = type(
        "Picamera2", (Picamera2,), {"sensor": sensor, "clock": clock, "model": model, "in_use": False}
    )
    return fake  # type: ignore[no-any-return]
