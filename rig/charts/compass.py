"""Charts on the circle of azimuths around the table, seen from above: the camera's path, and the table's angle."""

from collections.abc import Mapping
from itertools import accumulate, pairwise
from math import ceil, cos, radians, sin
from typing import Final

from hbr.core.angles import wrap180
from rig.charts import svg
from rig.charts.svg import Point
from rig.core.phrases import azimuth_words

SIZE: Final = 400.0  # units of the drawing: a page scales it to its place
CENTRE: Final = (SIZE / 2, SIZE / 2)
RIM: Final = 160.0  # leaves room for the labels around it

_INNERMOST, _OUTERMOST = 60.0, 145.0
_STOP_PX: Final = 8.0
_ARC_STEP_DEG: Final = 4.0  # a chord leaves the largest circle by 0.1 px, less than a line is wide


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


def polar_path(azimuths_deg: Mapping[int, float]) -> str:
    """Draw the camera's positions, seen from above, and the rotations between them, each the short way.

    ``azimuths_deg`` are the azimuths of at least one view by the views' numbers, in the order of the search. The path
    is a spiral: its radius grows with every view, so that it never covers itself.
    """
    rotations_deg = [wrap180(after - before) for before, after in pairwise(azimuths_deg.values())]
    unwrapped_deg = list(accumulate(rotations_deg, initial=next(iter(azimuths_deg.values()))))
    radius_step = min(30.0, (_OUTERMOST - _INNERMOST) / max(1, len(rotations_deg)))
    first = (_INNERMOST + _OUTERMOST - radius_step * len(rotations_deg)) / 2
    places = [(first + radius_step * k, azimuth_deg) for k, azimuth_deg in enumerate(unwrapped_deg)]
    parts = _rim()
    # The arcs lie below the views, whose discs cover their ends.
    for rotation_deg, (start, end) in zip(rotations_deg, pairwise(places), strict=True):
        side = "left" if rotation_deg >= 0 else "right"
        parts.append(svg.path(_arc(start, end), "step", svg.title(f"{side} {abs(rotation_deg):.1f}°")))
    for number, place in zip(azimuths_deg, places, strict=True):
        x, y = polar(*place)
        words = svg.title(f"view {number} at {azimuth_words(place[1])}°")
        parts.append(svg.circle((x, y), _STOP_PX, "stop", words))
        parts.append(svg.text(str(number), (x, y + 4), "stop-number"))
    where = ", ".join(f"{azimuth_words(azimuth_deg)}°" for azimuth_deg in unwrapped_deg)
    return svg.drawing(SIZE, SIZE, f"Camera positions seen from above, in the order of the views: {where}", parts)


def _arc(start: tuple[float, float], end: tuple[float, float]) -> list[Point]:
    """Return the points of the spiral between two (radius, azimuth), both included."""
    (r0, a0), (r1, a1) = start, end
    steps = max(2, ceil(abs(a1 - a0) / _ARC_STEP_DEG))
    return [polar(r0 + (r1 - r0) * i / steps, a0 + (a1 - a0) * i / steps) for i in range(steps + 1)]
