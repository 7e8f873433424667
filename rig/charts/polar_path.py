"""Chart of a search: the camera's positions around the object, and the rotations between them."""

from collections.abc import Sequence
from math import atan2, ceil, cos, hypot, sin
from typing import Final, NamedTuple

from rig.charts import svg
from rig.charts.compass import CENTRE, SIZE, polar, rim
from rig.charts.svg import Point
from rig.core.phrases import azimuth_words, distinct, short

_STOP_PX: Final = 10.0
_ARROW_PX: Final = 9.0
_INNERMOST: Final = 58.0
_OUTERMOST: Final = 140.0
_ARC_STEP_DEG: Final = 4.0
_MOST_ARC_STEPS: Final = 5_000
"""A damaged record can have any rotation."""
_LABEL_PX: Final = (46.0, 17.0)
_LABEL_SPOTS: Final = (0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8)
_LABEL_ASIDE_PX: Final = (22.0, -22.0)
_CAPTION_Y: Final = SIZE + 12
_LIST_TOP: Final = SIZE + 40
_LIST_ROW: Final = 38.0
_LIST_COLUMN: Final = SIZE / 2
_NOTE_LETTERS: Final = 28


class PathStep(NamedTuple):
    """A rotation of the camera around the object, positive to the left, and its reason.

    The reason is the two similarity sums of Eq. 6, or the two candidates that the next view separates; a fixed step has
    neither.
    """

    rotation_deg: float
    s_left: float | None = None
    s_right: float | None = None
    candidates: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        return f"{'left' if self.rotation_deg >= 0 else 'right'} {abs(self.rotation_deg):.1f}°"


def polar_path(start_deg: float, steps: Sequence[PathStep], *, scale: str) -> str:
    """Draw the camera's numbered positions, seen from above, and the rotations between them.

    The path is a spiral: its radius grows with every view, so that it never covers itself.

    Parameters
    ----------
    start_deg
        Azimuth of the first view.
    steps
        The measured rotations between the views.
    scale
        Caption of the azimuth scale.

    Returns
    -------
    SVG markup. View k is at the sum of ``start_deg`` and the first k rotations.
    """
    azimuth_deg = [start_deg]
    for step in steps:
        azimuth_deg.append(azimuth_deg[-1] + step.rotation_deg)
    radii = _radii(len(azimuth_deg))
    stops = [polar(radius, azimuth) for radius, azimuth in zip(radii, azimuth_deg, strict=True)]
    arcs = [_arc((radii[k], azimuth_deg[k]), (radii[k + 1], azimuth_deg[k + 1])) for k in range(len(steps))]
    parts = [*rim(), svg.circle(CENTRE, 24, "object"), svg.text("object", (CENTRE[0], CENTRE[1] + 4), "small")]
    for k, (step, arc) in enumerate(zip(steps, arcs, strict=True)):
        parts.append(svg.path(arc, "step", svg.title(f"view {k + 1} to {k + 2}: {step.words}")))
        parts.append(_arrowhead(arc))
    for k, (x, y) in enumerate(stops):
        last = " last" if k == len(steps) else ""
        words = svg.title(f"view {k + 1} at {azimuth_words(azimuth_deg[k])}°")
        parts.append(svg.circle((x, y), _STOP_PX, f"stop{last}", words))
        parts.append(svg.text(str(k + 1), (x, y + 4), f"stop-number{last}"))
    for step, spot in zip(steps, _label_spots(arcs, stops), strict=True):
        if spot is not None:  # the list has all rotations
            parts.append(svg.text(f"{abs(step.rotation_deg):.1f}°", (spot[0], spot[1] + 4), "step-label"))
    where = ", ".join(f"{azimuth_words(a)}°" for a in azimuth_deg)
    label = f"Camera positions seen from above, in the order of the views: {where}"
    height = _CAPTION_Y + 12 + _LIST_ROW * _rows(steps)
    return svg.drawing(SIZE, height, label, [*parts, *_list(steps, scale)])


