"""A camera through OpenCV: settings are locked and read back, frames are selected by their time of exposure.

A UVC camera's driver buffers up to ten frames, so the next frame of `VideoCapture` may be old. The time of exposure is
known in one of three ways (`TimeBase`), which is determined when the camera is opened:

- stamped: ``CAP_PROP_POS_MSEC`` is the bench's monotonic clock in milliseconds, as in V4L2. Each frame has its time.
- paced: a live source with other stamps. A frame for which `grab` had to wait is new, and its exposure began at most
  `LATENCY_FRAMES` before it arrived. The frames before it empty the buffer.
- recorded: a source with a known number of frames, such as a video file. A frame counts as exposed when it is read.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.config import CameraConfig
from rig.core.clock import Clock, seconds_between
from rig.core.errors import DeviceFault, DeviceMismatch, DeviceNotFound, DeviceSilent
from rig.devices import v4l2
from rig.devices.camera import CameraIdentity, CameraLocks, Capture, Frame
from rig.devices.v4l2 import choose_mode

V4L2_EXPOSURE_MANUAL = 1  # V4L2_EXPOSURE_MANUAL of linux/v4l2-controls.h
_V4L2_EXPOSURE_AUTO = (0, 3)  # fully automatic, and aperture priority: the camera sets the time
_EXPOSURE_UNIT_US = 100.0  # V4L2_CID_EXPOSURE_ABSOLUTE

TIMEOUT_S = 3.0  # longer: an unplugged camera is noticed late; shorter: exposures of a dark bench time out
"""How long `OpenCvCamera.capture` waits for a new frame, and for a camera that was unplugged."""
LATENCY_FRAMES = 3
"""For a paced source: longest time from the start of the exposure until `grab` returns, in periods."""
_PROBES = 16  # frames to examine when opened: more than a driver buffers
_RETRIES = 5  # attempts to grab a frame
_FRESH_S = 1.0  # largest age of a frame that the camera just delivered
_STAMP_ERROR_NS = 2_000_000  # how far a stamp may be ahead of the clock
_SLICE_S = 0.1  # longest wait for a frame between two calls of ``meanwhile``
_REPLUG_PAUSE_S = 0.1
_UNKNOWN_PROPERTY = cv2.CAP_PROP_XI_AEAG  # V4L2 answers -1, other sources 0

_FOCUS_STILL_S, _FOCUS_LIMIT_S = 1.0, 8.0
_FOCUS_CHANGE = 0.1  # share of the sharpness that changes while the lens moves

NO_CONTROL: Final = "no such control"
"""What a camera reports for a setting that it lacks, as the text of a `RejectedSetting`."""
_LOCKS: Final[dict[str, tuple[int, Callable[[float], Any]]]] = {
    "exposure_us": (cv2.CAP_PROP_EXPOSURE, lambda value: value * _EXPOSURE_UNIT_US),
    "gain": (cv2.CAP_PROP_GAIN, float),
    "white_balance_k": (cv2.CAP_PROP_WB_TEMPERATURE, float),
    "auto_exposure": (cv2.CAP_PROP_AUTO_EXPOSURE, lambda value: value in _V4L2_EXPOSURE_AUTO),
    "auto_white_balance": (cv2.CAP_PROP_AUTO_WB, bool),
    "focus": (cv2.CAP_PROP_FOCUS, float),
    "autofocus": (cv2.CAP_PROP_AUTOFOCUS, bool),
    "sharpness": (cv2.CAP_PROP_SHARPNESS, float),
    "backlight_compensation": (cv2.CAP_PROP_BACKLIGHT, float),
    "power_line_frequency": (v4l2.POWER_LINE_FREQUENCY, float),
    "dynamic_frame_rate": (v4l2.EXPOSURE_DYNAMIC_FRAMERATE, bool),
}
"""Property of each field of `CameraLocks`, and the conversion to the field's unit."""


class TimeBase(Enum):
    """The ways in which the time of a frame is known."""

    STAMPED = "stamped"
    PACED = "paced"
    RECORDED = "recorded"


@dataclass(frozen=True, slots=True)
class RejectedSetting:
    """A setting that the camera did not accept: the requested and the reported value, as text."""

    setting: str
    asked: str
    reported: str


