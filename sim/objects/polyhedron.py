"""Convex solids with flat faces: boxes, prisms, roofs, level cylinders. Each face is an affine warp of its texture."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from math import cos, pi, radians, sin, sqrt

import cv2
import numpy as np

from sim.objects.layers import blend
from sim.objects.projection import Colour, Drawing, Floats, Image, ObjectPose, Paint, nearness, shade

TEXELS_PER_MM = 2.0  # as `PX_PER_MM`: finer textures would only be blurred
_EDGE_ON = 0.004  # a face at a smaller angle is less than half a pixel wide
_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates


@dataclass(frozen=True)
class Face:
    """A face: its corners (k, 3) in millimetres, counter-clockwise seen from outside, and its texture or colour.

    A painted face's texture spans the parallelogram of the upper left, upper right and lower left corner in ``frame``.
    """

    corners: Floats
    paint: Paint | Colour
    frame: tuple[Floats, Floats, Floats]

    @cached_property
    def printed(self) -> Image | Colour:
        """The face's texture, or its colour."""
        if isinstance(self.paint, tuple):
            return self.paint
        origin, right, down = self.frame
        rows = round(float(np.linalg.norm(down - origin)) * TEXELS_PER_MM)
        columns = round(float(np.linalg.norm(right - origin)) * TEXELS_PER_MM)
        return self.paint((rows, columns))

    @cached_property
    def normal(self) -> Floats:
        a, b, c = self.corners[:3]
        across = np.cross(b - a, c - a)
        return np.asarray(across / np.linalg.norm(across))


def quad(corners: Sequence[Sequence[float]] | Floats, paint: Paint | Colour) -> Face:
    """Return a parallelogram from its upper left, lower left, lower right and upper right corner, seen from outside."""
    c = np.array(corners, dtype=np.float64)
    return Face(c, paint, (c[0], c[3], c[1]))


def triangle(corners: Sequence[Sequence[float]] | Floats, colour: Colour) -> Face:
    """Return a triangle in one colour."""
    c = np.array(corners, dtype=np.float64)
    return Face(c, colour, (c[0], c[1], c[2]))


@dataclass(frozen=True)
class Polyhedron:
    """A convex solid made of faces; ``layer`` as in `sim.objects.revolution.Revolution`.

    Of two parts in a layer, the one whose ``depth_at`` (x, y in the object's frame; default: the middle) is nearer to
    the camera covers the other. That is exact if the line between these points crosses a plane between the parts at a
    right angle.
    """

    faces: tuple[Face, ...]
    layer: int = 0
    depth_at: tuple[float, float] | None = None

    @property
    def reach_mm(self) -> float:
        """Return the radius of a circle as large as its outline seen from above."""
        outline = cv2.convexHull(np.concatenate([face.corners[:, :2] for face in self.faces]).astype(np.float32))
        return sqrt(cv2.contourArea(outline) / pi)

    def drawings(self, pose: ObjectPose) -> list[Drawing]:
        return [Drawing((self.layer, pose.depth(*self._depth_at)), partial(self._draw, pose))]

    @cached_property
    def _depth_at(self) -> tuple[float, float]:
        if self.depth_at is not None:
            return self.depth_at
        x, y, _ = np.concatenate([face.corners for face in self.faces]).mean(axis=0)
        return float(x), float(y)

    @cached_property
    def _geometry(self) -> tuple[Floats, list[slice], Floats, Floats]:
        """All corners (n, 3), the slice of each face, the frames' points (3 m, 3), the normals (m, 3)."""
        corners = np.concatenate([face.corners for face in self.faces])
        ends = np.cumsum([len(face.corners) for face in self.faces])
        frames = np.concatenate([np.stack(face.frame) for face in self.faces])
        slices = [slice(int(end) - len(face.corners), int(end)) for face, end in zip(self.faces, ends, strict=True)]
        return corners, slices, frames, np.array([face.normal for face in self.faces])

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
        blend(image[top : top + size[1], left : left + size[0]], solid, cover)


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
        blend(solid[y0:y1, x0:x1], shaded, cover)


def _fill(image: Image, polygon: Floats, colour: Sequence[float]) -> None:
    cv2.fillConvexPoly(image, np.round(polygon * (1 << _SHIFT)).astype(np.int32), colour, cv2.LINE_AA, _SHIFT)


# -- solids -----------------------------------------------------------------------------------------------------------


