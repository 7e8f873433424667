"""A simulated camera in manual mode, and drawn things for it to see."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sim.camera import SimCapture
from sim.noise import NoiseModel
from sim.objects.projection import CENTRE_PX, PX_PER_MM, Image
from sim.world import World

QUIET = NoiseModel.none()


@dataclass(frozen=True)
class Card:
    """A card that fills the frame with a picture at any table angle."""

    picture: Image
    name: str = "card"

    def draw(self, image: Image, azimuth_deg: float, offset_mm: tuple[float, float]) -> None:
        image[:] = self.picture


@dataclass(frozen=True)
class Spot:
    """A bright upright line 80 mm from the axis, smooth enough to be placed between pixels."""

    name: str = "spot"

    def draw(self, image: Image, azimuth_deg: float, offset_mm: tuple[float, float]) -> None:
        image[:] = 0
        x = CENTRE_PX[0] + PX_PER_MM * (80 * np.sin(np.radians(azimuth_deg)) + offset_mm[0])
        image[100:300] = np.round(250 * np.exp(-((np.arange(640) - x) ** 2) / 18)).astype(np.uint8)[None, :, None]


def grey(level: int) -> Card:
    return Card(np.full((480, 640, 3), level, dtype=np.uint8))


def camera(world: World, **values: float) -> SimCapture:
    """Return a camera in manual mode: 10 ms, 0 dB, 5000 K, unless said otherwise."""
    capture = SimCapture(world)
    assert capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1)
    assert capture.set(cv2.CAP_PROP_AUTO_WB, 0)
    for name, value in ({"EXPOSURE": 100, "WB_TEMPERATURE": 5000} | values).items():
        assert capture.set(getattr(cv2, f"CAP_PROP_{name}"), value)
    return capture


def frame(capture: SimCapture) -> NDArray[np.float64]:
    """Return the next frame that is exposed completely under the present conditions."""
    capture._clock.sleep(0.5)
    for _ in range(5):  # the buffers
        assert capture.grab()
    ok, image = capture.retrieve()
    assert ok
    assert image is not None
    return image.astype(np.float64)


def stamp_ns(capture: SimCapture) -> int:
    return round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
