"""The room around the object, as a camera that orbits the object sees it: a round wall, and a table up to the wall.

The wall is a cylinder around the axis, with doors, shelves and a window; the projection is that of
`sim.objects.projection`. Only this room is simulated: the camera's arm and the camera's own shadow are not.
"""

from functools import cache, lru_cache
from math import cos, radians, sin
from zlib import crc32

import cv2
import numpy as np
from numpy.typing import NDArray

from sim.objects.paint import Sheet
from sim.objects.projection import (
    AMBIENT,
    CENTRE_PX,
    COS,
    HEIGHT,
    PX_PER_MM,
    SIN,
    TO_LIGHT,
    WIDTH,
    Colour,
    Floats,
    Image,
)
from sim.objects.solid import empty_platter

_WALL_MM = 450.0  # radius of the wall: the upper half of the image shows it
_WALL_HIGH_MM = 120.0  # height of the wall in the image
_COLUMNS = 14400  # of the wall's texture: a column is 0.4 px in the image, so that the wall moves smoothly
_ROWS = 240


def room(seed: int, rotated_deg: float) -> Image:
    """Return the room with the empty platter, uint8 (480, 640, 3), read-only.

    ``rotated_deg`` is the room's counter-clockwise rotation before the camera: the negative azimuth of the camera.
    """
    return _room(seed, round(rotated_deg % 360 * _COLUMNS / 360))


def relight(image: Image, empty: Image, rotated_deg: float) -> None:
    """Change the light on the object in ``image``, uint8 (480, 640, 3), to a lamp that rotates with the room.

    An object is drawn under the lamp at the front left. Its columns are multiplied by the ratio of the light from both
    directions on an upright cylinder as wide as the object. ``empty`` is the image without the object.
    """
    changed = cv2.bitwise_not(cv2.inRange(cv2.absdiff(image, empty), (0, 0, 0), (0, 0, 0)))
    left, top, width, height = cv2.boundingRect(changed)
    if not width:
        return
    box = np.s_[top : top + height, left : left + width]
    across = np.linspace(-1.0, 1.0, width)
    c, s = cos(radians(rotated_deg)), sin(radians(rotated_deg))
    x, y, _ = TO_LIGHT
    ratio = _on_cylinder(across, c * x - s * y, s * x + c * y) / _on_cylinder(across, x, y)
    factors = np.broadcast_to(ratio[None, :, None], (height, width, 3)).astype(np.float32, order="C")
    lit = cv2.multiply(image[box], factors, dtype=cv2.CV_8U)
    # The shadow, and other pixels before the platter that are darker, do not become brighter than the platter.
    darker = cv2.inRange(cv2.subtract(image[box], empty[box]), (0, 0, 0), (0, 0, 0))
    darker = cv2.bitwise_and(darker, _platter()[1][box])
    lit = cv2.copyTo(cv2.min(lit, empty[box]), darker, lit)
    image[box] = cv2.copyTo(lit, changed[box], image[box].copy())


def _on_cylinder(across: Floats, x: float, y: float) -> Floats:
    """Return the light on the front of an upright cylinder, from -1 (left edge) to 1, of a lamp at (x, y)."""
    return AMBIENT + (1 - AMBIENT) * np.maximum(across * x - np.sqrt(1.0 - across**2) * y, 0.0)


