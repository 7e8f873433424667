"""The settings of the simulated camera, in the units of OpenCV's V4L2 backend."""

from dataclasses import dataclass, replace
from typing import Any

import cv2

from rig.devices import v4l2
from sim.frame_times import FPS
from sim.sensor import Gains, white_balance

NOMINAL_EXPOSURE = 100  # exposure at which the frame has the scene's grey levels, in V4L2's unit of 100 µs
V4L2_EXPOSURE_MANUAL, V4L2_EXPOSURE_APERTURE_PRIORITY = 1, 3
# The ranges and defaults of a usual UVC webcam. The longest exposure is the time between two frames.
EXPOSURE_RANGE = (1, 10_000 // FPS)
KELVIN_RANGE = (2800, 6500)
SHARP_AT = 120
BUFFERS_RANGE = (1, 10)
_SWITCHES = {
    cv2.CAP_PROP_AUTO_WB: "auto_white_balance",
    cv2.CAP_PROP_AUTOFOCUS: "autofocus",
    v4l2.EXPOSURE_DYNAMIC_FRAMERATE: "dynamic_frame_rate",
}
_NUMBERS: dict[int, tuple[str, tuple[int, int], str]] = {
    cv2.CAP_PROP_EXPOSURE: ("exposure", EXPOSURE_RANGE, "auto_exposure"),
    cv2.CAP_PROP_GAIN: ("gain_db", (0, 24), ""),
    cv2.CAP_PROP_WB_TEMPERATURE: ("kelvin", KELVIN_RANGE, "auto_white_balance"),
    cv2.CAP_PROP_FOCUS: ("focus", (0, 255), "autofocus"),
    cv2.CAP_PROP_SHARPNESS: ("sharpness", (0, 255), ""),
    cv2.CAP_PROP_BACKLIGHT: ("backlight_compensation", (0, 1), ""),
}
"""Fields of `Controls` by property; of a number its range, and the automatic that keeps programs from setting it."""


@dataclass(frozen=True, slots=True)
class Controls:
    """The camera's settings: exposure in 100 µs, gain in dB, white balance in kelvin."""

    auto_exposure: bool = True
    exposure: float = NOMINAL_EXPOSURE
    gain_db: float = 0.0
    auto_white_balance: bool = True
    kelvin: float = 4600.0
    autofocus: bool = False
    focus: float = SHARP_AT
    buffers: int = 4
    sharpness: float = 3
    backlight_compensation: float = 0
    power_line_frequency: float = 2
    dynamic_frame_rate: bool = True

    @property
    def exposure_ns(self) -> int:
        return round(self.exposure * 100_000)

    @property
    def gains(self) -> Gains:
        gain = 10 ** (self.gain_db / 20)
        b, g, r = white_balance(self.kelvin)
        return gain * b, gain * g, gain * r

    @property
    def values(self) -> dict[int, float]:
        """The values that OpenCV reads."""
        read = {prop: getattr(self, name) for prop, name in _SWITCHES.items()}
        read |= {prop: getattr(self, name) for prop, (name, *_) in _NUMBERS.items()}
        return read | {
            cv2.CAP_PROP_BUFFERSIZE: self.buffers,
            cv2.CAP_PROP_AUTO_EXPOSURE: V4L2_EXPOSURE_APERTURE_PRIORITY if self.auto_exposure else V4L2_EXPOSURE_MANUAL,
            cv2.CAP_PROP_EXPOSURE: round(self.exposure),  # the automatics change it by less than a step
            cv2.CAP_PROP_WB_TEMPERATURE: round(self.kelvin),
            v4l2.POWER_LINE_FREQUENCY: self.power_line_frequency,
        }

    def with_value(self, prop: int, value: float) -> "Controls | None":
        """Return the settings after OpenCV has set a property; None if the camera does not accept it now."""
        match prop:
            case cv2.CAP_PROP_AUTO_EXPOSURE if value in (V4L2_EXPOSURE_MANUAL, V4L2_EXPOSURE_APERTURE_PRIORITY):
                auto = value == V4L2_EXPOSURE_APERTURE_PRIORITY
                return replace(self, auto_exposure=auto, exposure=round(self.exposure))
            case cv2.CAP_PROP_AUTO_WB:
                return replace(self, auto_white_balance=bool(value), kelvin=round(self.kelvin))
            case v4l2.POWER_LINE_FREQUENCY if 0 <= value <= 2:
                return replace(self, power_line_frequency=int(value))
            case _ if prop in _SWITCHES:
                return replace(self, **{_SWITCHES[prop]: bool(value)})
            case _ if prop in _NUMBERS:
                name, (low, high), automatic = _NUMBERS[prop]
                if automatic and getattr(self, automatic):
                    return None
                # V4L2 takes a whole number, and brings it into the range.
                taken: dict[str, Any] = {name: int(min(max(int(value), low), high))}
                return replace(self, **taken)
            case _:
                return None
