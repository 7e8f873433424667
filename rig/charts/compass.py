"""The circle of azimuths around the table, seen from above, that three charts share."""

from math import cos, radians, sin
from typing import Final

from rig.charts import svg
from rig.charts.svg import Point

SIZE: Final = 400.0
CENTRE: Final = (SIZE / 2, SIZE / 2)
RIM: Final = 160.0


def polar(radius: float, azimuth_deg: float) -> Point:
    """Return the point at an azimuth: 0° is at the top, angles grow counter-clockwise.

    A camera that moves to its left moves to the left of the page.
    """
    angle = radians(azimuth_deg)
    return CENTRE[0] - radius * sin(angle), CENTRE[1] - radius * cos(angle)


def rim(radius: float = RIM) -> list[str]:
    """Draw the circle and its scale: a tick every 10°, a number every 30°."""
    parts = [svg.circle(CENTRE, radius, "rim")]
    for azimuth in range(0, 360, 10):
        named = azimuth % 30 == 0
        tick = radius + (7 if named else 4)
        parts.append(svg.line(polar(radius, azimuth), polar(tick, azimuth), "tick"))
        if named:
            x, y = polar(radius + 21, azimuth)
            parts.append(svg.text(f"{azimuth}°", (x, y + 4), "axis"))
    return parts
