"""An object made of parts on the platter."""

from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Protocol

import cv2
import numpy as np

from sim.objects.layers import place
from sim.objects.projection import CENTRE_PX, COS, HEIGHT, PX_PER_MM, SIN, WIDTH, Drawing, Floats, Image, ObjectPose
from sim.table import TABLE


class Part(Protocol):
    """A piece of a solid."""

    @property
    def reach_mm(self) -> float:
        """Radius of its shadow on the platter."""

    def drawings(self, pose: ObjectPose) -> list[Drawing]: ...


@dataclass(frozen=True)
class Solid:
    """A built-in object."""

    name: str
    """Its name in catalogs and reports."""
    parts: tuple[Part, ...] = field(repr=False)
    """Its parts."""
    symmetry_deg: float = 360.0
    """The smallest rotation after which it looks the same: 360 for none, 360 / n for n-fold, 0 for free symmetry."""

    def draw(self, image: Image, azimuth_deg: float, offset_mm: tuple[float, float] = (0.0, 0.0)) -> None:
        """Draw the object into ``image`` as `sim.objects.projection.Visible` describes."""
        pose = ObjectPose(azimuth_deg, *offset_mm)
        clear, foot = self._shadow
        place(image, np.zeros_like(clear), clear, pose.to_image(np.zeros((1, 3)))[0] - foot)
        drawings = [drawing for part in self.parts for drawing in part.drawings(pose)]
        for drawing in sorted(drawings, key=lambda d: d.order):
            drawing.onto(image)

    @cached_property
    def _shadow(self) -> tuple[Image, Floats]:
        """The soft shadow on the platter: (remaining light, its centre in pixels)."""
        reach = max(part.reach_mm for part in self.parts) * PX_PER_MM * 1.08
        half = (int(reach * 1.25) + 6, int(reach * 1.25 * SIN) + 6)
        clear = np.full((2 * half[1] + 1, 2 * half[0] + 1, 3), 255, dtype=np.uint8)
        cv2.ellipse(
            clear, (half[0], half[1]), (int(reach), int(reach * SIN) + 2), 0, 0, 360, (96, 96, 96), -1, cv2.LINE_AA
        )
        sigma = reach * 0.06 + 1
        soft = cv2.GaussianBlur(clear, (0, 0), sigma, sigmaY=sigma * 0.5)
        return np.asarray(soft, dtype=np.uint8), np.array(half, dtype=np.float64)


def empty_platter() -> Image:
    """Return the image without an object: a plain backdrop and the platter, uint8 (480, 640, 3)."""
    return _empty_platter().copy()


@cache
def _empty_platter() -> Image:
    image = np.empty((HEIGHT, WIDTH, 3), dtype=np.uint8)
    image[:] = (44, 40, 38)
    x, y = CENTRE_PX
    radius, rim = TABLE["platter"]["radius"], TABLE["platter"]["thickness"]
    axes = (int(radius * PX_PER_MM), int(radius * PX_PER_MM * SIN))
    thickness = int(rim * PX_PER_MM * COS)
    for down, colour in ((thickness, (58, 56, 54)), (0, (84, 82, 80))):
        for step in range(thickness if down else 1):
            cv2.ellipse(image, (x, y + down - step), axes, 0, 0, 360, colour, -1, cv2.LINE_AA)
    return image
