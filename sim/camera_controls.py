"""The settings of the simulated camera, in the units of OpenCV's V4L2 backend."""

from dataclasses import dataclass, replace

import cv2

from rig.devices import v4l2
from sim.frame_times import FPS
from sim.sensor import Gains, white_balance

NOMINAL_EXPOSURE = 100  # exposure at which the frame has the scene's grey levels, in V4L2's unit of 100 µs
V4L2_EXPOSURE_MANUAL, V4L2_EXPOSURE_APERTURE_PRIORITY = 1, 3
# The ranges and defaults of a usual UVC webcam. The longest exposure is the time between two frames.
EXPOSURE_RANGE = (1, 10_000 // FPS)
_GAIN_RANGE_DB = (0, 24)
KELVIN_RANGE = (2800, 6500)
_FOCUS_RANGE = (0, 255)
SHARP_AT = 120
_SHARPNESS_RANGE = (0, 255)
BUFFERS_RANGE = (1, 10)


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
        return {
            cv2.CAP_PROP_BUFFERSIZE: self.buffers,
            cv2.CAP_PROP_AUTO_EXPOSURE: V4L2_EXPOSURE_APERTURE_PRIORITY if self.auto_exposure else V4L2_EXPOSURE_MANUAL,
            cv2.CAP_PROP_EXPOSURE: round(self.exposure),
            cv2.CAP_PROP_GAIN: self.gain_db,
            cv2.CAP_PROP_AUTO_WB: self.auto_white_balance,
            cv2.CAP_PROP_WB_TEMPERATURE: round(self.kelvin),
            cv2.CAP_PROP_AUTOFOCUS: self.autofocus,
            cv2.CAP_PROP_FOCUS: self.focus,
            cv2.CAP_PROP_SHARPNESS: self.sharpness,
            cv2.CAP_PROP_BACKLIGHT: self.backlight_compensation,
            v4l2.POWER_LINE_FREQUENCY: self.power_line_frequency,
            v4l2.EXPOSURE_DYNAMIC_FRAMERATE: self.dynamic_frame_rate,
        }

    def with_value(self, prop: int, value: float) -> "Controls | None":
        """Return the settings after OpenCV has set a property; None if the camera does not accept it now."""
        match prop:
            case cv2.CAP_PROP_AUTO_EXPOSURE if value in (V4L2_EXPOSURE_MANUAL, V4L2_EXPOSURE_APERTURE_PRIORITY):
                auto = value == V4L2_EXPOSURE_APERTURE_PRIORITY
                return replace(self, auto_exposure=auto, exposure=round(self.exposure))
            case cv2.CAP_PROP_EXPOSURE if not self.auto_exposure:
                return replace(self, exposure=_within(value, EXPOSURE_RANGE))
            case cv2.CAP_PROP_GAIN:
                return replace(self, gain_db=_within(value, _GAIN_RANGE_DB))
            case cv2.CAP_PROP_AUTO_WB:
                return replace(self, auto_white_balance=bool(value), kelvin=round(self.kelvin))
            case cv2.CAP_PROP_WB_TEMPERATURE if not self.auto_white_balance:
                return replace(self, kelvin=_within(value, KELVIN_RANGE))
            case cv2.CAP_PROP_AUTOFOCUS:
                return replace(self, autofocus=bool(value))
            case cv2.CAP_PROP_FOCUS if not self.autofocus:
                return replace(self, focus=_within(value, _FOCUS_RANGE))
            case cv2.CAP_PROP_SHARPNESS:
                return replace(self, sharpness=_within(value, _SHARPNESS_RANGE))
            case cv2.CAP_PROP_BACKLIGHT:
                return replace(self, backlight_compensation=_within(value, (0, 1)))
            case v4l2.POWER_LINE_FREQUENCY if 0 <= value <= 2:
                return replace(self, power_line_frequency=int(value))
            case v4l2.EXPOSURE_DYNAMIC_FRAMERATE:
                return replace(self, dynamic_frame_rate=bool(value))
            case _:
                return None


def _within(value: float, limits: tuple[int, int]) -> int:
    """Return ``value`` as V4L2 takes it: a whole number, brought into the range."""
    return int(min(max(int(value), limits[0]), limits[1]))
