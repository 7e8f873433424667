"""SVG elements for all charts: escaped text, and equal bytes for equal numbers.

Shapes have classes. One style sheet, `chart.css`, gives them their colours in light and dark mode.
Decision: docs/decisions/0023.
"""

from collections.abc import Iterable
from functools import cache
from html import escape
from importlib.resources import files
from typing import Final

Point = tuple[float, float]

_MARGIN: Final = 12.0
"""Around a chart in a file of its own."""


def number(value: float) -> str:
    """Return ``value`` with at most two decimals, without trailing zeros and without a negative zero."""
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def element(tag: str, *content: str, **attributes: str | float) -> str:
    """Return an element; ``content`` is markup, attribute values are escaped.

    Underscores in the names of attributes stand for hyphens; a trailing one, as in ``class_``, is dropped.
    """
    text = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{escape(value) if isinstance(value, str) else number(value)}"'
        for name, value in attributes.items()
    )
    return f"<{tag}{text}>{''.join(content)}</{tag}>" if content else f"<{tag}{text}/>"


def text(words: str, at: Point, class_: str, *, anchor: str = "middle") -> str:
    """Return escaped text whose baseline has its ``anchor`` at a point."""
    return element("text", escape(words), x=at[0], y=at[1], class_=class_, text_anchor=anchor)


def title(words: str) -> str:
    """Return a tooltip; put it into the element that it explains."""
    return element("title", escape(words))


def path(points: Iterable[Point], class_: str, *content: str, close: bool = False) -> str:
    """Return a polyline or, closed, a polygon."""
    d = "M" + "L".join(f"{number(x)} {number(y)}" for x, y in points)
    return element("path", *content, d=d + ("Z" if close else ""), class_=class_)


def line(a: Point, b: Point, class_: str, *content: str) -> str:
    """Return a straight line."""
    return element("line", *content, x1=a[0], y1=a[1], x2=b[0], y2=b[1], class_=class_)


def circle(at: Point, radius: float, class_: str, *content: str) -> str:
    """Return a circle."""
    return element("circle", *content, cx=at[0], cy=at[1], r=radius, class_=class_)


def drawing(width: float, height: float, label: str, parts: Iterable[str], *, alone: bool = False) -> str:
    """Return the complete chart.

    ``label`` is its alternative text. ``alone`` is for a file of its own, with the style sheet; otherwise the page has
    it.
    """
    margin = _MARGIN if alone else 0.0
    box = {"x": -margin, "y": -margin, "width": width + 2 * margin, "height": height + 2 * margin}
    style = [element("style", _style()), element("rect", **box, class_="paper")] if alone else []
    size = {"viewBox": " ".join(map(number, box.values())), "xmlns": "http://www.w3.org/2000/svg"}
    return element("svg", *style, *parts, **size, role="img", aria_label=label, class_="chart")


@cache
def _style() -> str:
    return files("rig.charts").joinpath("static/chart.css").read_text("utf-8")
