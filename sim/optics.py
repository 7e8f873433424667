"""A pinhole camera with distortion in front of a table whose axis has any position and direction."""

from dataclasses import dataclass
from functools import lru_cache
from math import cos, radians, sin
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from sim.objects.projection import CENTRE_PX, COS, HEIGHT, PX_PER_MM, SIN, WIDTH, Floats
from sim.table import TABLE
from sim.world import World

FOCAL_PX = 1000.0  # a usual lens: the frame is 35° wide
DISTANCE_MM: float = TABLE["camera"]["distance"]
"""From the lens to the centre of the platter's top; with the focal length 2 px/mm, as in `sim.objects.projection`."""
SUPERSAMPLING = 2  # more: less aliasing of fine strokes; each frame takes four times as long at twice the number


@dataclass(frozen=True)
class Optics:
    """True values for the calibrations of the camera and of the table's axis."""

    focal_px: tuple[float, float] = (FOCAL_PX, FOCAL_PX)
    centre_px: tuple[float, float] = (WIDTH / 2, HEIGHT / 2)
    """tuple of 2: focal lengths and principal point."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """tuple of 5: k1, k2, p1, p2, k3 of OpenCV's model."""
    rotation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, -SIN, -COS, 0.0, COS, -SIN)
    """tuple of 9: rows of the rotation from the room's frame (x right, y away, z up along the table's axis) into the
    camera's."""
    translation_mm: tuple[float, float, float] = (
        (CENTRE_PX[0] - WIDTH / 2) * DISTANCE_MM / FOCAL_PX,
        (CENTRE_PX[1] - HEIGHT / 2) * DISTANCE_MM / FOCAL_PX,
        DISTANCE_MM,
    )
    """tuple of 3: centre of the platter's top in the camera's frame."""
    wobble_deg: float = 0.0
    """Lean of the axis in a direction that rotates twice as fast as the table, as with a bent bearing. (A lean that
    rotates with the table cannot be separated from the board's own position.)"""

    @classmethod
    def of(cls, world: World) -> Self:
        """Return the camera of a world: the seed gives the lens, the noise model the mounting."""
        return cls.drawn(world.rng("optics"), mount=world.noise.camera_mount)

    @classmethod
    def drawn(cls, rng: np.random.Generator, *, wobble_deg: float = 0.0, mount: float = 1.0) -> Self:
        """Return a typical camera: focal length ±5 %, principal point ±10 px, mounted at an angle of some degrees.

        ``mount`` is the error of its mounting. At 0 the camera has its nominal position, and the platter's middle is
        seen where `sim.objects.projection` draws it, at the same size.
        """
        plain = cls()
        fx = FOCAL_PX * (1 + 0.05 * float(rng.standard_normal()))
        fy = fx * (1 + 0.002 * float(rng.standard_normal()))
        cx, cy = plain.centre_px[0] + 10 * rng.standard_normal(), plain.centre_px[1] + 10 * rng.standard_normal()
        k1, k2 = 0.08 * rng.standard_normal(), 0.1 * rng.standard_normal()
        p1, p2 = 0.0005 * rng.standard_normal(2)
        askew = cv2.Rodrigues(mount * np.radians([3.0, 1.0, 1.5]) * rng.standard_normal(3))[0]
        rotation = askew @ np.array(plain.rotation).reshape(3, 3)
        shift = mount * np.array([6.0, 6.0, 20.0]) * rng.standard_normal(3)
        if mount == 0.0:  # a careful operator aims the camera with its image
            distance = DISTANCE_MM * fx / FOCAL_PX
            translation = distance * np.array([(CENTRE_PX[0] - cx) / fx, (CENTRE_PX[1] - cy) / fy, 1.0])
        else:
            translation = askew @ np.array(plain.translation_mm) + shift
            # The platter stays in view for any rotation of the camera.
            translation[:2] = np.array(plain.translation_mm[:2]) + shift[:2]
        return cls(
            (fx, fy),
            (float(cx), float(cy)),
            (float(k1), float(k2), float(p1), float(p2), 0.0),
            tuple(rotation.ravel().tolist()),
            (float(translation[0]), float(translation[1]), float(translation[2])),
            wobble_deg,
        )

    @property
    def matrix(self) -> Floats:
        """The camera matrix (3, 3)."""
        return np.array(
            [[self.focal_px[0], 0.0, self.centre_px[0]], [0.0, self.focal_px[1], self.centre_px[1]], [0.0, 0.0, 1.0]]
        )

    def to_camera(self, table_deg: float) -> tuple[Floats, Floats]:
        """Return rotation (3, 3) and translation (3,) from the platter's frame into the camera's."""
        rotation = np.array(self.rotation).reshape(3, 3)
        if self.wobble_deg:
            lean = radians(self.wobble_deg)
            around = 2 * radians(table_deg)
            rotation = rotation @ cv2.Rodrigues(np.array([lean * cos(around), lean * sin(around), 0.0]))[0]
        return rotation @ _about_vertical(table_deg), np.array(self.translation_mm)

    def from_drawn(self) -> Floats:
        """Return the homography (3, 3) from the drawings of `sim.objects.projection` to this camera's image.

        It is exact for the plane through the axis that faces the camera. It ignores the distortion of the lens, some
        pixels at the edges of the frame.
        """
        rotation = np.array(self.rotation).reshape(3, 3)
        seen = self.matrix @ np.column_stack([rotation[:, 0], rotation[:, 2], np.array(self.translation_mm)])
        drawn = np.array([[PX_PER_MM, 0.0, CENTRE_PX[0]], [0.0, -PX_PER_MM * COS, CENTRE_PX[1]], [0.0, 0.0, 1.0]])
        return np.asarray(seen @ np.linalg.inv(drawn))

    def rays(self) -> NDArray[np.float32]:
        """Return where the ray of each sub-pixel meets the plane one unit in front of the lens, float32 (h, w, 2)."""
        return _rays(self)


def _about_vertical(angle_deg: float) -> Floats:
    c, s = cos(radians(angle_deg)), sin(radians(angle_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@lru_cache(maxsize=2)
def _rays(optics: Optics) -> NDArray[np.float32]:
    x = (np.arange(WIDTH * SUPERSAMPLING) + 0.5) / SUPERSAMPLING - 0.5
    y = (np.arange(HEIGHT * SUPERSAMPLING) + 0.5) / SUPERSAMPLING - 0.5
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(grid, optics.matrix, np.array(optics.distortion))
    return np.asarray(rays.reshape(len(y), len(x), 2), dtype=np.float32)
