"""Handles and spouts: a sphere that is moved along a curve, which parallel projection shows as a thick line."""

from dataclasses import dataclass
from functools import cached_property, partial
from math import cos, pi, radians, sin

import cv2
import numpy as np
from numpy.typing import NDArray

from sim.objects.projection import COS, PX_PER_MM, SIN, TO_LIGHT, Colour, Floats, Image, ObjectPose, nearness
from sim.objects.solid import Curve, Drawing, evenly

_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates
_STEP_MM = 4.0  # eight pixels: shorter pieces are not seen on a bent wire
_FAR_MM, _EDGE_ON_MM = 1e6, 1e-6
_RINGS = ((1.0, 0.60), (0.84, 0.76), (0.66, 0.88), (0.46, 0.97), (0.24, 1.05))
"""(radius, brightness) of the discs that shade a sphere, from its edge to the side of the light."""
_LEAN = np.array([TO_LIGHT[0], -(TO_LIGHT[1] * SIN + TO_LIGHT[2] * COS)])  # direction of the light in the image


@dataclass(frozen=True)
class Tube:
    """A tube along a curve.

    If its ends are joined to the side of a body, the visible part depends on the azimuth. So the tube is drawn twice:
    first behind the body, which then covers the parts that are inside or behind it; then the part on the camera's side
    of the axis, in front of the body. There each round end is cut by the part that would be inside the body: nothing if
    the joint faces the camera, all of it if the joint is at the side.
    """

    path: Curve
    """(x, y, z, radius) in millimetres in the object's frame; the curve runs straight between the points."""
    colour: Colour
    """B, G, R."""
    joints: int = 2
    """Number of ends that are joined to the side of a body in the same layer: 2 (handle), 1 (spout: the first), or
    0."""
    layer: int = 0
    """As in `sim.objects.revolution.Revolution`."""

    reach_mm = 0.0

    def drawings(self, pose: ObjectPose) -> list[Drawing]:
        points, length = self._points
        segments = np.arange(len(points) - 1)
        if self.joints == 0:
            x, y = points[:, :2].mean(axis=0).tolist()
            return [(self.layer, pose.depth(x, y), partial(self._draw, pose, points, segments))]
        cuts = [radius * (1 - pose.facing(x, y)) for x, y, _, radius in points[[0, -1]].tolist()]
        even = np.linspace(cuts[0], length[-1] - (cuts[1] if self.joints == 2 else 0.0), len(points))
        trimmed = np.column_stack([np.interp(even, length, column) for column in points.T])
        depth = -pose.rotate(trimmed[:, :3])[:, 1]
        depth = (depth[1:] + depth[:-1]) / 2
        before = depth > _EDGE_ON_MM
        joint = (length[:-1] < 2 * points[0, 3]) | (length[1:] > length[-1] - 2 * points[-1, 3])
        drawings: list[Drawing] = [(self.layer, -_FAR_MM, partial(self._draw, pose, points, segments[~before | joint]))]
        if before.any():
            nearer = float(depth[before].mean()) + pose.depth(0.0, 0.0)
            drawings.append((self.layer, nearer, partial(self._draw, pose, trimmed, segments[before])))
        return drawings

    @cached_property
    def _points(self) -> tuple[Floats, Floats]:
        """The path at even steps (n, 4), and its length up to each point (n,)."""
        points = evenly(self.path, _STEP_MM, dimensions=3)
        steps = np.linalg.norm(np.diff(points[:, :3], axis=0), axis=1)
        return points, np.concatenate([[0.0], np.cumsum(steps)])

    def _draw(self, pose: ObjectPose, points: Floats, segments: NDArray[np.intp], image: Image) -> None:
        near = nearness(pose.to_room(points[:, :3]))
        order = segments[np.argsort(near[segments] + near[segments + 1])]
        pixels = pose.to_image(points[:, :3])
        radius = (points[order, 3] + points[order + 1, 3]) / 2 * PX_PER_MM
        for size, brightness in _RINGS:
            b, g, r = (min(c * brightness, 255.0) for c in self.colour)
            lean = _LEAN * ((1 - size) * 0.55) * radius[:, None]
            starts = np.round((pixels[order] + lean) * (1 << _SHIFT)).astype(int).tolist()
            ends = np.round((pixels[order + 1] + lean) * (1 << _SHIFT)).astype(int).tolist()
            widths = np.maximum(np.round(2 * radius * size), 1).astype(int).tolist()
            for start, end, width in zip(starts, ends, widths, strict=True):
                cv2.line(image, start, end, (b, g, r), width, cv2.LINE_AA, _SHIFT)


def handle(radius: float, top: float, bottom: float, reach: float, thickness: float, azimuth_deg: float) -> Curve:
    """Return the D of a mug's handle, in mm: from the body's ``radius`` outwards by ``reach``, between two heights.

    ``azimuth_deg`` is its position, counter-clockwise from the front.
    """
    middle, half = (top + bottom) / 2, (top - bottom) / 2
    angles = [pi * (i / 14 - 0.5) for i in range(15)]
    arc = [(radius + reach * max(cos(a), 0.0) ** 0.6, middle + half * sin(a), thickness) for a in angles]
    return ray(azimuth_deg, *arc)


def ray(azimuth_deg: float, *points: tuple[float, float, float]) -> Curve:
    """Return a path in the upright plane at an azimuth from the front, given as (distance from the axis, z, radius)."""
    a = radians(azimuth_deg - 90)
    return tuple((r * cos(a), r * sin(a), z, thickness) for r, z, thickness in points)
