"""Handles and spouts: a sphere swept along a curve, which parallel projection shows as a thick line."""

from dataclasses import dataclass
from functools import cached_property, partial
from math import cos, pi, radians, sin

import cv2
import numpy as np
from numpy.typing import NDArray

from sim.objects.curves import Curve, evenly
from sim.objects.projection import COS, PX_PER_MM, SIN, TO_LIGHT, Colour, Drawing, Floats, Image, Pose, nearness

_SHIFT = 4
_STEP_MM = 4.0
_RINGS = ((1.0, 0.60), (0.84, 0.76), (0.66, 0.88), (0.46, 0.97), (0.24, 1.05))
"""(radius, brightness) of the discs that shade a sphere, from its edge to the side of the light."""
_LEAN = np.array([TO_LIGHT[0], -(TO_LIGHT[1] * SIN + TO_LIGHT[2] * COS)])  # where the image shows the light to be


@dataclass(frozen=True)
class Tube:
    """A tube along a curve.

    Parameters
    ----------
    path
        (x, y, z, radius) in millimetres in the thing's frame; the curve runs straight between the points.
    colour
        B, G, R.
    layer
        As in `sim.objects.revolution.Revolution`.
    """

    path: Curve
    colour: Colour
    layer: int = 0

    reach_mm = 0.0

    def drawings(self, pose: Pose) -> list[Drawing]:
        """Return what lies behind the thing's axis and what lies before it: a handle passes its body on both sides."""
        points = self._points
        centres = pose.to_room(points[:, :3])
        pixels = pose.to_image(points[:, :3])
        middles = (centres[1:, 1] + centres[:-1, 1]) / 2
        before = middles < pose.y_mm
        return [
            Drawing((self.layer, -float(middles[part].mean())), partial(self._draw, part, centres, pixels))
            for part in (np.flatnonzero(~before), np.flatnonzero(before))
            if len(part)
        ]

    @cached_property
    def _points(self) -> Floats:
        return evenly(self.path, _STEP_MM, dimensions=3)

    def _draw(self, part: NDArray[np.intp], centres: Floats, pixels: Floats, image: Image) -> None:
        order = part[np.argsort(nearness(centres[part] + centres[part + 1]))]
        radius = (self._points[order, 3] + self._points[order + 1, 3]) / 2 * PX_PER_MM
        for size, brightness in _RINGS:
            b, g, r = (min(c * brightness, 255.0) for c in self.colour)
            lean = _LEAN * ((1 - size) * 0.55) * radius[:, None]
            starts = np.round((pixels[order] + lean) * (1 << _SHIFT)).astype(int).tolist()
            ends = np.round((pixels[order + 1] + lean) * (1 << _SHIFT)).astype(int).tolist()
            widths = np.maximum(np.round(2 * radius * size), 1).astype(int).tolist()
            for start, end, width in zip(starts, ends, widths, strict=True):
                cv2.line(image, start, end, (b, g, r), width, cv2.LINE_AA, _SHIFT)


def handle(radius: float, top: float, bottom: float, reach: float, thickness: float, azimuth_deg: float) -> Curve:
    """Return the D of a mug's handle: from its body's ``radius``, ``reach`` further out, between two heights, in mm.

    It stands at ``azimuth_deg``, counter-clockwise from the front.
    """
    middle, half = (top + bottom) / 2, (top - bottom) / 2
    turns = [pi * (i / 14 - 0.5) for i in range(15)]
    arc = [(radius + reach * max(cos(t), 0.0) ** 0.6, middle + half * sin(t), thickness) for t in turns]
    return ray(azimuth_deg, *arc)


def ray(azimuth_deg: float, *points: tuple[float, float, float]) -> Curve:
    """Return a path in the upright plane at an azimuth from the front, given as (distance from the axis, z, radius)."""
    a = radians(azimuth_deg - 90)
    return tuple((r * cos(a), r * sin(a), z, thickness) for r, z, thickness in points)
