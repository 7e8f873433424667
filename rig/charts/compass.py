"""Charts on the circle of azimuths around the table, seen from above: the camera's path, and the table's angle."""

from collections.abc import Collection, Sequence
from itertools import accumulate
from math import atan2, ceil, cos, hypot, radians, sin
from typing import Final, NamedTuple

from rig.charts import svg
from rig.charts.svg import Point
from rig.core.phrases import azimuth_words

SIZE: Final = 400.0  # units of the drawing: a page scales it to its place
CENTRE: Final = (SIZE / 2, SIZE / 2)
RIM: Final = 160.0  # leaves room for the labels around it

_INNERMOST, _OUTERMOST = 60.0, 145.0
_STOP_PX: Final = 8.0
_SEEN_PX: Final = 3.0
_ARROW_PX: Final = 9.0
_ARC_STEP_DEG: Final = 4.0  # a chord leaves the largest circle by 0.1 px, less than a line is wide
_MOST_ARC_STEPS: Final = 5_000
"""A damaged record can have any rotation."""


def polar(radius: float, azimuth_deg: float) -> Point:
    """Return the point at an azimuth: 0° is at the top, angles grow counter-clockwise.

    A camera that moves to its left moves to the left of the page.
    """
    angle = radians(azimuth_deg)
    return CENTRE[0] - radius * sin(angle), CENTRE[1] - radius * cos(angle)


def _rim(every: int = 30) -> list[str]:
    """Draw the circle and its scale: a tick every 10°, a number ``every`` so many degrees."""
    parts = [svg.circle(CENTRE, RIM, "rim")]
    for azimuth in range(0, 360, 10):
        named = azimuth % every == 0
        parts.append(svg.line(polar(RIM, azimuth), polar(RIM + (7 if named else 4), azimuth), "tick"))
        if named:
            x, y = polar(RIM + 12, azimuth)
            anchor = {0: "middle", 180: "middle"}.get(azimuth, "end" if azimuth < 180 else "start")
            parts.append(svg.text(f"{azimuth}°", (x, y + 4 - 6 * cos(radians(azimuth))), "axis", anchor=anchor))
    return parts


def dial() -> str:
    """Return the circle for the present angle of the table; a script turns its needles and sets the used budget."""
    ring = {"cx": CENTRE[0], "cy": CENTRE[1], "r": 120.0}
    needle = {"x1": CENTRE[0], "y1": CENTRE[1], "x2": CENTRE[0]}
    parts = [
        *_rim(every=90),
        svg.element("circle", id="budget", class_="ring", **ring),
        svg.element("circle", id="used", class_="ring", pathLength=1.0, **ring),
        svg.element("line", id="gyro", y2=CENTRE[1] - 100, **needle),
        svg.element("line", id="needle", y2=CENTRE[1] - 148, **needle),
    ]
    return svg.drawing(SIZE, SIZE, "angle of the table, seen from above", parts)


class PathStep(NamedTuple):
    """A rotation of the camera around the object, positive to the left, and the number of the view at its end."""

    number: int
    rotation_deg: float


def polar_path(start_deg: float, steps: Sequence[PathStep], *, named: Collection[int]) -> str:
    """Draw the camera's positions, seen from above, and the rotations between them.

    The path is a spiral: its radius grows with every view, so that it never covers itself. View k is at the sum of
    ``start_deg``, the azimuth of the first one, and the first k of the measured rotations. The views ``named``, which
    the report shows, have their number, the others a dot.
    """
    azimuth_deg = list(accumulate((step.rotation_deg for step in steps), initial=start_deg))
    numbers = [1, *(step.number for step in steps)]
    radius_step = min(30.0, (_OUTERMOST - _INNERMOST) / max(1, len(steps)))
    first = (_INNERMOST + _OUTERMOST - radius_step * len(steps)) / 2
    places = [(first + radius_step * k, azimuth) for k, azimuth in enumerate(azimuth_deg)]
    parts = _rim()
    for k, step in enumerate(steps):
        arc = _arc(places[k], places[k + 1])
        side = "left" if step.rotation_deg >= 0 else "right"
        words = f"view {numbers[k]} to {step.number}: {side} {abs(step.rotation_deg):.1f}°"
        parts.append(svg.path(arc, "step", svg.title(words)))
        if step.number in named:
            parts.append(_arrowhead(arc))
    for number, place in zip(numbers, places, strict=True):
        x, y = polar(*place)
        words = svg.title(f"view {number} at {azimuth_words(place[1])}°")
        if number in named:
            parts.append(svg.circle((x, y), _STOP_PX, "stop", words))
            parts.append(svg.text(str(number), (x, y + 4), "stop-number"))
        else:
            parts.append(svg.circle((x, y), _SEEN_PX, "seen", words))
    where = ", ".join(f"{azimuth_words(azimuth)}°" for azimuth in azimuth_deg)
    label = f"Camera positions seen from above, in the order of the views: {where}"
    return svg.drawing(SIZE, SIZE, label, parts)


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
