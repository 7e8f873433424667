"""The requested settings of a camera, and those that it did not accept."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Requested settings; None leaves a setting to the camera, except the focus, which is locked after the autofocus.

    Without ``fourcc``, the pixel format is chosen from those of the camera (`rig.devices.v4l2.choose_mode`).
    ``gain``, ``focus``, ``sharpness`` and ``backlight_compensation`` are in the camera's own units, as `v4l2-ctl
    --list-ctrls` shows them; ``power_line_frequency`` is the number in its menu.
    """

    width: int | None = 640
    height: int | None = 480
    fps: float | None = 30.0
    exposure_us: float | None = 10_000.0
    gain: float | None = 0.0
    white_balance_k: float | None = 5000.0
    focus: float | None = None
    sharpness: float | None = None
    backlight_compensation: float | None = None
    power_line_frequency: float | None = None
    dynamic_frame_rate: bool | None = False
    fourcc: str | None = None

    def __post_init__(self) -> None:
        for name in ("width", "height", "fps", "exposure_us", "white_balance_k"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise ValueError(f"{name} = {value!r}: give a positive number, or None to leave it to the camera")


@dataclass(frozen=True, slots=True)
class RejectedSetting:
    """A setting that the camera did not accept: the requested and the reported value."""

    setting: str
    asked: float
    reported: float

    @property
    def asked_text(self) -> str:
        """The requested value as text."""
        return _value_text(self.setting, self.asked)

    @property
    def reported_text(self) -> str:
        """The reported value as text."""
        return _value_text(self.setting, self.reported)


def _value_text(setting: str, value: float) -> str:
    if setting != "fourcc":
        return f"{value:g}"
    letters = max(round(value), 0).to_bytes(8, "little").rstrip(b"\0").decode("ascii", "replace")
    return letters if letters.isprintable() and letters else "unknown"
