"""Charts over two axes, drawn by Matplotlib: SVG for pages in light and dark mode, PNG for everything else.

Import this module only when a chart is written: Matplotlib takes about a second to load. Decision:
docs/decisions/0035.
"""

import re
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from html import escape
from io import BytesIO, StringIO
from math import ceil, floor, log10
from typing import TYPE_CHECKING, Final

from rig.core.phrases import filled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, SOFT, GRID, PAPER = "#1d2126", "#5b636d", "#e4e7ea", "#ffffff"
MEASURED, MODEL, LIMIT, OTHER = "#0072b2", "#d55e00", "#b3261e", "#009e73"
"""One colour for each role of a series, in every chart: Okabe and Ito's palette, and a red for limits."""

_THEME: Final = {INK: "--ink", SOFT: "--soft", GRID: "--rule", PAPER: "--card"}
"""Colours that a page replaces by those of its style sheet, which has a dark mode."""
_DPI: Final = 100
_MARGIN: Final = 0.04
"""Share of an axis between its ends and the data."""
_STYLE: Final = {
    "axes.axisbelow": True,
    "axes.edgecolor": GRID,
    "axes.labelcolor": SOFT,
    "axes.labelsize": 9,
    "axes.spines.left": False,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.grid": True,
    "axes.grid.axis": "y",
    "figure.facecolor": PAPER,
    "axes.facecolor": PAPER,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "grid.color": GRID,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "legend.labelcolor": INK,
    "lines.linewidth": 1.6,
    "lines.markersize": 4,
    "svg.fonttype": "none",  # text stays text: it can be selected, read aloud and themed
    "svg.hashsalt": "hbr-rig",  # equal charts give equal bytes
    "xtick.color": SOFT,
    "xtick.labelsize": 9,
    "ytick.color": SOFT,
    "ytick.labelsize": 9,
    "ytick.major.size": 0,
}


@dataclass(frozen=True)
class Series:
    """Points (``dots``), a curve, or both; ``low`` and ``high`` bound an uncertainty band.

    A series without a label has no entry in the legend.
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


@dataclass(frozen=True)
class Axis:
    """Label and scale of an axis.

    Attributes
    ----------
    label
        The quantity and its unit.
    log
        Logarithmic scale.
    falling
        Values grow downwards, as rows of an image do.
    whole
        Ticks at whole numbers only.
    span
        Values that the axis includes in any case.
    ticks, names
        Positions of the ticks, and their labels; chosen automatically if empty.
    """

    label: str
    log: bool = False
    falling: bool = False
    whole: bool = False
    span: tuple[float, ...] = ()
    ticks: tuple[float, ...] = ()
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Chart:
    """Series over two axes.

    Attributes
    ----------
    square
        A unit of x is as long as a unit of y.
    wide
        The legend is beside the axes, for charts of many series; else it is below.
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
        ends = ", ".join(filled("{} {:.4g}", s.label, s.y[-1]) for s in self.series if s.label and len(s.y))
        return f"{self.title}. {self.y.label} against {self.x.label}. Last values: {ends}"

    def svg(self, *, themed: bool = False) -> str:
        """Return SVG markup; equal charts give equal bytes.

        Parameters
        ----------
        themed
            For a page with the report's style sheet: text, grid and background take the colours of its light or dark
            mode. Otherwise the chart needs no style sheet.
        """
        return _compact(self._markup, self.label, themed=themed)

    def png(self) -> bytes:
        """Return a PNG file of twice the size in CSS pixels."""
        file = BytesIO()
        with _style():
            self._figure.savefig(file, format="png", dpi=2 * _DPI)
        return file.getvalue()

    @cached_property
    def _markup(self) -> str:
        file = StringIO()
        with _style():
            self._figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
        return file.getvalue()

    @cached_property
    def _figure(self) -> "Figure":
        from matplotlib.figure import Figure

        with _style():
            size = (8.6, 4.4) if self.wide else (6.4, 5.2 if self.square else 3.9)
            figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
            axes = figure.add_subplot()
            axes.set_title(self.title, wrap=True)
            for series in self.series:
                _draw(axes, series)
            _scale(axes, self.x, "x")
            _scale(axes, self.y, "y")
            if self.square:
                axes.set_aspect("equal")
            if any(series.label for series in self.series) and self.wide:
                figure.legend(loc="outside right center")  # below a long title
            elif any(series.label for series in self.series):
                figure.legend(loc="outside lower left", ncols=4)
            # Lay the chart out once. With a layout engine, each file would draw the chart twice.
            if engine := figure.get_layout_engine():
                engine.execute(figure)
            figure.set_layout_engine(None)
        return figure


