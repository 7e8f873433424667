"""Convex solids with flat faces: boxes, prisms, level cylinders. Each face is an affine warp of its texture."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from math import cos, pi, radians, sin, sqrt
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from sim.objects.projection import Colour, Floats, Image, ObjectPose, Paint, nearness, shade
from sim.objects.solid import Drawing

TEXELS_PER_MM = 2.0  # as `PX_PER_MM`: finer textures would only be blurred
_EDGE_ON = 0.004  # a face at a smaller angle is less than half a pixel wide
_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates


@dataclass(frozen=True)
class Face:
    """A face: its corners (k, 3) in millimetres, counter-clockwise seen from outside, and its texture or colour.

    A painted face's texture spans a parallelogram: ``frame``, (3, 3), is its upper left, upper right and lower left
    corner.
    """

    corners: Floats
    paint: Paint | Colour
    frame: Floats

    @cached_property
    def printed(self) -> Image | Colour:
        """The face's texture, or its colour."""
        if isinstance(self.paint, tuple):
            return self.paint
        origin, right, down = self.frame
        rows = round(float(np.linalg.norm(down - origin)) * TEXELS_PER_MM)
        columns = round(float(np.linalg.norm(right - origin)) * TEXELS_PER_MM)
        return self.paint((rows, columns))


def face(corners: ArrayLike, paint: Paint | Colour) -> Face:
    """Return a face by its corners: of a printed one the upper left, lower left, lower right and upper right corner."""
    c = np.array(corners, dtype=np.float64)
    return Face(c, paint, c[[0, -1, 1]])


@dataclass(frozen=True)
class Polyhedron:
    """A convex solid made of faces; ``layer`` as in `sim.objects.revolution.Revolution`.

    It is rotated about its own axis by ``rotation_deg`` and stands at ``at`` in the object's frame. Of two parts in a
    layer, the one whose ``depth_at`` (x, y in the object's frame; default: the middle) is nearer to the camera covers
    the other. That is exact if the line between these points crosses a plane between the parts at a right angle.
    """

    faces: tuple[Face, ...]
    layer: int = 0
    depth_at: tuple[float, float] | None = None
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_deg: float = 0.0

    @property
    def reach_mm(self) -> float:
        """Return the radius of a circle as large as its outline seen from above."""
        outline = cv2.convexHull(self._geometry[0][:, :2].astype(np.float32))
        return sqrt(cv2.contourArea(outline) / pi)

    def drawings(self, pose: ObjectPose) -> list[Drawing]:
        x, y = self.depth_at or self._geometry[0].mean(axis=0)[:2].tolist()
        return [(self.layer, pose.depth(x, y), partial(self._draw, pose))]

    @cached_property
    def _geometry(self) -> tuple[Floats, list[slice], Floats, Floats]:
        """All corners (n, 3), the slice of each face, the frames' points (3 m, 3), the normals (m, 3)."""
        own, at = ObjectPose(self.rotation_deg), np.array(self.at)
        corners = own.rotate(np.concatenate([face.corners for face in self.faces])) + at
        frames = own.rotate(np.concatenate([face.frame for face in self.faces])) + at
        ends = np.cumsum([len(face.corners) for face in self.faces]).tolist()
        slices = [slice(start, end) for start, end in pairwise([0, *ends])]
        across = [np.cross(b - a, c - a) for a, b, c in (corners[one][:3] for one in slices)]
        return corners, slices, frames, np.array([each / np.linalg.norm(each) for each in across])

    def _draw(self, pose: ObjectPose, image: Image) -> None:
        corners_mm, slices, frames_mm, normals = self._geometry
        corners, normals = pose.to_image(corners_mm), pose.rotate(normals)
        left, top = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 2, 0).tolist()
        size = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 3, image.shape[1::-1]) - (left, top)
        if (size <= 0).any():
            return
        corners -= left, top
        frames = pose.to_image(frames_mm).reshape(-1, 3, 2) - (left, top)
        solid = np.empty((size[1], size[0], 3), dtype=np.uint8)
        facing = nearness(normals)
        lights = shade(normals).tolist()
        # The best visible face is drawn over the whole outline first, so smoothed edges show only the solid.
        for n, i in enumerate(i for i in np.argsort(-facing).tolist() if facing[i] > _EDGE_ON):
            face, polygon = self.faces[i], None if n == 0 else corners[slices[i]]
            if isinstance(face.printed, tuple):
                _paint_flat(solid, face.printed, polygon, lights[i])
            else:
                _paint_printed(solid, face.printed, frames[i], polygon, lights[i])
        cover = np.zeros((size[1], size[0]), dtype=np.uint8)
        hull = cv2.convexHull(corners.astype(np.float32)).reshape(-1, 2)
        _fill(cover, hull.astype(np.float64), (255,))
        _blend(image[top : top + size[1], left : left + size[0]], solid, cover)


