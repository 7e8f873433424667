"""Brushes for the textures of the built-in objects.

The coordinates of a texture are relative to its size: u from 0 (left) to 1 (right), v from 0 (top) to 1 (bottom). On a
body of revolution u = 0.5 is the front, and the sheet is a ring: a shape that exceeds one edge continues at the other.
"""

from collections.abc import Sequence
from math import cos, pi, sin
from typing import Any

import cv2
import numpy as np

from sim.objects.projection import Colour, Image, Paint

Stroke = Sequence[Any]

_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates


class Sheet:
    """A texture under the brush, uint8 (rows, columns, 3)."""

    def __init__(self, shape: tuple[int, int], ground: Colour) -> None:
        self.pixels = np.empty((*shape, 3), dtype=np.uint8)
        self._shift = 0.0
        self.pixels[:] = ground

    @property
    def rows(self) -> int:
        return self.pixels.shape[0]

    @property
    def columns(self) -> int:
        return self.pixels.shape[1]

    def band(self, top: float, bottom: float, colour: Colour) -> None:
        """Fill the whole width between two heights."""
        self.panel(0.0, top, 1.0, bottom, colour)

    def panel(self, left: float, top: float, right: float, bottom: float, colour: Colour) -> None:
        self.polygon([(left, top), (right, top), (right, bottom), (left, bottom)], colour)

    def polygon(self, points: Sequence[tuple[float, float]], colour: Colour) -> None:
        scale = np.array([self.columns, self.rows], dtype=np.float64)
        left, right = min(u for u, _ in points), max(u for u, _ in points)
        for ring in _rings(self._shift + left, self._shift + right):
            corners = (np.array(points) + np.array([self._shift + ring, 0.0])) * scale - 0.5
            fixed = np.round(corners * (1 << _SHIFT)).astype(np.int32)
            cv2.fillPoly(self.pixels, [fixed], colour, cv2.LINE_AA, _SHIFT)

    def stripes(self, n: int, colour: Colour, *, share: float = 0.5, top: float = 0.0, bottom: float = 1.0) -> None:
        """Paint ``n`` upright stripes, each ``share`` of its period wide."""
        for i in range(n):
            middle = (i + 0.5) / n
            self.panel(middle - share / (2 * n), top, middle + share / (2 * n), bottom, colour)

    def disc(self, u: float, v: float, radius: float, colour: Colour) -> None:
        """Paint a round spot; ``radius`` as a share of the sheet's height."""
        u, reach = self._shift + u, radius * self.rows / self.columns
        size, y = round(radius * self.rows * (1 << _SHIFT)), round((v * self.rows - 0.5) * (1 << _SHIFT))
        for ring in _rings(u - reach, u + reach):
            x = round(((u + ring) * self.columns - 0.5) * (1 << _SHIFT))
            cv2.circle(self.pixels, (x, y), size, colour, cv2.FILLED, cv2.LINE_AA, _SHIFT)

    def star(self, u: float, v: float, radius: float, colour: Colour, *, points: int = 5, waist: float = 0.42) -> None:
        """Paint a star; with a waist near 1 a rosette."""
        aspect = self.rows / self.columns
        corners = []
        for i in range(2 * points):
            r = radius * (waist if i % 2 else 1.0)
            corners.append((u + r * sin(i * pi / points) * aspect, v - r * cos(i * pi / points)))
        self.polygon(corners, colour)

    def hand(self, clockwise_deg: float, near: float, far: float, half: float, colour: Colour) -> None:
        """Paint a hand of a dial, from twelve, as a rectangle between two distances from the middle."""
        a = 2 * pi * clockwise_deg / 360
        c, s = cos(a), sin(a)
        corners = ((-half, near), (half, near), (half, far), (-half, far))
        self.polygon([(0.5 + x * c + y * s, 0.5 + x * s - y * c) for x, y in corners], colour)

    def dots(
        self, across: int, down: int, radius: float, colour: Colour, *, top: float = 0.0, bottom: float = 1.0
    ) -> None:
        """Paint a grid of spots, every other row shifted by half a step."""
        for j in range(down):
            v = top + (j + 0.5) / down * (bottom - top)
            for i in range(across):
                self.disc((i + (0.25 if j % 2 else 0.75)) / across, v, radius, colour)

    def text(self, words: str, u: float, v: float, height: float, colour: Colour, *, width: float = 1.0) -> None:
        """Write ``words`` centred at (u, v), capitals ``height`` of the sheet high, at most ``width`` of it wide."""
        font, thickness = cv2.FONT_HERSHEY_DUPLEX, 2
        (w, h), _ = cv2.getTextSize(words, font, 1.0, thickness)
        scale = min(height * self.rows / h, width * self.columns / w)
        thickness = max(round(scale * 2), 1)
        (w, h), _ = cv2.getTextSize(words, font, scale, thickness)
        origin = (round(u * self.columns - w / 2), round(v * self.rows + h / 2))
        cv2.putText(self.pixels, words, origin, font, scale, colour, thickness, cv2.LINE_AA)

    def spine(self, title: str, ground: Colour, ink: Colour) -> None:
        """Paint the spine of a book: ``ground`` with ``title`` along it."""
        first, last = round(self.rows * 0.15), round(self.rows * 0.85)
        words = Sheet((self.columns, self.rows), ground)
        words.text(title, 0.5, 0.5, 0.4, ink, width=0.66)
        self.pixels[first:last] = words.pixels[:, first:last].transpose(1, 0, 2)[:, ::-1]

    def lines(self, left: float, top: float, right: float, bottom: float, n: int, colour: Colour, seed: int) -> None:
        """Draw ``n`` lines that look like small print."""
        lengths = np.random.default_rng(seed).uniform(0.55, 1.0, n)
        for i, length in enumerate(lengths):
            v = top + (i + 0.2) * (bottom - top) / n
            self.panel(left, v, left + (right - left) * float(length), v + 0.5 * (bottom - top) / n, colour)

    def mottle(self, strength: float, size: tuple[float, float], seed: int) -> None:
        """Add smooth noise of ``strength`` grey levels, with grains of ``size`` (u, v)."""
        rng = np.random.default_rng(seed)
        cells = (max(round(1 / size[1]), 1), max(round(1 / size[0]), 1))
        coarse = rng.standard_normal(cells, dtype=np.float32)
        coarse = np.pad(coarse, 2, mode="wrap")
        scale = (self.rows / cells[0], self.columns / cells[1])
        fine = cv2.resize(
            coarse,
            (round(coarse.shape[1] * scale[1]), round(coarse.shape[0] * scale[0])),
            interpolation=cv2.INTER_CUBIC,
        )
        top, left = round(2 * scale[0]), round(2 * scale[1])
        cloud = fine[top : top + self.rows, left : left + self.columns, None] * strength
        self.pixels[:] = np.clip(self.pixels + cloud, 0, 255).astype(np.uint8)

    def around(self, rotation_deg: float, strokes: Sequence[Stroke]) -> None:
        """Paint ``strokes`` on the ring, rotated counter-clockwise by ``rotation_deg``."""
        by = round(rotation_deg / 360 * self.columns)
        self.pixels = np.roll(self.pixels, -by, axis=1)
        self.paint(strokes)
        self.pixels = np.roll(self.pixels, by, axis=1)

    def repeat(self, n: int, strokes: Sequence[Stroke]) -> None:
        """Paint ``strokes`` ``n`` times around the ring; texts, lines and mottles are not moved."""
        for i in range(n):
            self._shift = i / n
            self.paint(strokes)
        self._shift = 0.0

    def paint(self, strokes: Sequence[Stroke]) -> None:
        """Paint ``strokes`` in their order: each the name of a method, its arguments, and a dict of options."""
        for name, *arguments in strokes:
            options = arguments.pop() if isinstance(arguments[-1], dict) else {}
            getattr(self, name)(*arguments, **options)


def _rings(left: float, right: float) -> range:
    """Return the offsets, in rings, at which a shape is repeated so that it continues over an edge."""
    return range(-1 if right > 1 else 0, 2 if left < 0 else 1)


def painted(ground: Colour, strokes: Sequence[Stroke] = ()) -> Paint:
    """Return a texture: ``ground`` with ``strokes`` on it."""

    def paint(shape: tuple[int, int]) -> Image:
        sheet = Sheet(shape, ground)
        sheet.paint(strokes)
        # Without this blur, sharp edges alias on surfaces at a slant.
        return np.asarray(cv2.GaussianBlur(sheet.pixels, (0, 0), 0.7), dtype=np.uint8)

    return paint