def _style() -> "AbstractContextManager[None]":
    import matplotlib as mpl

    return mpl.rc_context(_STYLE)  # type: ignore[arg-type]


def _draw(axes: "Axes", series: Series) -> None:
    """Draw the band, the curve and the points of one series."""
    if len(series.low) > 1:
        axes.fill_between(series.x, series.low, series.high, color=series.colour, alpha=0.1, linewidth=0)
    elif series.low:
        axes.vlines(series.x, series.low, series.high, color=series.colour)
    axes.plot(
        series.x,
        series.y,
        color=series.colour,
        linestyle=("--" if series.dashed else "-") if series.curve else "none",
        marker="o" if series.dots else "",
        label=series.label or "_hidden",
    )


def _scale(axes: "Axes", axis: Axis, which: str) -> None:
    """Set label, scale, limits and ticks of one axis."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

    ruler = axes.xaxis if which == "x" else axes.yaxis
    set_limits = axes.set_xlim if which == "x" else axes.set_ylim
    axes.set(**{f"{which}label": axis.label})
    if axis.log:
        axes.set(**{f"{which}scale": "log"})
    low, high = axes.get_xlim() if which == "x" else axes.get_ylim()
    if axis.log:
        decades = ceil(log10(high)) - floor(log10(low))
        ruler.set_major_locator(LogLocator(subs=(1, 2, 5) if decades <= 2 else (1,)))
        ruler.set_major_formatter(StrMethodFormatter("{x:.10g}"))
        ruler.set_minor_formatter(NullFormatter())
    elif axis.ticks:
        ruler.set_ticks(axis.ticks, axis.names or [f"{tick:g}" for tick in axis.ticks])
        low, high = min(low, axis.ticks[0]), max(high, axis.ticks[-1])
    else:
        ruler.set_major_locator(MaxNLocator(7, integer=axis.whole, steps=[1, 2, 5, 10]))
    low, high = min((low, *axis.span)), max((high, *axis.span))
    if axis.span and not axis.log:
        # Matplotlib's margin is a share of the data's range, which may be a small part of the axis.
        first, last = sorted(axes.dataLim.intervalx if which == "x" else axes.dataLim.intervaly)
        margin = _MARGIN * (high - low)
        low = low if low in axis.span else min(low, first - margin)
        high = high if high in axis.span else max(high, last + margin)
    set_limits((high, low) if axis.falling else (low, high))


def _two_decimals(number: re.Match[str]) -> str:
    return f"{float(number[0]):.2f}".rstrip("0").rstrip(".")


def _compact(svg: str, label: str, *, themed: bool) -> str:
    """Return Matplotlib's SVG with an alternative text, free to scale, without what a page does not need."""
    svg = svg[svg.index("<svg") :]
    box = re.search(r'viewBox="[^"]*"', svg)
    body = svg[svg.index(">") + 1 :]
    body = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", body, flags=re.DOTALL)
    body = re.sub(r'<g id="[a-z_0-9.]+"', "<g", body)  # ids would repeat on a page of several charts
    body = re.sub(r"<[^>]*>", lambda tag: re.sub(r"-?\d+\.\d{3,}", _two_decimals, tag[0]), body)  # not in the texts
    body = re.sub(r"\s*\n\s*", " ", body)
    body = re.sub(r"font: ([^;\"]*?)'DejaVu Sans'[^;\"]*", r"font: \1system-ui, 'DejaVu Sans', sans-serif", body)
    if themed:
        for colour, variable in _THEME.items():
            body = body.replace(colour, f"var({variable}, {colour})")
    head = f'<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" {box[0] if box else ""}'
    return f'{head} role="img" aria-label="{escape(label)}">{body.strip()}\n'
