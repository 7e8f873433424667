"""Handles, spouts, knobs: a sphere swept along a curve, which is exact in parallel projection as a chain of discs."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import cos, pi, radians, sin

import cv2
import numpy as np

from sim.objects.curves import Curve, evenly
from sim.objects.projection import PX_PER_MM, TO_CAMERA, TO_LIGHT, Drawing, Floats, Image, Pose, nearness

_SHIFT = 4
_STEP_MM = 1.2
_RINGS = ((1.0, 0.62), (0.78, 0.84), (0.5, 1.0))
"""(radius, brightness) of the discs that shade a sphere, from its edge to the side of the light."""


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
    colour: tuple[int, int, int]
    layer: int = 0

    reach_mm = 0.0

    def drawings(self, pose: Pose) -> list[Drawing]:
        """Return what lies behind the thing's axis and what lies before it: a handle passes its body on both sides."""
        centres = pose.to_room(self._spheres[:, :3].copy())
        before = centres[:, 1] < pose.y_mm
        return [
            Drawing((self.layer, -float(centres[part, 1].mean())), self._drawing(pose, centres, part))
            for part in (np.flatnonzero(~before), np.flatnonzero(before))
            if len(part)
        ]

    @cached_property
    def _spheres(self) -> Floats:
        return evenly(self.path, _STEP_MM, dimensions=3)

    def _drawing(
        self, pose: Pose, centres: Floats, part: np.ndarray[tuple[int, ...], np.dtype[np.intp]]
    ) -> Callable[[Image], None]:
        order = part[np.argsort(nearness(centres[part]))]
        middle = pose.to_image(centres[order])
        radius = self._spheres[order, 3] * pose.scale
        # The lit side of every sphere: the light's direction as the image shows it.
        lean = (
            Pose().to_image(TO_LIGHT[None] - TO_CAMERA * (TO_LIGHT @ TO_CAMERA)) - Pose().to_image(np.zeros((1, 3)))
        )[0]
        lean /= PX_PER_MM

        def draw(image: Image) -> None:
            for size, brightness in _RINGS:
                b, g, r = (c * brightness for c in self.colour)
                fixed = (
                    np.round((middle + lean * ((1 - size) * 0.6) * radius[:, None]) * (1 << _SHIFT))
                    .astype(int)
                    .tolist()
                )
                sizes = np.round(radius * size * (1 << _SHIFT)).astype(int).tolist()
                for (x, y), disc in zip(fixed, sizes, strict=True):
                    cv2.circle(image, (x, y), disc, (b, g, r), cv2.FILLED, cv2.LINE_AA, _SHIFT)

        return draw


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
