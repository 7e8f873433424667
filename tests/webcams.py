"""Seven real webcams, by what their USB descriptors say, and such a camera in front of the simulated scene.

Numbers derived from the descriptors in espressif/esp-usb (eb461866, Apache-2.0). The ranges of the controls are not in
descriptors: those here are of other webcams.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import cv2
import pytest

from rig.devices import v4l2
from rig.devices.v4l2 import VideoMode
from sim.camera import SimCapture
from sim.world import World

_CAMERA_BITS: Final = {
    1: cv2.CAP_PROP_AUTO_EXPOSURE,
    2: v4l2.EXPOSURE_DYNAMIC_FRAMERATE,
    3: cv2.CAP_PROP_EXPOSURE,
    5: cv2.CAP_PROP_FOCUS,
    17: cv2.CAP_PROP_AUTOFOCUS,
}
_PROCESSING_BITS: Final = {
    4: cv2.CAP_PROP_SHARPNESS,
    6: cv2.CAP_PROP_WB_TEMPERATURE,
    8: cv2.CAP_PROP_BACKLIGHT,
    9: cv2.CAP_PROP_GAIN,
    10: v4l2.POWER_LINE_FREQUENCY,
    12: cv2.CAP_PROP_AUTO_WB,
}
"""Properties by the bits in the descriptors of a camera and of a processing unit (UVC 1.1, 3.7.2.3 and 3.7.2.5)."""


RECORDINGS: Final = Path(__file__).parents[2] / "shared/data/recordings/webcams"


def recorded(name: str) -> tuple[bytes, bytes]:
    """Return the descriptors of a webcam, device and configuration; skip the test where their files are missing."""
    if not RECORDINGS.is_dir():
        pytest.skip(f"no recordings in {RECORDINGS}")
    device, configuration = ((RECORDINGS / f"{name}.{part}_desc.bin").read_bytes() for part in ("dev", "cfg"))
    return device, configuration


@dataclass(frozen=True, slots=True)
class WebcamModel:
    """A webcam: versions and ids, whether it has strings for its manufacturer (m), product (p) and serial number (s),
    the bits of its camera and processing units, and by its pixel formats all sizes with their highest frame rates.
    """

    usb: int
    vendor: int
    product: int
    strings: str
    camera: int
    processing: int
    formats: dict[str, str] = field(repr=False)

    @property
    def missing(self) -> set[int]:
        """The properties that the camera lacks."""
        rows = ((_CAMERA_BITS, self.camera), (_PROCESSING_BITS, self.processing))
        return {prop for names, bits in rows for bit, prop in names.items() if not bits >> bit & 1}

    @property
    def modes(self) -> list[VideoMode]:
        """All modes, also those with formats that OpenCV does not convert, in the order of the descriptors."""
        found = []
        for fourcc, sizes in self.formats.items():
            for one in sizes.split():
                size, fps = one.split("@")
                width, height = map(int, size.split("x"))
                found.append(VideoMode(fourcc, width, height, float(fps)))
        return found


class ModelledWebcam(SimCapture):
    """A simulated camera with the controls and modes of a webcam. Its gain begins at 1, its steps are coarse."""

    LIMITS: Final = {cv2.CAP_PROP_GAIN: (1, 1), cv2.CAP_PROP_WB_TEMPERATURE: (2800, 100)}

    def __init__(self, world: World, model: WebcamModel) -> None:
        super().__init__(world)
        self.model = model

    def modes(self) -> tuple[VideoMode, ...]:
        known = v4l2.UNCOMPRESSED + v4l2.COMPRESSED
        return tuple(mode for mode in self.model.modes if mode.fourcc in known)

    def limits(self, prop: int) -> tuple[float, float] | None:
        return None if prop in self.model.missing else self.LIMITS.get(prop)

    def get(self, prop: int) -> float:
        return -1.0 if prop in self.model.missing else super().get(prop)

    def set(self, prop: int, value: float) -> bool:
        if prop in self.model.missing:
            return False
        smallest, step = self.LIMITS.get(prop, (value, 1))  # as uvcvideo, which takes the nearest value
        return super().set(prop, max(smallest, smallest + round((value - smallest) / step) * step))


WEBCAMS: Final = {
    "anker_powerconf_c200": WebcamModel(
        0x0200,
        0x291A,
        0x3369,
        "mps",
        0x028A2A,
        0x147F,
        {
            "MJPG": "2560x1440@30 1920x1080@30 1280x720@30 640x480@30 640x360@30 320x240@30",
            "YUYV": "640x480@30 640x360@30 320x240@30",
            "H264": "2560x1440@30 1920x1080@30 1280x720@30 640x480@30 640x360@30 320x240@30",
        },
    ),
    "canyon_cne_cwc2": WebcamModel(
        0x0200,
        0x0C45,
        0x6340,
        "mp",
        0x00200E,
        0x043F,
        {
            "YUYV": "640x480@30 352x288@30 320x240@30 176x144@30 160x120@30 800x600@20 1280x720@10 1280x960@9 "
            "1600x1200@5",
            "MJPG": "640x480@30 352x288@30 320x240@30 176x144@30 160x120@30 800x600@30 1280x720@15 1280x960@15 "
            "1600x1200@15",
        },
    ),
    "elp_h264": WebcamModel(
        0x0200,
        0x32E4,
        0x9422,
        "mps",
        0x00200E,
        0x177F,
        {
            "MJPG": "1920x1080@30 1280x720@30 800x600@30 640x480@30 640x360@30 352x288@30 320x240@30 1920x1080@30",
            "YUYV": "640x480@30 800x600@15 640x360@30 352x288@30 320x240@30 640x480@30",
            "H264": "1920x1080@30 1280x720@30 800x600@30 640x480@30 640x360@30 352x288@30 320x240@30 1920x1080@30",
        },
    ),
    "elp_h265": WebcamModel(
        0x0200,
        0x32E4,
        0x9415,
        "mps",
        0x00220E,
        0x177F,
        {
            "MJPG": "640x360@30 640x480@30 960x540@30 1024x576@30 1280x720@30 1920x1080@30 2560x1440@30 3840x2160@30",
            "H264": "640x360@30 640x480@30 960x540@30 1024x576@30 1280x720@30 1920x1080@30 2560x1440@30 3840x2160@30",
            "HEVC": "640x360@30 640x480@30 960x540@30 1024x576@30 1280x720@30 1920x1080@30 2560x1440@30 3840x2160@30",
            "YUYV": "640x360@30 640x480@30 960x540@15 1024x576@15 1280x720@10 1920x1080@5",
        },
    ),
    "logitech_c270": WebcamModel(
        0x0200,
        0x046D,
        0x0825,
        "s",
        0x00000E,
        0x175B,
        {
            "YUYV": "640x480@30 160x120@30 176x144@30 320x176@30 320x240@30 352x288@30 432x240@30 544x288@30 "
            "640x360@30 752x416@25 800x448@20 800x600@20 864x480@20 960x544@15 960x720@10 1024x576@10 "
            "1184x656@10 1280x720@7.5 1280x960@7.5",
            "MJPG": "640x480@30 160x120@30 176x144@30 320x176@30 320x240@30 352x288@30 432x240@30 544x288@30 "
            "640x360@30 752x416@30 800x448@30 800x600@30 864x480@30 960x544@30 960x720@30 1024x576@30 "
            "1184x656@30 1280x720@30 1280x960@30",
        },
    ),
    "logitech_streamcam": WebcamModel(
        0x0210,
        0x046D,
        0x0893,
        "ps",
        0x022A2E,
        0x175B,
        {
            "YUYV": "640x480@30 176x144@30 320x240@30 424x240@30 640x360@30 848x480@30 960x540@15 1280x720@10 "
            "1600x896@7.5 1920x1080@5",
            "MJPG": "640x480@30 176x144@30 320x240@30 424x240@30 640x360@30 848x480@30 960x540@30 1280x720@30 "
            "1600x896@30 1920x1080@30",
        },
    ),
    "trust_webcam": WebcamModel(
        0x0200,
        0x0C45,
        0x6340,
        "mps",
        0x000004,
        0x073F,
        {
            "YUYV": "640x480@30 352x288@30 320x240@30 176x144@30 1280x1024@5 160x120@30",
        },
    ),
}
"""By the names of their files."""