def _radii(n: int) -> list[float]:
    step = min(30.0, (_OUTERMOST - _INNERMOST) / max(1, n - 1))
    first = (_INNERMOST + _OUTERMOST - step * (n - 1)) / 2
    return [first + k * step for k in range(n)]


def _arc(start: tuple[float, float], end: tuple[float, float]) -> list[Point]:
    """Return the points of the spiral between two (radius, azimuth), both included."""
    (r0, a0), (r1, a1) = start, end
    steps = min(max(2, ceil(abs(a1 - a0) / _ARC_STEP_DEG)), _MOST_ARC_STEPS)
    return [polar(r0 + (r1 - r0) * i / steps, a0 + (a1 - a0) * i / steps) for i in range(steps + 1)]


def _arrowhead(arc: Sequence[Point]) -> str:
    """Return a triangle at the end of an arc that touches the disc of the view."""
    x, y = arc[-1]
    before = next((p for p in reversed(arc) if hypot(p[0] - x, p[1] - y) >= _STOP_PX + _ARROW_PX), arc[0])
    heading = atan2(y - before[1], x - before[0])

    def at(back: float, aside: float) -> Point:
        return x - back * cos(heading) - aside * sin(heading), y - back * sin(heading) + aside * cos(heading)

    tail = _STOP_PX + _ARROW_PX
    return svg.path([at(_STOP_PX, 0), at(tail, _ARROW_PX / 2), at(tail, -_ARROW_PX / 2)], "arrow", close=True)


def _label_spots(arcs: Sequence[Sequence[Point]], stops: Sequence[Point]) -> list[Point | None]:
    """Return a position for the label of each arc, on which no view, other label or other arc is; None without one."""
    taken = [*stops, CENTRE]
    spots: list[Point | None] = []
    for k, arc in enumerate(arcs):
        wanted = [arc[round(share * (len(arc) - 1))] for share in _LABEL_SPOTS]
        wanted += [_outwards(wanted[0], aside) for aside in _LABEL_ASIDE_PX]
        others = [point for other in (*arcs[:k], *arcs[k + 1 :]) for point in other]
        free = (p for p in wanted if not any(_covers(p, other) for other in taken))
        spots.append(next((p for p in free if not any(_touches(p, other) for other in others)), None))
        taken += [spot for spot in spots[-1:] if spot is not None]
    return spots


def _outwards(point: Point, by: float) -> Point:
    x, y = point[0] - CENTRE[0], point[1] - CENTRE[1]
    stretch = 1 + by / hypot(x, y)
    return CENTRE[0] + x * stretch, CENTRE[1] + y * stretch


def _covers(a: Point, b: Point) -> bool:
    return abs(a[0] - b[0]) < _LABEL_PX[0] and abs(a[1] - b[1]) < _LABEL_PX[1]


def _touches(label: Point, point: Point) -> bool:
    return abs(label[0] - point[0]) < _LABEL_PX[0] / 2 and abs(label[1] - point[1]) < _LABEL_PX[1] / 2


def _rows(steps: Sequence[PathStep]) -> int:
    return ceil(len(steps) / 2)


def _list(steps: Sequence[PathStep], scale: str) -> list[str]:
    """List the rotations in two columns, each with its reason."""
    parts = [svg.text(f"{scale}; left is counter-clockwise", (CENTRE[0], _CAPTION_Y), "small")]
    for k, step in enumerate(steps):
        column, row = divmod(k, _rows(steps))
        x, y = 4 + _LIST_COLUMN * column, _LIST_TOP + _LIST_ROW * row
        parts.append(svg.text(f"{k + 1} → {k + 2}", (x, y), "small", anchor="start"))
        parts.append(svg.text(step.words, (x + 44, y), "step-name", anchor="start"))
        if step.s_left is None or step.s_right is None:
            why = short(" or ".join(step.candidates), _NOTE_LETTERS) or "fixed"
        else:
            left, right = distinct(step.s_left, step.s_right)
            why = f"S left {left}, right {right}"
        parts.append(svg.text(why, (x, y + 15), "small", anchor="start"))
    return parts
