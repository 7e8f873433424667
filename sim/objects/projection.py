"""The simulated camera's view of the platter: geometry and light.

Room frame, millimetres: origin at the centre of the platter's top, x to the camera's right, y away from it, z up. The
camera stands at the front (-y), `ELEVATION_DEG` above the horizon. A counter-clockwise rotation seen from above moves
the front of an object to the right of the image. The projection is weak perspective: parallel, at the scale of the
platter's centre, as through a long lens.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, hypot, radians, sin

import numpy as np
from numpy.typing import NDArray

from sim.table import TABLE

Image = NDArray[np.uint8]
Floats = NDArray[np.float64]
Colour = tuple[int, int, int]
"""B, G, R."""
Paint = Callable[[tuple[int, int]], Image]
"""Returns a texture, uint8 (rows, columns, 3), for its (rows, columns)."""

WIDTH, HEIGHT = 640, 480
# A camera on a tripod, which sees the top of the platter as an ellipse; `CENTRE_PX` leaves room for objects of 200 mm.
ELEVATION_DEG: float = TABLE["camera"]["tilt_deg"]
PX_PER_MM = 2.0
CENTRE_PX = (320, 398)  # where the image shows the centre of the platter's top

SIN, COS = sin(radians(ELEVATION_DEG)), cos(radians(ELEVATION_DEG))
TO_CAMERA: Floats = np.array([0.0, -COS, SIN])
TO_LIGHT: Floats = np.array([-0.50, -0.62, 0.605]) / np.linalg.norm([-0.50, -0.62, 0.605])
AMBIENT = 0.42  # ambient part of the light; the rest comes from the lamp at the front left


@dataclass(frozen=True, slots=True)
class ObjectPose:
    """Position of an object: rotated by ``azimuth_deg``, its axis at (``x_mm``, ``y_mm``) in the room."""

    azimuth_deg: float = 0.0
    x_mm: float = 0.0
    y_mm: float = 0.0

    def to_room(self, points_mm: Floats) -> Floats:
        """Return points (n, 3) of the object in the room's frame."""
        rotated = self.rotate(points_mm)
        rotated[:, :2] += self.x_mm, self.y_mm
        return rotated

    def rotate(self, vectors: Floats) -> Floats:
        """Return vectors (n, 3) rotated by the azimuth."""
        c, s = cos(radians(self.azimuth_deg)), sin(radians(self.azimuth_deg))
        return np.asarray(vectors @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]))

    def depth(self, x_mm: float, y_mm: float) -> float:
        """Return the distance of a point of the object to the front of the room; its height does not matter."""
        a = radians(self.azimuth_deg)
        return -(self.y_mm + x_mm * sin(a) + y_mm * cos(a))

    def facing(self, x_mm: float, y_mm: float) -> float:
        """Return how much the side of the object at (x, y) of its frame faces the camera, 0..1."""
        return max((self.depth(x_mm, y_mm) + self.y_mm) / max(hypot(x_mm, y_mm), 1e-9), 0.0)

    def to_image(self, points_mm: Floats) -> Floats:
        """Return pixel coordinates (n, 2) of points (n, 3) of the object; whole numbers are pixel centres."""
        x, y, z = self.to_room(points_mm).T
        return np.column_stack([CENTRE_PX[0] + PX_PER_MM * x, CENTRE_PX[1] - PX_PER_MM * (y * SIN + z * COS)])


def nearness(room_mm: Floats) -> Floats:
    """Return the positions of points (..., 3) along the direction to the camera, in millimetres."""
    return np.asarray(room_mm @ TO_CAMERA)


def shade(normals: Floats) -> Floats:
    """Return the relative light (Lambert and ambient) on surfaces with unit ``normals`` (..., 3) in the room."""
    return AMBIENT + (1 - AMBIENT) * np.maximum(normals @ TO_LIGHT, 0.0)


def gloss(normals: Floats, sharpness: float) -> Floats:
    """Return the highlight (Blinn-Phong) on surfaces with unit ``normals`` (..., 3) in the room, 0..1."""
    half = TO_LIGHT + TO_CAMERA
    half = half / np.linalg.norm(half)
    return np.asarray(np.maximum(normals @ half, 0.0) ** sharpness)
