"""Chart of an enrollment: the sharpness of each view at its azimuth."""

from collections.abc import Sequence
from statistics import median
from typing import Final, NamedTuple

from rig.charts import svg
from rig.charts.compass import CENTRE, RIM, SIZE, polar, rim
from rig.core.phrases import azimuth_words

_FLOOR: Final = 62.0
_CEILING: Final = 150.0


class RingView(NamedTuple):
    """A view of an enrollment: its azimuth, its sharpness in squared levels, and the frames rejected before it."""

    azimuth_deg: float
    sharpness: float
    retakes: int = 0


def azimuth_ring(views: Sequence[RingView]) -> str:
    """Draw each view as a bar at its azimuth; retaken views have a mark on the rim.

    The length of a bar is proportional to the sharpness; the longest bar reaches `_CEILING`.

    Raises
    ------
    ValueError
        There are no views.
    """
    if not views:
        raise ValueError("an azimuth ring needs at least one view")
    sharpest = max(v.sharpness for v in views)
    unit = (_CEILING - _FLOOR) / sharpest if sharpest > 0 else 0.0
    middle = median(v.sharpness for v in views)
    parts = [*rim(), svg.circle(CENTRE, _FLOOR, "baseline")]
    for view in views:
        retaken = f", {_times(view.retakes)} retaken" if view.retakes else ""
        words = f"{azimuth_words(view.azimuth_deg)}°: sharpness {view.sharpness:.1f}{retaken}"
        ends = polar(_FLOOR, view.azimuth_deg), polar(_FLOOR + unit * view.sharpness, view.azimuth_deg)
        parts.append(svg.line(*ends, "bar retaken" if view.retakes else "bar", svg.title(words)))
        if view.retakes:
            parts.append(svg.circle(polar((_CEILING + RIM) / 2, view.azimuth_deg), 4, "retake", svg.title(words)))
    parts.append(svg.circle(CENTRE, _FLOOR + unit * middle, "median"))
    for row, words in enumerate(("sharpness", f"median {middle:.0f}", f"{_lowest(views):.0f} to {sharpest:.0f}")):
        parts.append(svg.text(words, (CENTRE[0], CENTRE[1] - 12 + 17 * row), "ring-text"))
    retaken_views = sum(1 for v in views if v.retakes)
    label = (
        f"Ring of {len(views)} views by azimuth; sharpness from {_lowest(views):.1f} to {sharpest:.1f}, "
        f"median {middle:.1f}; {retaken_views} retaken"
    )
    return svg.drawing(SIZE, SIZE, label, parts)


def _lowest(views: Sequence[RingView]) -> float:
    return min(v.sharpness for v in views)


def _times(n: int) -> str:
    return "once" if n == 1 else f"{n} times"
