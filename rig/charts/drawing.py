"""Figures as a list of shapes, drawn as SVG for pages and as PNG for everything else."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.charts.svg import Point, number

Anchor = Literal["start", "middle", "end"]

#: Pixels of a PNG for a unit of the figure.
PNG_SCALE: Final = 2
#: Fractional bits of the coordinates that OpenCV draws at.
_BITS: Final = 4
#: OpenCV's own letters are ASCII.
_ASCII: Final = str.maketrans({"ω": "omega", "°": " deg", "−": "-", "–": "-", "≤": "<=", "σ": "sigma", "’": "'"})


@dataclass(frozen=True)
class Line:
    """A polyline."""

    points: Sequence[Point]
    colour: str
    width: float = 1.0
    dashed: bool = False


@dataclass(frozen=True)
class Dot:
    """A filled circle, with words that a page shows where the pointer rests."""

    at: Point
    radius: float
    colour: str
    words: str = ""


@dataclass(frozen=True)
class Area:
    """A filled polygon that lets through what is below."""

    points: Sequence[Point]
    colour: str
    opacity: float


@dataclass(frozen=True)
class Text:
    """A line of text at its baseline."""

    words: str
    at: Point
    colour: str = "#1d2126"
    anchor: Anchor = "start"
    size: float = 12.0
    bold: bool = False


@dataclass(frozen=True)
class Figure:
    """Shapes on white, in the order they are drawn; `label` says in words what they show."""

    width: int
    height: int
    label: str
    shapes: Sequence[Line | Dot | Area | Text]

    def svg(self) -> str:
        """Return the figure as SVG markup that needs no style sheet; equal figures give equal bytes."""
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} {self.height}" role="img" '
            f'aria-label="{escape(self.label)}" font-family="system-ui, Helvetica, Arial, sans-serif">'
        )
        ground = f'<rect width="{self.width}" height="{self.height}" fill="#fff"/>'
        return head + ground + "".join(_markup(shape) for shape in self.shapes) + "</svg>\n"

    def png(self) -> bytes:
        """Return the figure as a PNG file."""
        canvas = np.full((self.height * PNG_SCALE, self.width * PNG_SCALE, 3), 255, np.uint8)
        for shape in self.shapes:
            _paint(canvas, shape)
        return cv2.imencode(".png", canvas)[1].tobytes()


def _markup(shape: Line | Dot | Area | Text) -> str:
    match shape:
        case Line():
            dash = ' stroke-dasharray="5 4"' if shape.dashed else ""
            return (
                f'<path d="{_path(shape.points)}" fill="none" stroke="{shape.colour}" '
                f'stroke-width="{number(shape.width)}" stroke-linejoin="round"{dash}/>'
            )
        case Dot():
            x, y = shape.at
            title = f"<title>{escape(shape.words)}</title>" if shape.words else ""
            return (
                f'<circle cx="{number(x)}" cy="{number(y)}" r="{number(shape.radius)}" fill="{shape.colour}">'
                f"{title}</circle>"
            )
        case Area():
            return f'<path d="{_path(shape.points)}Z" fill="{shape.colour}" fill-opacity="{number(shape.opacity)}"/>'
        case Text():
            x, y = shape.at
            weight = ' font-weight="600"' if shape.bold else ""
            return (
                f'<text x="{number(x)}" y="{number(y)}" fill="{shape.colour}" font-size="{number(shape.size)}" '
                f'text-anchor="{shape.anchor}"{weight}>{escape(shape.words)}</text>'
            )


def _path(points: Sequence[Point]) -> str:
    return "M" + "L".join(f"{number(x)} {number(y)}" for x, y in points)


def _paint(canvas: NDArray[np.uint8], shape: Line | Dot | Area | Text) -> None:
    colour = _bgr(shape.colour)
    match shape:
        case Line():
            width = max(1, round(shape.width * PNG_SCALE))
            for points in _dashes(shape.points) if shape.dashed else [shape.points]:
                cv2.polylines(canvas, [_fixed(points)], False, colour, width, cv2.LINE_AA, _BITS)
        case Dot():
            x, y = _fixed([shape.at])[0].tolist()
            cv2.circle(canvas, (x, y), round(shape.radius * PNG_SCALE * 2**_BITS), colour, -1, cv2.LINE_AA, _BITS)
        case Area():
            covered = canvas.copy()
            cv2.fillPoly(covered, [_fixed(shape.points)], colour, cv2.LINE_AA, _BITS)
            cv2.addWeighted(covered, shape.opacity, canvas, 1 - shape.opacity, 0, canvas)
        case Text():
            _write(canvas, shape, colour)


def _write(canvas: NDArray[np.uint8], text: Text, colour: tuple[int, int, int]) -> None:
    words = text.words.translate(_ASCII)
    font = cv2.FONT_HERSHEY_SIMPLEX
    thickness = 2 if text.bold else 1
    # a capital of this font is 21 units high; of a text font, 0.72 of its size
    scale = 0.72 * text.size * PNG_SCALE / 21
    width = cv2.getTextSize(words, font, scale, thickness)[0][0]
    x = text.at[0] * PNG_SCALE - {"start": 0.0, "middle": width / 2, "end": width}[text.anchor]
    cv2.putText(canvas, words, (round(x), round(text.at[1] * PNG_SCALE)), font, scale, colour, thickness, cv2.LINE_AA)


def _fixed(points: Sequence[Point]) -> NDArray[np.int32]:
    # OpenCV's pixel centres are whole numbers, the figure's edges of pixels are
    return np.rint((np.array(points) * PNG_SCALE - 0.5) * 2**_BITS).astype(np.int32)


def _dashes(points: Sequence[Point], on: float = 5.0, off: float = 4.0) -> list[list[Point]]:
    """Return the drawn pieces of a polyline; the pattern runs on around its corners."""
    parts = []
    passed = 0.0
    for (x0, y0), (x1, y1) in pairwise(points):
        length = float(np.hypot(x1 - x0, y1 - y0))
        first = passed // (on + off) * (on + off) - passed
        for start in np.arange(first, length, on + off).tolist():
            begin, end = max(0.0, start), min(start + on, length)
            if begin < end:
                parts.append([(x0 + d / length * (x1 - x0), y0 + d / length * (y1 - y0)) for d in (begin, end)])
        passed += length
    return parts


def _bgr(colour: str) -> tuple[int, int, int]:
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return blue, green, red