def box(
    size_mm: tuple[float, float, float],
    walls: tuple[Paint | Colour, Paint | Colour, Paint | Colour, Paint | Colour],
    *,
    top: Paint | Colour,
    at: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rotation_deg: float = 0.0,
    layer: int = 0,
) -> Polyhedron:
    """Return a box (width, depth, height) at ``at``, rotated about its own axis, without a bottom.

    The ``walls`` are front, right, back and left.
    """
    w, d, h = size_mm[0] / 2, size_mm[1] / 2, size_mm[2]
    ring = [(-w, -d), (w, -d), (w, d), (-w, d)]
    sides = [
        quad([(*ring[i], h), (*ring[i], 0), (*ring[(i + 1) % 4], 0), (*ring[(i + 1) % 4], h)], paint)
        for i, paint in enumerate(walls)
    ]
    lid = quad([(-w, d, h), (-w, -d, h), (w, -d, h), (w, d, h)], top)
    return moved(Polyhedron((*sides, lid), layer), at, rotation_deg)


def prism(sides: int, radius_mm: float, height_mm: float, *, wall: Paint | Colour, top: Paint | Colour) -> Polyhedron:
    """Return an upright prism over a regular polygon with a face to the front; all walls have the same print."""
    ring = [
        (radius_mm * cos(a), radius_mm * sin(a))
        for a in (radians(-90) + (2 * i - 1) * pi / sides for i in range(sides + 1))
    ]
    walls = [quad([(*a, height_mm), (*a, 0), (*b, 0), (*b, height_mm)], wall) for a, b in pairwise(ring)]
    lid = np.array([(*p, height_mm) for p in ring[:-1]])
    r, z = radius_mm, height_mm
    return Polyhedron((*walls, Face(lid, top, (np.array([-r, r, z]), np.array([r, r, z]), np.array([-r, -r, z])))))


def lying_cylinder(
    radius_mm: float,
    length_mm: float,
    *,
    wall: Colour,
    end: Paint | Colour,
    at: tuple[float, float, float],
    rotation_deg: float = 0.0,
    depth_at: tuple[float, float] | None = None,
) -> Polyhedron:
    """Return a horizontal cylinder with its printed end to the front and its back end at ``at``."""
    sides = 36
    ring = [(radius_mm * cos(2 * pi * i / sides), radius_mm * sin(2 * pi * i / sides)) for i in range(sides + 1)]
    y = -length_mm
    walls = [
        quad([(a[0], 0, a[1]), (b[0], 0, b[1]), (b[0], y, b[1]), (a[0], y, a[1])], wall) for a, b in pairwise(ring)
    ]
    r = radius_mm
    near = np.array([(x, y, z) for x, z in ring[:-1]])
    far = np.array([(x, 0.0, z) for x, z in ring[:-1]])[::-1].copy()
    lid = Face(near, end, (np.array([-r, y, r]), np.array([r, y, r]), np.array([-r, y, -r])))
    cap = Face(far, wall, (far[0], far[1], far[2]))
    return moved(Polyhedron((*walls, lid, cap), 0, depth_at), at, rotation_deg)


def roof(
    size_mm: tuple[float, float, float], *, slope: Paint, gable: Colour, at: tuple[float, float, float]
) -> Polyhedron:
    """Return a gabled roof (width, depth, height) whose ridge runs from left to right."""
    w, d, h = size_mm[0] / 2, size_mm[1] / 2, size_mm[2]
    a, b, c, e = (-w, -d, 0.0), (w, -d, 0.0), (w, d, 0.0), (-w, d, 0.0)
    left, right = (-w, 0.0, h), (w, 0.0, h)
    triangles = [np.array(t, dtype=np.float64) for t in ((e, a, left), (b, c, right))]
    faces = (
        quad([left, a, b, right], slope),
        quad([right, c, e, left], slope),
        *(Face(t, gable, (t[0], t[1], t[2])) for t in triangles),
    )
    return moved(Polyhedron(faces, 1), at, 0.0)


def moved(solid: Polyhedron, at: tuple[float, float, float], rotation_deg: float) -> Polyhedron:
    """Return ``solid`` rotated about its own axis and moved to ``at`` in the object's frame."""
    pose = ObjectPose(rotation_deg)

    def placed(points: Floats) -> Floats:
        return np.asarray(pose.rotate(points) + np.array(at))

    faces = tuple(Face(placed(f.corners), f.paint, _three(placed(np.array(f.frame)))) for f in solid.faces)
    return Polyhedron(faces, solid.layer, solid.depth_at)


def _three(points: Floats) -> tuple[Floats, Floats, Floats]:
    return points[0], points[1], points[2]
