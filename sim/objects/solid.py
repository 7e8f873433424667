"""An object made of parts on the platter, and what draws its parts."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Protocol

import cv2
import numpy as np

from sim.objects.projection import CENTRE_PX, COS, HEIGHT, PX_PER_MM, SIN, WIDTH, Floats, Image, ObjectPose
from sim.table import TABLE

Curve = tuple[tuple[float, ...], ...]
"""Points, each a tuple of numbers, such as (radius, height) or (x, y, z, thickness)."""
Drawing = tuple[int, float, Callable[[Image], None]]
"""A step of drawing: layer, nearness to the camera, and the function that draws. The lowest are drawn first."""


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
        """Draw the object into ``image`` as `sim.world.SimObject` describes."""
        pose = ObjectPose(azimuth_deg, *offset_mm)
        clear, foot = self._shadow
        place(image, np.zeros_like(clear), clear, pose.to_image(np.zeros((1, 3)))[0] - foot)
        drawings = [drawing for part in self.parts for drawing in part.drawings(pose)]
        for _, _, draw_onto in sorted(drawings, key=lambda drawing: drawing[:2]):
            draw_onto(image)

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


def evenly(curve: Curve, step: float, *, dimensions: int) -> Floats:
    """Return ``curve`` resampled at steps of about ``step``, (n, d); the first ``dimensions`` numbers are positions."""
    points = np.array(curve, dtype=np.float64)
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points[:, :dimensions], axis=0), axis=1))])
    even = np.linspace(0.0, s[-1], max(int(np.ceil(s[-1] / step)), 1) + 1)
    return np.column_stack([np.interp(even, s, column) for column in points.T])


def place(image: Image, seen: Image, clear: Image, corner_px: Floats) -> None:
    """Draw ``seen``, already weighted by its cover, on ``image``, at a position that may be between pixels.

    They are uint8 (H, W, 3) and (h, w, 3); ``clear``, (h, w, 3), is the weight of the image below, 255 outside
    ``seen``. ``corner_px`` is the position (x, y) of the upper left pixel's centre in the image.
    """
    x, y = (int(c) for c in np.floor(corner_px))
    right, down = float(corner_px[0] - x), float(corner_px[1] - y)
    if right or down:
        seen, clear = _shifted(seen, right, down, 0), _shifted(clear, right, down, 255)
    left, top = max(x, 0), max(y, 0)
    end, bottom = min(x + seen.shape[1], image.shape[1]), min(y + seen.shape[0], image.shape[0])
    if left >= end or top >= bottom:
        return
    part = np.s_[top - y : bottom - y, left - x : end - x]
    below = image[top:bottom, left:end]
    cv2.multiply(below, clear[part], dst=below, scale=1 / 255)
    cv2.add(below, seen[part], dst=below)


def _shifted(plane: Image, right: float, down: float, beyond: int) -> Image:
    """Return ``plane`` moved by less than a pixel, bilinear, one pixel larger; new pixels are ``beyond``."""
    wide = cv2.copyMakeBorder(plane, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(beyond, beyond, beyond))
    across = cv2.addWeighted(wide[:, 1:], 1 - right, wide[:, :-1], right, 0)
    return np.asarray(cv2.addWeighted(across[1:], 1 - down, across[:-1], down, 0), dtype=np.uint8)
