"""Triangles of a part, as a slicer gets them."""

import numpy as np
from build123d import Part
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def triangles(part: Part, tolerance: float = 0.05, angle: float = 0.2) -> tuple[Floats, NDArray[np.int64]]:
    """Return the corners, float64 (n, 3), and the triangles, int64 (m, 3), which point outwards."""
    found, faces = part.tessellate(tolerance, angle)
    corners = np.array([tuple(corner) for corner in found])
    same = np.unique(np.round(corners, 5), axis=0, return_inverse=True)
    faces_of = same[1].reshape(-1)[np.array(faces, dtype=np.int64)]
    whole = (faces_of[:, 0] != faces_of[:, 1]) & (faces_of[:, 1] != faces_of[:, 2]) & (faces_of[:, 2] != faces_of[:, 0])
    return same[0], faces_of[whole]


def normals(corners: Floats, faces: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Return unit normals (m, 3) and areas (m,)."""
    a, b, c = (corners[faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    twice = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(twice, 1e-12)[:, None], twice / 2
