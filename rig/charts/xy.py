"""Charts over two axes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from math import ceil, floor, isfinite, log10
from textwrap import wrap
from typing import Final, NamedTuple

from rig.charts import svg
from rig.charts.svg import Point
from rig.core.phrases import filled
from rig.core.phrases import number as number_words

MEASURED, MODEL, OTHER, FOURTH, LIMIT = "c0", "c1", "c2", "c3", "limit"
"""One colour for each role of a series, in every chart: classes of `chart.css`."""

_WIDTH, _WIDE = 400.0, 760.0
"""Letters of a chart that is 400 wide are legible on a phone."""
_PLOT_HEIGHT, _SQUARE_HEIGHT, _WIDE_HEIGHT = 190.0, 340.0, 320.0
_LETTER_PX, _TITLE_LETTER_PX = 7.6, 8.6
"""Widths of a letter at the size of a phone, estimated: nothing here knows the font."""
_ROW_PX: Final = 17.0  # rows of text at the size of a phone, and the line before a label
_KEY_PX: Final = 22.0
_MARGIN: Final = 0.04
"""Share of an axis between its ends and the data."""
_MANY: Final = 100
"""More points than these are smaller, because they would hide each other."""
_TICKS: Final = 8  # more labels overlap on a phone


@dataclass(frozen=True)
class Series:
    """Points (``dots``), a curve, or both; ``low`` and ``high`` bound an uncertainty band.

    A series without a label has no entry in the legend. The colour is a class of `chart.css`. A value of y that is not
    finite makes a gap.
    """

    label: str
    x: Sequence[float]
    y: Sequence[float]
    colour: str = MEASURED
    dots: bool = True
    curve: bool = False
    dashed: bool = False
    low: Sequence[float] = ()
    high: Sequence[float] = ()
    bold: bool = False


@dataclass(frozen=True)
class Axis:
    """Label and scale of an axis."""

    label: str
    """The quantity and its unit."""
    falling: bool = False
    """Values grow downwards, as rows of an image do."""
    whole: bool = False
    """Ticks at whole numbers only."""
    span: tuple[float, ...] = ()
    """Values that the axis includes in any case."""
    ticks: tuple[float, ...] = ()
    names: tuple[str, ...] = ()
    """Positions of the ticks, and their labels; chosen automatically if empty."""


@dataclass(frozen=True)
class Chart:
    """Series over two axes.

    ``square``: a unit of x is as long as a unit of y. ``wide`` is for charts of many series.
    """

    title: str
    x: Axis
    y: Axis
    series: Sequence[Series]
    square: bool = False
    wide: bool = False

    @property
    def label(self) -> str:
        """Alternative text: title, axes, and the last value of each labelled series."""
        shown = [series for series in self.series if series.label and len(series.y) and isfinite(series.y[-1])]
        ends = ", ".join(filled("{} {:.4g}", series.label, series.y[-1]) for series in shown)
        return f"{self.title}. {self.y.label} against {self.x.label}. Last values: {ends}"

    def svg(self, *, alone: bool = False) -> str:
        """Return SVG markup; ``alone`` for a file of its own (see `rig.charts.svg.drawing`)."""
        width = _WIDE if self.wide else _WIDTH
        title = wrap(self.title, int(width / _TITLE_LETTER_PX))
        top = _ROW_PX * (len(title) + 1) + 8
        labelled = [series for series in self.series if series.label]

        # The width of the numbers at the y axis decides where the plot begins.
        y_range = _range(self.y, [v for s in self.series for v in (*s.y, *s.low, *s.high)])
        x_range = _range(self.x, [v for s in self.series for v in s.x])
        left = 10 + _LETTER_PX * max(len(words) for _, words in _ticks(self.y, *y_range))
        right = width - 12
        height = _WIDE_HEIGHT if self.wide else _PLOT_HEIGHT
        if self.square:
            unit_px = min((right - left) / (x_range[1] - x_range[0]), _SQUARE_HEIGHT / (y_range[1] - y_range[0]))
            height = unit_px * (y_range[1] - y_range[0])
            right = left + unit_px * (x_range[1] - x_range[0])
        bottom = top + height
        x = _Scale(x_range[0], left, (right - left) / (x_range[1] - x_range[0]))
        units_px = height / (y_range[1] - y_range[0])
        y = _Scale(y_range[0], top, units_px) if self.y.falling else _Scale(y_range[0], bottom, -units_px)

        # From below to above: title and axes, then the curves; the key is outside the plot.
        parts = [svg.text(words, (0, 13 + _ROW_PX * row), "title", anchor="start") for row, words in enumerate(title)]
        parts.append(svg.text(self.y.label, (0, top - 9), "small", anchor="start"))
        for value, words in _ticks(self.y, *y_range):
            parts.append(svg.line((left, y(value)), (right, y(value)), "grid"))
            parts.append(svg.text(words, (left - 6, y(value) + 4), "axis", anchor="end"))
        for at, words in _without_overlap([(x(value), words) for value, words in _ticks(self.x, *x_range)]):
            parts.append(svg.line((at, bottom), (at, bottom + 4), "tick"))
            parts.append(svg.text(words, (at, bottom + 18), "axis"))
        parts.append(svg.text(self.x.label, ((left + right) / 2, bottom + 36), "small"))
        for series in self.series:
            parts += _draw(series, x, y)
        places = _rows(labelled, bottom + 58, width)
        for series, place in zip(labelled, places, strict=True):
            parts += _key(series, place)
        end = max([bottom + 44, *(place[1] + 8 for place in places)])
        return svg.drawing(width, end, self.label, parts, alone=alone)


class _Scale(NamedTuple):
    low: float
    low_px: float
    unit_px: float

    def __call__(self, value: float) -> float:
        return self.low_px + (value - self.low) * self.unit_px


def _range(axis: Axis, values: Sequence[float]) -> tuple[float, float]:
    """Return the ends of an axis: data, ticks and included values, with a margin beyond the data."""
    shown = [value for value in (*values, *axis.span, *axis.ticks) if isfinite(value)]
    low, high = (min(shown), max(shown)) if shown else (0.0, 1.0)
    if high - low <= 1e-9 * max(abs(low), abs(high)):  # neighbouring numbers would be equal
        low, high = low - (abs(low) or 1.0) / 2, high + (abs(high) or 1.0) / 2
    margin = _MARGIN * (high - low)
    return low if low in axis.span else low - margin, high if high in axis.span else high + margin


def _ticks(axis: Axis, low: float, high: float) -> list[tuple[float, str]]:
    """Return the values of an axis that have a number, and their words."""
    if axis.ticks:
        return list(zip(axis.ticks, axis.names or [number_words(tick, "g") for tick in axis.ticks], strict=True))
    least = (high - low) / _TICKS
    power = floor(log10(least))
    step, power = next(
        (digit * 10.0**p, p) for p in (power, power + 1) for digit in (1, 2, 5) if digit * 10.0**p >= least
    )
    if axis.whole:
        step, power = max(1.0, step), max(0, power)
    form = f".{max(0, -power)}f" if power > -6 and max(abs(low), abs(high)) < 1e6 else ".3g"
    return [
        (step * i, number_words(step * i, form)) for i in range(ceil(low / step - 1e-9), floor(high / step + 1e-9) + 1)
    ]


def _without_overlap(ticks: Sequence[tuple[float, str]]) -> Iterator[tuple[float, str]]:
    """Yield ticks whose numbers have room; others are left out."""
    free_px = -_LETTER_PX
    for at, words in ticks:
        half = _LETTER_PX * len(words) / 2
        if at - half >= free_px:
            yield at, words
            free_px = at + half + _LETTER_PX


def _draw(series: Series, x: _Scale, y: _Scale) -> list[str]:
    parts = []
    if len(series.low) > 0:
        edge = [(x(at), y(low)) for at, low in zip(series.x, series.low, strict=True)]
        edge += [(x(at), y(high)) for at, high in zip(reversed(series.x), reversed(series.high), strict=True)]
        one = len(series.low) == 1
        parts.append(svg.path(edge, f"{'curve' if one else 'band'} {series.colour}", close=not one))
    points = [(at, value) if isfinite(value) else None for at, value in zip(series.x, series.y, strict=True)]
    if series.curve:
        for drawn, run in groupby(points, key=bool):
            if drawn:
                parts.append(svg.path([(x(p[0]), y(p[1])) for p in run if p], _curve_class(series)))
    if series.dots:
        radius = 3 if len(points) <= _MANY else 2
        for at, value in filter(None, points):
            words = filled("{}: {:.4g} at {:g}", series.label, value, round(at, 3))
            parts.append(svg.circle((x(at), y(value)), radius, f"dot {series.colour}", svg.title(words)))
    return parts


def _curve_class(series: Series) -> str:
    return f"curve {series.colour}{' dashed' if series.dashed else ''}{' bold' if series.bold else ''}"


def _rows(labelled: Sequence[Series], top: float, width: float) -> list[Point]:
    """Return the places of the legend's entries below a chart, row by row."""
    places: list[Point] = []
    at, row = 0.0, 0
    for series in labelled:
        needed = _KEY_PX + _LETTER_PX * len(series.label) + 12
        if at and at + needed > width:
            at, row = 0.0, row + 1
        places.append((at, top + _ROW_PX * row))
        at += needed
    return places


def _key(series: Series, place: Point) -> list[str]:
    left, y = place
    parts = []
    if series.curve:
        parts.append(svg.line((left, y - 4), (left + _KEY_PX - 6, y - 4), _curve_class(series)))
    if series.dots and not series.dashed:  # it would hide the gap between the dashes
        parts.append(svg.circle((left + (_KEY_PX - 6) / 2, y - 4), 3, f"dot {series.colour}"))
    return [*parts, svg.text(series.label, (left + _KEY_PX, y), "name", anchor="start")]
