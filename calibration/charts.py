"""The one chart of the calibrations: points and curves over two axes, linear or logarithmic."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, floor, log10

from rig.charts.drawing import Area, Dot, Figure, Line, Text
from rig.charts.svg import Point

WIDTH, HEIGHT = 640, 360
_LEFT, _TOP, _RIGHT, _BOTTOM = 66.0, 44.0, 620.0, 300.0
_SQUARE_MORE = 140
"""By how much higher charts are whose axes have the same unit."""
_INK, _SOFT, _GRID = "#1d2126", "#5b636d", "#e4e7ea"

MEASURED, MODEL, LIMIT, OTHER = "#0072b2", "#d55e00", "#b3261e", "#009e73"
"""One colour for each part that a series plays, in every chart (Okabe and Ito's palette but for the limit's red)."""


@dataclass(frozen=True)
class Series:
    """Points (``dots``), a curve, or both; ``band`` is how far up and down what lies between is uncertain."""

    label: str
    x: Sequence[float]
    y: Sequence[float]
    colour: str = MEASURED
    dots: bool = True
    curve: bool = False
    dashed: bool = False
    band: Sequence[float] = ()


@dataclass(frozen=True)
class Axis:
    """What an axis shows, and how; ``falling`` from the top down, ``whole`` numbers, ``span`` at least."""

    label: str
    log: bool = False
    falling: bool = False
    whole: bool = False
    span: tuple[float, ...] = ()


def chart(title: str, x: Axis, y: Axis, series: Sequence[Series], *, square: bool = False) -> Figure:
    """Return the series over both axes; ``square``: a unit of one is as long as a unit of the other."""
    x_low, x_high, x_ticks = _reach(x, [v for s in series for v in s.x])
    y_low, y_high, y_ticks = _reach(
        y,
        [
            v + sign * b
            for s in series
            for v, b in zip(s.y, s.band or [0.0] * len(s.y), strict=True)
            for sign in (-1, 1)
        ],
    )
    height = HEIGHT + _SQUARE_MORE if square else HEIGHT
    right, bottom = _RIGHT, _BOTTOM
    if square:
        bottom += _SQUARE_MORE
        unit = min((_RIGHT - _LEFT) / (x_high - x_low), (bottom - _TOP) / (y_high - y_low))
        right, bottom = _LEFT + unit * (x_high - x_low), _TOP + unit * (y_high - y_low)
    across = _scale(x, x_low, x_high, _LEFT, right)
    up = _scale(y, y_low, y_high, *((_TOP, bottom) if y.falling else (bottom, _TOP)))

    def at(point_x: float, point_y: float) -> Point:
        return across(point_x), up(point_y)

    shapes: list[Line | Dot | Area | Text] = [
        Text(title, (_LEFT, 18), _INK, size=13, bold=True),
        Text(y.label, (8, 36), _SOFT, size=11),
        Text(x.label, ((_LEFT + right) / 2, bottom + 36), _SOFT, "middle", 11),
    ]
    for tick in y_ticks:
        shapes.append(Line([(_LEFT, up(tick)), (right, up(tick))], _GRID))
        shapes.append(Text(f"{tick:.10g}", (_LEFT - 8, up(tick) + 4), _SOFT, "end", 11))
    for tick in x_ticks:
        shapes.append(Line([(across(tick), bottom), (across(tick), bottom + 4)], _SOFT))
        shapes.append(Text(f"{tick:.10g}", (across(tick), bottom + 18), _SOFT, "middle", 11))
    for s in series:
        points = [at(*point) for point in zip(s.x, s.y, strict=True)]
        if s.band:
            edges = [[at(a, b + sign * c) for a, b, c in zip(s.x, s.y, s.band, strict=True)] for sign in (1, -1)]
            shapes.append(Area([*edges[0], *reversed(edges[1])], s.colour, 0.12))
        if s.curve:
            shapes.append(Line(points, s.colour, 1.8, s.dashed))
        if s.dots:
            shapes += [
                Dot(point, 2.6, s.colour, f"{s.label}: {a:.5g}, {b:.5g}")
                for point, a, b in zip(points, s.x, s.y, strict=True)
            ]
    begin = _LEFT
    for s in series:
        if not s.label:
            continue
        y_legend = bottom + 52.0
        if s.curve:
            shapes.append(Line([(begin, y_legend - 4), (begin + 22, y_legend - 4)], s.colour, 2.0, s.dashed))
        if s.dots:
            shapes.append(Dot((begin + 11, y_legend - 4), 3.0, s.colour))
        shapes.append(Text(s.label, (begin + 28, y_legend), _INK, size=11.5))
        begin += 28 + 6.4 * len(s.label) + 22
    label = f"{title}. {y.label} against {x.label}: {', '.join(s.label for s in series if s.label)}"
    return Figure(WIDTH, min(height, round(bottom) + 60), label, shapes)


def _reach(axis: Axis, values: Sequence[float]) -> tuple[float, float, list[float]]:
    """Return where an axis begins and ends, and its ticks."""
    given = [*values, *axis.span]
    low, high = min(given, default=0.0), max(given, default=1.0)
    if axis.log:
        first, last = floor(log10(low)), ceil(log10(high))
        steps = (1, 2, 5) if last - first <= 2 else (1,)
        ticks = [m * 10.0**e for e in range(first, last + 1) for m in steps]
        begin, end = max(t for t in ticks if t <= low * 1.001), min(t for t in ticks if t >= high * 0.999)
        return begin, end, [t for t in ticks if begin <= t <= end]
    step = 10.0 ** floor(log10((high - low) or abs(high) or 1.0))
    step = next(step * m for m in (0.1, 0.2, 0.5, 1.0, 2.0) if (high - low) / (step * m) <= 7)
    step = max(round(step), 1) if axis.whole else step
    begin, end = floor(low / step + 1e-9), ceil(high / step - 1e-9)
    end = max(end, begin + 1)
    return begin * step, end * step, [i * step for i in range(begin, end + 1)]


def _scale(axis: Axis, low: float, high: float, begin: float, end: float) -> Callable[[float], float]:
    def linear(value: float) -> float:
        return begin + (end - begin) * (value - low) / (high - low)

    def logarithmic(value: float) -> float:
        return begin + (end - begin) * log10(value / low) / log10(high / low)

    return logarithmic if axis.log and high > low else linear