def _value_text(setting: str, value: float) -> str:
    if setting != "fourcc":
        return f"{value:g}"
    letters = max(round(value), 0).to_bytes(8, "little").rstrip(b"\0").decode("ascii", "replace")
    return letters if letters.isprintable() and letters else "unknown"


class OpenCvCamera:
    """`rig.devices.camera.Camera` on anything that behaves like `cv2.VideoCapture`.

    The camera closes ``capture``, an open source. None in ``settings`` leaves one to the camera, except the focus,
    which is locked after the autofocus. ``name`` and ``device`` are those of its `CameraIdentity`.

    ``reopen`` opens the source again (raises DeviceNotFound while it is missing): a camera that was unplugged for less
    than `TIMEOUT_S` gets its settings again and continues. ``node`` returns what identifies the device file now, None
    if it is missing. Another value than at the opening means that the camera was unplugged, because
    `cv2.VideoCapture.isOpened` stays True on V4L2.

    Raises `DeviceSilent`: the camera delivers no frames.
    """

    def __init__(
        self,
        capture: Capture,
        *,
        clock: Clock,
        settings: CameraConfig | None = None,
        name: str = "camera",
        device: str | None = None,
        reopen: Callable[[], Capture] | None = None,
        node: Callable[[], object] = lambda: None,
    ) -> None:
        self._capture = capture
        self._reopen = reopen
        self._node = node
        self._node_opened = node()
        self._settings = settings or CameraConfig()
        self._missing = capture.get(_UNKNOWN_PROPERTY)
        self.modes = capture.modes()
        self.observers: list[Callable[[NDArray[np.uint8]], object]] = []
        self._clock = clock
        # Lock the settings, then read back what the camera made of them.
        self._supported: set[int] = set()
        self.rejected_settings: tuple[RejectedSetting, ...] = self._configure(self._settings)
        """The settings that the camera did not accept."""
        self.identity = CameraIdentity(
            name,
            round(capture.get(cv2.CAP_PROP_FRAME_WIDTH)),
            round(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)),
            capture.get(cv2.CAP_PROP_FPS),
            device,
        )
        self._period_s = 1 / self.identity.fps if 1 <= self.identity.fps <= 1000 else 1 / 30
        self._latency_ns = round(LATENCY_FRAMES * self._period_s * 1e9)
        self._last_stamp_ns = -1
        self._arrived_ns = clock.now_ns()
        self._waits_s: deque[float] = deque([self._period_s], maxlen=4)
        # Only frames show how their time is known, and where the autofocus stops.
        self.time_base: TimeBase = TimeBase.STAMPED
        self.time_base = self._find_time_base()
        if self._settings.focus is None and self.time_base is not TimeBase.RECORDED:
            self._settle_focus()
        self._hold()

    def capture(self, after_ns: int, meanwhile: Callable[[], object] | None = None) -> Frame:
        """Return the first frame whose exposure began at or after ``after_ns``; older frames are dropped.

        ``meanwhile`` is called several times per second while the method waits for a slow or an unplugged camera. If it
        raises an error, the wait ends, and the next call waits again.

        Raises `DeviceSilent`: no such frame arrived within the time-out, or the camera stopped delivering frames.
        `DeviceMismatch`: after it was unplugged, another camera answers, or the camera has another mode.
        """
        # A camera that is slower than its mode says gets the time of three of its frames.
        deadline_ns = max(self._clock.now_ns(), after_ns) + round(max(TIMEOUT_S, 3 * max(self._waits_s)) * 1e9)
        dropped = 0
        while True:
            if self.time_base is TimeBase.RECORDED:
                self._clock.sleep(seconds_between(self._clock.now_ns(), after_ns))
            exposed_ns = self._grab(meanwhile)
            if exposed_ns is not None and exposed_ns >= after_ns:
                image_bgr = self._retrieve()
                for observer in self.observers:
                    observer(image_bgr)
                return Frame(image_bgr, exposed_ns, self.time_base is TimeBase.STAMPED)
            dropped += 1
            if self._clock.now_ns() > deadline_ns:
                raise DeviceSilent(
                    f"{self.identity.name} delivered no new frame in {TIMEOUT_S:g} s.",
                    next_step="Check the camera's cable. If the exposure is long or the USB bus is busy, give a longer "
                    "time-out.",
                    evidence={"dropped_frames": dropped, "time_base": self.time_base.value, "after_ns": after_ns},
                )

    @property
    def controls(self) -> tuple[v4l2.VideoControl, ...]:
        """The controls that the camera offers, with their present values; none if the source does not tell."""
        return self._capture.offered_controls()

    def read_locks(self) -> CameraLocks:
        reported = {name: (convert, self._known(prop)) for name, (prop, convert) in _LOCKS.items()}
        return CameraLocks(**{name: value if value is None else to(value) for name, (to, value) in reported.items()})

    def close(self) -> None:
        self._capture.release()

    # -- settings -----------------------------------------------------------------------------------------------------

    def _configure(self, settings: CameraConfig) -> tuple[RejectedSetting, ...]:
        """Request all settings; UVC requires that an automatic is switched off before its value is set."""
        asked: list[tuple[str, int, float, float]] = []

        def ask(name: str, prop: int, value: float | None) -> None:
            # 0 also describes a camera that lacks the control, and a camera without this automatic has none to end.
            if value is None or (value == 0 and self._known(prop) is None):
                return
            if prop == cv2.CAP_PROP_AUTO_EXPOSURE and self._lacks(prop):
                return
            smallest, step = self._capture.limits(prop) or (0.0, 0.0)
            if prop == cv2.CAP_PROP_GAIN:
                value = max(value, smallest)
            asked.append((name, prop, value, max(step / 2, 0 if name == "fourcc" else 0.01 * abs(value))))
            convertible = name != "fourcc" or _value_text(name, value) in v4l2.UNCOMPRESSED + v4l2.COMPRESSED
            # In another format, such as H.264, the camera would send frames that OpenCV cannot decode.
            if convertible and self._capture.set(prop, value):
                self._supported.add(prop)

        fourcc = settings.fourcc
        if fourcc is None and (mode := choose_mode(self.modes, settings.width, settings.height, settings.fps)):
            fourcc = mode.fourcc
        if fourcc is not None:  # before the size: it selects the sizes
            ask("fourcc", cv2.CAP_PROP_FOURCC, v4l2.fourcc_number(fourcc))
        ask("width", cv2.CAP_PROP_FRAME_WIDTH, settings.width)
        ask("height", cv2.CAP_PROP_FRAME_HEIGHT, settings.height)
        ask("fps", cv2.CAP_PROP_FPS, settings.fps)
        if settings.exposure_us is not None:
            ask("auto_exposure", cv2.CAP_PROP_AUTO_EXPOSURE, V4L2_EXPOSURE_MANUAL)
            ask("exposure_100us", cv2.CAP_PROP_EXPOSURE, round(settings.exposure_us / _EXPOSURE_UNIT_US))
            ask("dynamic_frame_rate", v4l2.EXPOSURE_DYNAMIC_FRAMERATE, 0)
        ask("gain", cv2.CAP_PROP_GAIN, settings.gain)
        ask("sharpness", cv2.CAP_PROP_SHARPNESS, settings.sharpness)
        ask("backlight_compensation", cv2.CAP_PROP_BACKLIGHT, settings.backlight_compensation)
        ask("power_line_frequency", v4l2.POWER_LINE_FREQUENCY, settings.power_line_frequency)
        if settings.white_balance_k is not None:
            ask("auto_white_balance", cv2.CAP_PROP_AUTO_WB, 0)
            ask("white_balance_k", cv2.CAP_PROP_WB_TEMPERATURE, settings.white_balance_k)
        if settings.focus is not None:
            ask("autofocus", cv2.CAP_PROP_AUTOFOCUS, 0)
        ask("focus", cv2.CAP_PROP_FOCUS, settings.focus)
        read_back = [(*one, self._capture.get(one[1])) for one in asked]
        return tuple(
            RejectedSetting(
                name, _value_text(name, value), NO_CONTROL if self._lacks(prop) else _value_text(name, reported)
            )
            for name, prop, value, tolerance, reported in read_back
            if prop not in self._supported or abs(reported - value) > tolerance
        )

    def _lacks(self, prop: int) -> bool:
        """Return whether the camera says that it lacks a control."""
        return self._missing < 0 and self._capture.get(prop) == self._missing

    def _known(self, prop: int) -> float | None:
        """Return a property; None if the camera lacks it: -1 on V4L2, where 0 is a true 0; else 0 if it was not set."""
        value = self._capture.get(prop)
        zero = value == 0 and (self._missing < 0 or prop in self._supported)
        return value if value > 0 or zero else None

    def _settle_focus(self) -> None:
        """Let the autofocus find its position, then lock the focus there."""
        if self._capture.get(cv2.CAP_PROP_AUTOFOCUS) <= 0:
            return
        start_ns = still_ns = self._clock.now_ns()
        before = (0.0, 0.0)
        while seconds_between(start_ns, self._clock.now_ns()) < _FOCUS_LIMIT_S:
            self._grab()
            grey = cv2.cvtColor(self._retrieve(), cv2.COLOR_BGR2GRAY)
            now = (self._capture.get(cv2.CAP_PROP_FOCUS), float(cv2.Laplacian(grey, cv2.CV_32F).var()))
            if now[0] != before[0] or abs(now[1] - before[1]) > _FOCUS_CHANGE * before[1]:
                before, still_ns = now, self._clock.now_ns()
            elif seconds_between(still_ns, self._clock.now_ns()) >= _FOCUS_STILL_S:
                break
        self._capture.set(cv2.CAP_PROP_AUTOFOCUS, 0)
        if (reported := self._capture.get(cv2.CAP_PROP_AUTOFOCUS)) != 0:
            self.rejected_settings += (RejectedSetting("autofocus", "0", f"{reported:g}"),)

    def _hold(self) -> None:
        """Request the camera's own values of the manual controls, too, when it was plugged in again."""
        locks = self.read_locks()
        # These are not requested by default, and a camera forgets them without power.
        names = ("focus", "sharpness", "backlight_compensation", "power_line_frequency")
        own: dict[str, Any] = {name: getattr(locks, name) for name in names if getattr(self._settings, name) is None}
        if locks.autofocus:
            del own["focus"]
        self._settings = self._settings.model_copy(update=own)

    # -- frames -------------------------------------------------------------------------------------------------------

    def _find_time_base(self) -> TimeBase:
        """Examine the first frames: after the old ones, the stamps of a stamped source are recent."""
        if self._capture.get(cv2.CAP_PROP_FRAME_COUNT) > 0:
            return TimeBase.RECORDED
        for _ in range(_PROBES):
            exposed_ns = self._grab()
            if self.time_base is TimeBase.PACED:
                break
            if exposed_ns is not None and seconds_between(exposed_ns, self._clock.now_ns()) < _FRESH_S:
                return TimeBase.STAMPED
        return TimeBase.PACED

    def _await(self, meanwhile: Callable[[], object]) -> None:
        """Wait until `grab` can return at once, because it blocks for ten seconds if a stream of V4L2 hangs.

        Raises `DeviceSilent`: the stream hangs.
        """
        limit_s, begun_ns = max(TIMEOUT_S, 3 * max(self._waits_s)), self._clock.now_ns()
        while self._capture.wait(_SLICE_S) is False:
            if seconds_between(begun_ns, self._clock.now_ns()) > limit_s:
                raise self._no_frames(1, limit_s)
            meanwhile()

    def _grab(self, meanwhile: Callable[[], object] | None = None) -> int | None:
        """Grab the next frame; return the start of its exposure on the bench's clock, or None if it may be old."""
        if self._reopen is None or self.time_base is TimeBase.RECORDED:
            return self._grab_now(meanwhile)
        if self._capture.isOpened():
            try:
                return self._grab_now(meanwhile)
            except DeviceSilent:
                if self._capture.isOpened() and self._node() == self._node_opened:
                    raise
        self._reconnect(self._reopen, meanwhile or (lambda: None))
        return self._grab_now(meanwhile)

    def _reconnect(self, reopen: Callable[[], Capture], meanwhile: Callable[[], object]) -> None:
        """Wait until the camera is connected again, and set it up as before."""
        # Wait for it.
        self._capture.release()
        meanwhile()
        end_ns = self._clock.now_ns() + round(TIMEOUT_S * 1e9)
        while True:
            try:
                self._capture = reopen()
                self._node_opened = self._node()
                break
            except DeviceNotFound as missing:
                if self._clock.now_ns() > end_ns:
                    raise DeviceSilent(
                        f"{self.identity.name} was disconnected for more than {TIMEOUT_S:g} s.",
                        next_step=missing.steps,
                        evidence=missing.evidence,
                    ) from missing
                self._clock.sleep(_REPLUG_PAUSE_S)
                meanwhile()
        # Set it up as before, and accept no other camera.
        meanwhile()
        self._last_stamp_ns = -1
        rejected_settings = self._configure(self._settings)
        expected = [self.identity.width, self.identity.height]
        got = [round(self._capture.get(prop)) for prop in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        meanwhile()
        if got != expected or rejected_settings != self.rejected_settings:
            raise DeviceMismatch(
                f"{self.identity.name} is another camera after it was unplugged, or has other settings.",
                next_step="Connect the first camera again, or start again with this one.",
                evidence={
                    "expected": expected,
                    "got": got,
                    "rejected_settings": [n.setting for n in rejected_settings],
                },
            )

    def _grab_now(self, meanwhile: Callable[[], object] | None) -> int | None:
        first_ns = self._clock.now_ns()
        attempts, waited_s = 0, 0.0
        while attempts < _RETRIES and waited_s <= TIMEOUT_S:  # V4L2 itself waits long for a hanging stream
            if attempts:
                self._clock.sleep(self._period_s)
            asked_ns = self._clock.now_ns()
            if meanwhile is not None and self.time_base is not TimeBase.RECORDED:
                self._await(meanwhile)
            if self._capture.grab():
                self._note_arrival(asked_ns)
                return self._exposed_ns(asked_ns)
            attempts += 1
            waited_s = seconds_between(first_ns, self._clock.now_ns())
        raise self._no_frames(attempts, waited_s)

    def _no_frames(self, attempts: int, waited_s: float) -> DeviceSilent:
        return DeviceSilent(
            f"{self.identity.name} delivers no frames: {attempts} attempts failed."
            if attempts > 1
            else f"{self.identity.name} hangs: no frame in {waited_s:.0f} s.",
            next_step="The recording has ended."
            if self._capture.get(cv2.CAP_PROP_FRAME_COUNT) > 0
            else "Check the camera's cable, and that no other program uses it.",
            evidence={"attempts": attempts, "still_open": self._capture.isOpened()},
        )

    def _note_arrival(self, asked_ns: int) -> None:
        """Measure the time that the camera takes for a frame, after a wait for one."""
        now_ns = self._clock.now_ns()
        if seconds_between(asked_ns, now_ns) > self._period_s / 4:
            self._waits_s.append(seconds_between(asked_ns, now_ns))
            since_s = seconds_between(self._arrived_ns, now_ns)
            if since_s < 2 * max(self._waits_s):  # the next frame: its whole period, not only the end of it
                self._waits_s.append(since_s)
            self._arrived_ns = now_ns

    def _exposed_ns(self, asked_ns: int) -> int | None:
        now_ns = self._clock.now_ns()
        if self.time_base is TimeBase.RECORDED:
            return asked_ns
        if self.time_base is TimeBase.STAMPED:
            stamp_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            if self._last_stamp_ns < stamp_ns <= now_ns + _STAMP_ERROR_NS:
                self._last_stamp_ns = stamp_ns
                return stamp_ns
            self.time_base = TimeBase.PACED  # stamps that repeat or are in the future do not belong to this clock
        waited = seconds_between(asked_ns, now_ns) > self._period_s / 4
        return now_ns - self._latency_ns if waited else None

    def _retrieve(self) -> np.ndarray[Any, np.dtype[np.uint8]]:
        ok, image = self._capture.retrieve()
        if not ok or image is None:
            raise DeviceSilent(
                f"{self.identity.name} lost a frame between grabbing and decoding it.",
                next_step="Try again. If this repeats, try another cable or USB port.",
            )
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise DeviceFault(
                f"{self.identity.name} delivers {image.dtype} images of shape {image.shape}, not 8-bit colour images.",
                next_step="Choose a colour format that OpenCV converts (`v4l2-ctl --list-formats`).",
            )
        expected, got = (self.identity.width, self.identity.height), (image.shape[1], image.shape[0])
        if got != expected and all(expected):
            raise DeviceFault(
                f"{self.identity.name} delivers frames of {got[0]}x{got[1]} pixels, but it was opened with "
                f"{expected[0]}x{expected[1]}.",
                next_step="Open the bench again. If this repeats, the camera resets: try another cable or USB port.",
                evidence={"got": list(got), "expected": list(expected)},
            )
        return np.asarray(image, dtype=np.uint8)