def _paint_flat(solid: Image, colour: Colour, polygon: Floats | None, light: float) -> None:
    b, g, r = (c * light for c in colour)
    if polygon is None:
        solid[:] = np.round((b, g, r)).astype(np.uint8)
    else:
        _fill(solid, polygon, (b, g, r))


def _paint_printed(solid: Image, texture: Image, frame: Floats, polygon: Floats | None, light: float) -> None:
    x0, y0, x1, y1 = 0, 0, solid.shape[1], solid.shape[0]
    if polygon is not None:
        x0, y0 = np.maximum(np.floor(polygon.min(axis=0)).astype(int) - 1, 0).tolist()
        x1, y1 = np.minimum(np.ceil(polygon.max(axis=0)).astype(int) + 2, (x1, y1)).tolist()
    rows, columns = texture.shape[:2]
    on_texture = np.array([[-0.5, -0.5], [columns - 0.5, -0.5], [-0.5, rows - 0.5]], dtype=np.float32)
    move = cv2.getAffineTransform(on_texture, (frame - (x0, y0)).astype(np.float32))
    seen = cv2.warpAffine(texture, move, (x1 - x0, y1 - y0), borderMode=cv2.BORDER_REPLICATE)
    shaded = np.asarray(cv2.convertScaleAbs(seen, alpha=light), dtype=np.uint8)
    if polygon is None:
        solid[:] = shaded
    else:
        cover = np.zeros(shaded.shape[:2], dtype=np.uint8)
        _fill(cover, polygon - (x0, y0), (255,))
        _blend(solid[y0:y1, x0:x1], shaded, cover)


def _fill(image: Image, polygon: Floats, colour: Sequence[float]) -> None:
    cv2.fillConvexPoly(image, np.round(polygon * (1 << _SHIFT)).astype(np.int32), colour, cv2.LINE_AA, _SHIFT)


def _blend(below: Image, above: Image, cover: Image) -> None:
    """Draw ``above`` over ``below`` (in place), both uint8 (h, w, 3), weighted by ``cover`` (h, w), 255 for opaque."""
    weight = cv2.cvtColor(cover, cv2.COLOR_GRAY2BGR)
    laid = cv2.multiply(above, weight, scale=1 / 255)
    cv2.bitwise_not(weight, dst=weight)
    cv2.multiply(below, weight, dst=below, scale=1 / 255)
    cv2.add(below, laid, dst=below)


# -- solids -----------------------------------------------------------------------------------------------------------


def box(
    size_mm: tuple[float, float, float], walls: Sequence[Paint | Colour], *, top: Paint | Colour, **placing: Any
) -> Polyhedron:
    """Return a box (width, depth, height) without a bottom; the ``walls`` are front, right, back and left."""
    w, d, h = size_mm[0] / 2, size_mm[1] / 2, size_mm[2]
    ring = [(-w, -d), (w, -d), (w, d), (-w, d), (-w, -d)]
    lid = face([(-w, d, h), (-w, -d, h), (w, -d, h), (w, d, h)], top)
    return Polyhedron((*_upright(ring, h, walls), lid), **placing)


def prism(
    sides: int, radius_mm: float, height_mm: float, *, wall: Paint | Colour, top: Colour, **placing: Any
) -> Polyhedron:
    """Return an upright prism over a regular polygon with a face to the front; all walls have the same print."""
    angles = [radians(-90) + (2 * i - 1) * pi / sides for i in range(sides + 1)]
    ring = [(radius_mm * cos(a), radius_mm * sin(a)) for a in angles]
    lid = face([(*p, height_mm) for p in ring[:-1]], top)
    return Polyhedron((*_upright(ring, height_mm, [wall] * sides), lid), **placing)


def _upright(ring: Sequence[tuple[float, float]], h: float, walls: Sequence[Paint | Colour]) -> list[Face]:
    """Return the walls over a closed outline (x, y), counter-clockwise, whose last point is its first."""
    pieces = zip(pairwise(ring), walls, strict=True)
    return [face([(*a, h), (*a, 0), (*b, 0), (*b, h)], paint) for (a, b), paint in pieces]


def lying_cylinder(
    radius_mm: float, length_mm: float, *, wall: Colour, end: Paint | Colour, **placing: Any
) -> Polyhedron:
    """Return a horizontal cylinder with its printed end to the front and its back end at the object's place."""
    sides, r, y = 36, radius_mm, -length_mm
    ring = [(r * cos(2 * pi * i / sides), r * sin(2 * pi * i / sides)) for i in range(sides + 1)]
    walls = [
        face([(a[0], 0, a[1]), (b[0], 0, b[1]), (b[0], y, b[1]), (a[0], y, a[1])], wall) for a, b in pairwise(ring)
    ]
    lid = Face(np.array([(x, y, z) for x, z in ring[:-1]]), end, np.array([(-r, y, r), (r, y, r), (-r, y, -r)]))
    back = face([(x, 0.0, z) for x, z in ring[-2::-1]], wall)
    return Polyhedron((*walls, lid, back), **placing)
