"""Pictures of solids: parallel projection, shaded, with dark edges."""

from collections.abc import Sequence
from math import cos, radians, sin

import cv2
import numpy as np
from numpy.typing import NDArray

from docs.hardware.assembly import Item
from docs.hardware.mesh import normals, triangles

FINE = 2  # supersampling
INK = (50, 44, 40)


class Picture:
    """A view of items from ``azimuth_deg`` (0: from the camera, 90: from its right) and ``elevation_deg``."""

    def __init__(
        self,
        items: Sequence[tuple[Item, object]],
        size: tuple[int, int],
        azimuth_deg: float,
        elevation_deg: float,
        margin: int = 60,
    ) -> None:
        a, e = radians(azimuth_deg), radians(elevation_deg)
        right = np.array([cos(a), sin(a), 0.0])
        away = np.array([-sin(a) * cos(e), cos(a) * cos(e), -sin(e)])
        self._axes = np.array([right, np.cross(right, away), away])
        self.size = size
        meshes = [triangles(solid, 0.15, 0.25) for _, solid in items]  # type: ignore[arg-type]
        seen = [corners @ self._axes.T for corners, _ in meshes]
        low, high = np.vstack(seen).min(0), np.vstack(seen).max(0)
        self._scale = (
            min((size[0] - 2 * margin) / (high[0] - low[0]), (size[1] - 2 * margin) / (high[1] - low[1])) * FINE
        )
        self._middle = (low + high) / 2
        self._draw(items, meshes, seen)

    def at(self, point: Sequence[float]) -> tuple[int, int]:
        """Return the pixel of a point of the assembly, in the finished picture."""
        x, y, _ = self._pixels((np.array(tuple(point)) @ self._axes.T)[None])[0]
        return round(x / FINE), round(y / FINE)

    def _pixels(self, seen: NDArray[np.float64]) -> NDArray[np.float64]:
        flat = (seen - self._middle) * self._scale
        return np.column_stack([flat[:, 0] + self.size[0] * FINE / 2, self.size[1] * FINE / 2 - flat[:, 1], flat[:, 2]])

    def _draw(self, items, meshes, seen) -> None:  # type: ignore[no-untyped-def]
        width, height = self.size[0] * FINE, self.size[1] * FINE
        depth = np.full((height, width), np.inf)
        which = np.full((height, width), -1, dtype=np.int32)
        facing = np.zeros((height, width, 3), dtype=np.float32)
        for number, ((corners, faces), aligned) in enumerate(zip(meshes, seen, strict=True)):
            pixels = self._pixels(aligned)
            across = normals(corners, faces)[0] @ self._axes.T
            for face, normal in zip(faces[across[:, 2] < -1e-3], across[across[:, 2] < -1e-3], strict=True):
                p = pixels[face]
                x0, y0 = np.maximum(np.floor(p[:, :2].min(0)).astype(int), 0)
                x1, y1 = np.minimum(np.ceil(p[:, :2].max(0)).astype(int) + 1, (width, height))
                if x0 >= x1 or y0 >= y1:
                    continue
                px, py = np.arange(x0, x1)[None, :], np.arange(y0, y1)[:, None]
                (ax, ay, az), (bx, by, bz), (cx, cy, cz) = p
                area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
                if abs(area) < 1e-9:
                    continue
                u = ((px - ax) * (cy - ay) - (py - ay) * (cx - ax)) / area
                v = ((bx - ax) * (py - ay) - (by - ay) * (px - ax)) / area
                z = az + u * (bz - az) + v * (cz - az)
                here = depth[y0:y1, x0:x1]
                inside = (u >= -1e-6) & (v >= -1e-6) & (u + v <= 1 + 1e-6) & (z < here)
                here[inside] = z[inside]
                which[y0:y1, x0:x1][inside] = number
                facing[y0:y1, x0:x1][inside] = normal
        light = np.clip(facing @ np.array([-0.45, 0.65, -0.61], dtype=np.float32), 0, 1) * 0.5 + 0.5
        colours = np.array([_bgr(item.colour) for item, _ in items] + [(255, 255, 255)], dtype=np.float32)
        image = colours[which] * np.where(which < 0, 1.0, light)[..., None]
        edge = np.zeros(which.shape, dtype=bool)
        for axis in (0, 1):
            back = [np.roll(each, 1, axis) for each in (which, facing, depth)]
            with np.errstate(invalid="ignore"):
                step = np.abs(back[2] - depth) > max(2.0 * self._scale, 8.0)  # more than an inclined face has
            edge |= (back[0] != which) | ((back[1] * facing).sum(2) < 0.82) & (which >= 0) | step & (which >= 0)
        image[edge] = INK
        self.image = cv2.resize(image.astype(np.uint8), self.size, interpolation=cv2.INTER_AREA)

    def label(self, text: str, point: Sequence[float], at: tuple[int, int]) -> None:
        """Write ``text`` at a pixel, with a line to a point of the assembly."""
        x, y = self.at(point)
        (wide, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
        start = (at[0] - 6, at[1] - 5) if at[0] > x else (at[0] + wide + 6, at[1] - 5)
        cv2.line(self.image, start, (x, y), (110, 110, 110), 1, cv2.LINE_AA)
        cv2.circle(self.image, (x, y), 3, (110, 110, 110), -1, cv2.LINE_AA)
        cv2.putText(self.image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.55, (30, 30, 30), 1, cv2.LINE_AA)

    def write(self, path: str) -> None:
        """Write a PNG with few colours, which is small."""
        levels = (np.rint(self.image / 8.5) * 8.5).astype(np.uint8)
        cv2.imwrite(path, levels, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def _bgr(colour: str) -> tuple[int, int, int]:
    return int(colour[5:7], 16), int(colour[3:5], 16), int(colour[1:3], 16)
