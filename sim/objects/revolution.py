"""Bodies of revolution about a vertical axis, drawn with one remap of their texture.

When a body rotates about its axis, its silhouette and its shading stay; only the texture moves. So the point that each
pixel shows is computed once. The profile is sampled from top to bottom as (r, h). The ray of a pixel at x to the right
of the axis and v above the foot is v = y sin e + h cos e. Sample k is the circle of radius r_k; the pixel's column
meets it where x² = r_k² - y_k² =: g_k. From the camera the ray meets high samples first: it hits the first k with
g_k >= x². If that is k = 0, the ray enters a vessel through its mouth and hits the first inner sample with g_k <= x².
"""

from dataclasses import dataclass
from functools import cached_property, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from sim.objects.projection import COS, PX_PER_MM, SIN, Colour, Floats, Image, ObjectPose, Paint, gloss, shade
from sim.objects.solid import Curve, Drawing, evenly, place

TEXELS_PER_MM = 2.0
_STEP_MM = 0.25  # half a pixel along the outline
_SUBROWS = 4  # more: smoother upper and lower edges, at more time for each frame
_LINING_ROWS = 4


@dataclass(frozen=True)
class Revolution:
    """A textured surface of revolution."""

    profile: Curve
    """(radius, height) in millimetres from the top to the foot; heights do not increase. A vessel's profile begins at
    the inner edge of its rim."""
    paint: Paint
    """Returns the texture of the outside for its (rows, columns): uint8 (rows, columns, 3). Rows run along the profile,
    columns once around, counter-clockwise, the front (azimuth 0) in the middle."""
    inside: Curve = ()
    """(radius, height) from the rim down to the centre of the vessel's floor; empty for a closed body."""
    lining: Colour = (235, 238, 238)
    """Colour of the inside, B, G, R."""
    at: tuple[float, float] = (0.0, 0.0)
    """Position of the axis in the object's frame, in millimetres."""
    shine: float = 0.0
    """Strength of the highlight, 0..1."""
    layer: int = 0
    """Parts of higher layers cover those of lower ones."""

    def drawings(self, pose: ObjectPose) -> list[Drawing]:
        foot_px = pose.to_image(np.array([[*self.at, 0.0]]))[0]
        return [(self.layer, pose.depth(*self.at), partial(self._draw, pose.azimuth_deg, foot_px))]

    @property
    def reach_mm(self) -> float:
        """Return the radius of the foot, on which the shadow depends."""
        return self.profile[-1][0]

    def _draw(self, azimuth_deg: float, foot_px: Floats, image: Image) -> None:
        base = self._at_azimuth_0
        columns = base.columns
        shift = -azimuth_deg / 360 * columns
        whole = int(np.floor(shift))
        texture = self._texture[:, whole % columns :]
        seen = cv2.remap(texture, base.column + np.float32(shift - whole), base.row, cv2.INTER_LINEAR)
        shaded = np.asarray(cv2.multiply(seen, base.light, scale=1 / 255), dtype=np.uint8)
        cv2.add(shaded, base.highlight, dst=shaded)
        place(image, shaded, base.clear, foot_px - base.foot_px)

    @cached_property
    def _outside(self) -> Floats:
        return evenly(self.profile, _STEP_MM, dimensions=2)

    @cached_property
    def _texture(self) -> Image:
        """The texture twice side by side, so that every rotation is one slice, and two more columns."""
        radius = max(r for r, _ in self.profile)
        rows = round(len(self._outside) * _STEP_MM * TEXELS_PER_MM)
        texture = self.paint((rows, round(2 * np.pi * radius * TEXELS_PER_MM)))
        texture = np.vstack([texture, np.full((_LINING_ROWS, texture.shape[1], 3), self.lining, dtype=np.uint8)])
        return np.ascontiguousarray(np.hstack([texture, texture, texture[:, :2]]))

    @cached_property
    def _at_azimuth_0(self) -> "_SeenPoints":
        inside = evenly(self.inside, _STEP_MM, dimensions=2) if self.inside else None
        rows, width, _ = self._texture.shape
        return _trace(self._outside, inside, rows - _LINING_ROWS, (width - 2) // 2, self.shine)


@dataclass(frozen=True, slots=True)
class _SeenPoints:
    """The points that the pixels of a body show at azimuth 0, (h, w); `foot_px` is where its axis meets z = 0."""

    column: NDArray[np.float32]
    row: NDArray[np.float32]
    light: Image  # (h, w, 3): shading times cover
    highlight: Image  # (h, w, 3)
    clear: Image  # (h, w, 3): 255 - cover
    foot_px: Floats
    columns: int  # once around the texture


def _trace(outside: Floats, inside: Floats | None, rows: int, columns: int, shine: float) -> _SeenPoints:
    half = int(np.ceil(outside[:, 0].max() * PX_PER_MM)) + 2
    top = int(np.ceil(outside[:, 1].max() * PX_PER_MM * COS + half * SIN)) + 2
    up = np.arange(top, -int(np.ceil(half * SIN)) - 3, -1, dtype=np.float64)
    x = np.arange(-half, half + 1) / PX_PER_MM
    cover = _cover(outside, up, half)

    sample, y = _hits(outside, up / PX_PER_MM, x, entering=True)
    radial, rising = (np.interp(sample, np.arange(len(outside)), n) for n in _normals(outside))
    row = np.clip(sample / (len(outside) - 1) * rows - 0.5, 0, rows - 1)
    hollow = x**2 < _sections(outside[:1], up / PX_PER_MM)[0]
    if inside is not None:
        within, y_within = _hits(inside, up / PX_PER_MM, x, entering=False)
        radial_within, rising_within = (np.interp(within, np.arange(len(inside)), n) for n in _normals(inside))
        y = np.where(hollow, y_within, y)
        radial, rising = np.where(hollow, -radial_within, radial), np.where(hollow, -rising_within, rising)
        row = np.where(hollow, rows + _LINING_ROWS / 2, row)

    azimuth = np.arctan2(y, x)  # in the room, 0 to the right; the front is at -90°
    column = ((azimuth / (2 * np.pi) + 0.75) * columns - 0.5) % columns
    normals = np.stack([radial * np.cos(azimuth), radial * np.sin(azimuth), rising], axis=-1)
    light = shade(normals) * np.where(hollow, 0.85, 1.0)  # the inside gets less ambient light
    return _SeenPoints(
        column=column.astype(np.float32),
        row=row.astype(np.float32),
        light=_three(light * cover * 255),
        highlight=_three(gloss(normals, 40.0) * shine * cover * 255),
        clear=_three(255 - np.round(cover * 255)),
        foot_px=np.array([half, top], dtype=np.float64),
        columns=columns,
    )


def _hits(profile: Floats, up_mm: Floats, x_mm: Floats, *, entering: bool) -> tuple[Floats, Floats]:
    """Return where each pixel's ray first enters or leaves a profile's body: the fractional sample, and y."""
    g, y = _sections(profile, up_mm)
    sign = 1.0 if entering else -1.0
    g *= sign
    reach = np.maximum.accumulate(g, axis=1)
    after = np.empty((len(up_mm), len(x_mm)), np.intp)
    square = np.minimum(sign * x_mm**2, reach[:, -1:])  # the centre of a partly covered pixel may be outside
    for own, row, wanted in zip(after, reach, square, strict=True):
        own[:] = row.searchsorted(wanted)
    before = np.maximum(after - 1, 0)
    g_before = np.take_along_axis(g, before, axis=1)
    step = np.where(after > before, np.take_along_axis(g, after, axis=1) - g_before, 1.0)
    sample = before + np.clip((square - g_before) / step, 0.0, 1.0)
    whole = sample.astype(np.intp)
    here = np.take_along_axis(y, whole, axis=1)
    behind = np.take_along_axis(y, np.minimum(whole + 1, len(profile) - 1), axis=1)
    return sample, (behind - here) * (sample - whole) + here


def _sections(profile: Floats, up_mm: Floats) -> tuple[Floats, Floats]:
    """Return g and y of every profile sample (columns) for every row of pixels."""
    r, h = profile.T
    y = up_mm[:, None] - h[None] * COS
    y /= SIN
    g = y * y
    return np.subtract(r**2, g, out=g), y


def _normals(profile: Floats) -> tuple[Floats, Floats]:
    """Return the outward normal's radial and vertical part at every sample, edges rounded over 2 mm."""
    slopes = cv2.blur(np.gradient(profile, axis=0), (1, round(2 / _STEP_MM)), borderType=cv2.BORDER_REFLECT)
    dr, dh = slopes.T
    length = np.hypot(dr, dh)
    return -dh / length, dr / length


def _cover(outside: Floats, up: Floats, half: int) -> Floats:
    """Return which part of each pixel the body covers: exact across, `_SUBROWS` samples down."""
    offsets = (np.arange(_SUBROWS) + 0.5) / _SUBROWS - 0.5
    # not at once: the sections of all rows do not fit into the processor's cache
    widest = np.stack([_sections(outside, (up + down) / PX_PER_MM)[0].max(axis=1) for down in offsets], axis=1).ravel()
    edge = np.sqrt(np.maximum(widest, 0.0)) * PX_PER_MM
    x = np.abs(np.arange(-half, half + 1))
    cover = np.clip(edge[:, None] + 0.5 - x, 0.0, 1.0) * (widest > 0)[:, None]
    return np.asarray(cover.reshape(len(up), _SUBROWS, -1).mean(axis=1))


def _three(plane: Floats) -> Image:
    return np.ascontiguousarray(np.repeat(np.clip(np.round(plane), 0, 255).astype(np.uint8)[..., None], 3, axis=2))