@lru_cache(maxsize=8)
def _room(seed: int, column: int) -> Image:
    """Return the room rotated by a number of columns of the wall's texture."""
    # The table: a photograph from above, rotated and foreshortened.
    a = -2 * np.pi * column / _COLUMNS
    c, s, mm, half = np.cos(a), np.sin(a), 1 / PX_PER_MM, _WALL_MM
    from_image = np.array([[mm, 0.0, -mm * CENTRE_PX[0]], [0.0, -mm / SIN, mm / SIN * CENTRE_PX[1]]])
    wall_map, margin, on_wall = _wall_map()
    top = int(np.flatnonzero((on_wall == 0).any(axis=1))[0])  # the wall covers all rows above
    from_image[:, 2] += from_image[:, 1] * top
    matrix = np.array([[c, -s], [s, c]]) @ from_image
    matrix[:, 2] += half
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    image = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    cv2.warpAffine(_table(seed), matrix, (WIDTH, HEIGHT - top), image[top:], flags=flags, borderMode=cv2.BORDER_REFLECT)
    # The wall behind it: the visible part of its texture, on the cylinder.
    left = (_COLUMNS // 4 - column - margin) % _COLUMNS  # the camera looks along +y
    seen = _wall(seed)[:, left : left + 2 * margin + 1]
    wall = cv2.remap(seen, wall_map, np.empty(0), cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    cv2.copyTo(wall, on_wall, image[: len(wall)])
    cv2.copyTo(*_platter(), image)
    image.flags.writeable = False
    return image


@cache
def _wall_map() -> tuple[NDArray[np.int16], int, Image]:
    """Return the map of the top rows into the wall's texture, for `cv2.remap`, and where they show the wall.

    The map's column 0 is as many columns of the texture from the middle as the second value.
    """
    x = (np.arange(WIDTH) - CENTRE_PX[0]) / PX_PER_MM
    y = np.sqrt(_WALL_MM**2 - x**2)
    up = (CENTRE_PX[1] - np.arange(HEIGHT)[:, None]) / PX_PER_MM
    z = (up - y * SIN) / COS
    z = z[: int(np.flatnonzero((z >= 0).any(axis=1))[-1]) + 1]
    # A larger angle is further counter-clockwise, which is to the left.
    u = np.broadcast_to((np.arctan2(y, x) - np.pi / 2) * _COLUMNS / (2 * np.pi), z.shape)
    v = (1 - z / _WALL_HIGH_MM) * (_ROWS - 1)
    margin = int(np.ceil(np.abs(u).max())) + 2
    nearest = np.round(np.dstack([u + margin, v])).astype(np.int16)
    return nearest, margin, np.where(z >= 0, 255, 0).astype(np.uint8)


@cache
def _platter() -> tuple[Image, Image]:
    empty = empty_platter()
    return empty, np.where((empty != empty[0, 0]).any(axis=2), 255, 0).astype(np.uint8)


def _colour(rng: np.random.Generator, low: int, high: int) -> Colour:
    b, g, r = rng.integers(low, high, 3).tolist()
    return b, g, r


@cache
def _wall(seed: int) -> Image:
    """Return the wall, with paint that changes around the room, a bright window, and furniture.

    Its left part stands again at its right end, so that each view of the wall is one slice.
    """
    rng = np.random.default_rng([seed, crc32(b"room")])
    sheet = Sheet((_ROWS, _COLUMNS), (120, 128, 132))
    for i in range(6):  # walls and curtains of other colours
        sheet.panel(i / 6, 0.0, (i + 1) / 6, 1.0, _colour(rng, 60, 190))
    for _ in range(28):  # furniture that stands on the table's level, and pictures
        left, wide, top = rng.random(), rng.uniform(0.008, 0.03), rng.uniform(0.1, 0.7)
        bottom = 1.0 if rng.random() < 0.6 else min(top + rng.uniform(0.15, 0.4), 1.0)
        sheet.panel(left, top, left + wide, bottom, _colour(rng, 25, 215))
    window = rng.random()
    sheet.panel(window, 0.0, window + 0.06, 0.75, (246, 240, 232))
    for bar in (0.0, 0.03, 0.06):
        sheet.panel(window + bar - 0.001, 0.0, window + bar + 0.001, 0.77, (60, 70, 80))
    return np.hstack([sheet.pixels, sheet.pixels[:, : 2 * _wall_map()[1] + 1]])


@cache
def _table(seed: int) -> Image:
    """Return the table from above, a pixel for each millimetre: boards of wood, and papers around the platter."""
    rng = np.random.default_rng([seed, crc32(b"table")])
    side = 2 * round(_WALL_MM)
    sheet = Sheet((side, side), (92, 112, 134))
    for i in range(10):
        tone = rng.uniform(0.8, 1.15)
        sheet.panel(i / 10, 0.0, (i + 1) / 10, 1.0, (int(92 * tone), int(112 * tone), int(134 * tone)))
    for angle in rng.uniform(0, 2 * np.pi, 9):
        u, v = 0.5 + 0.33 * np.cos(angle), 0.5 + 0.33 * np.sin(angle)
        w, h = rng.uniform(0.02, 0.06, 2)
        sheet.panel(u - w, v - h, u + w, v + h, _colour(rng, 40, 220))
    return sheet.pixels
