"""Chart of a decision of the dense search: expected confusion and motion cost of every possible rotation."""

from collections.abc import Sequence
from math import exp
from typing import Final

from rig.charts import svg
from rig.charts.compass import CENTRE, RIM, SIZE, polar, rim
from rig.core.phrases import azimuth_words, filled, percent_words, short
from rig.events.events import RotationReason, Weighed

_INNER: Final = 34.0
_OUTER: Final = 118.0
_BARS: Final = (124.0, 154.0)
_STOP_PX: Final = 7.0
_LIST_TOP: Final = SIZE + 14
_COLUMN: Final = SIZE / 2
_ROW: Final = 17.0
_LETTERS: Final = 28


def decision_chart(
    here_deg: float,
    weighed: Weighed,
    rotation_deg: float,
    *,
    reason: RotationReason,
    candidates: Sequence[str] = (),
    seen_deg: Sequence[float] = (),
    number: int = 1,
) -> str:
    """Draw the expected confusion and the motion cost of every possible rotation, and the chosen rotation.

    Parameters
    ----------
    here_deg
        Azimuth of the view before the decision.
    weighed
        All possible rotations.
    rotation_deg
        The chosen rotation of the camera around the object.
    reason
        Why it was chosen.
    candidates
        The two objects that it separates, or none.
    seen_deg
        Azimuths of the views so far.
    number
        Number of the view before the decision, from 1.

    Returns
    -------
    SVG markup. The solid curve is close to the centre at rotations after which little confusion would remain, the
    dashed curve at rotations after which the two candidates are least similar. The length of the bars outside is the
    motion cost.
    """
    azimuth_deg = [here_deg + rotation for rotation in weighed.rotations_deg]
    around = sorted(range(len(azimuth_deg)), key=lambda i: azimuth_deg[i] % 360)
    curve = _radii(weighed.confusion)
    parts = [*rim(RIM)]
    parts += [svg.circle(CENTRE, radius, "grid") for radius in (_INNER, _OUTER)]
    bars = _lengths(weighed.cost)
    for i in around:
        ends = polar(_BARS[0], azimuth_deg[i]), polar(_BARS[0] + bars[i], azimuth_deg[i])
        parts.append(svg.line(*ends, "cost", svg.title(_words(weighed, i, azimuth_deg[i]))))
    if weighed.similarity is not None:
        dashed = _radii(weighed.similarity)
        parts.append(svg.path([polar(dashed[i], azimuth_deg[i]) for i in around], "similarity", close=True))
    outline = [polar(curve[i], azimuth_deg[i]) for i in around]
    parts.append(svg.path(outline, "confusion", close=len(around) > 2))
    chosen = min(range(len(azimuth_deg)), key=lambda i: abs(weighed.rotations_deg[i] - rotation_deg))
    goal = polar(curve[chosen], azimuth_deg[chosen])
    parts.append(svg.line(CENTRE, polar(RIM, azimuth_deg[chosen]), "chosen"))
    parts.append(svg.circle(goal, _STOP_PX, "stop last", svg.title(_words(weighed, chosen, azimuth_deg[chosen]))))
    for k, seen in enumerate(seen_deg):
        words = svg.title(f"view {k + 1} at {azimuth_words(seen)}°")
        parts.append(svg.circle(polar(RIM, seen), _STOP_PX, "stop", words))
        x, y = polar(RIM, seen)
        parts.append(svg.text(str(k + 1), (x, y + 4), "stop-number"))
    side = "left" if rotation_deg >= 0 else "right"
    chosen_words = f"{side} {abs(rotation_deg):.0f}°, to {azimuth_words(azimuth_deg[chosen])}°"
    why, numbers = _reasons(weighed, chosen, reason, candidates)
    columns = ([(f"view {number} → {number + 1}", "small"), (chosen_words, "step-name"), *why], numbers)
    listed = [
        svg.text(words, (4 + _COLUMN * column, _LIST_TOP + _ROW * row), class_, anchor="start")
        for column, lines in enumerate(columns)
        for row, (words, class_) in enumerate(lines)
    ]
    label = f"Decision after view {number}: " + ", ".join(words for words, _ in [*columns[0][1:], *numbers])
    height = _LIST_TOP + _ROW * max(map(len, columns))
    return svg.drawing(SIZE, height, label, [*parts, *listed])


_ALONE: Final = {
    RotationReason.NEW_SIDE: ("only one object is likely:", "a new side improves its pose"),
    RotationReason.SEVERAL_POSES: ("the leading candidate", "fits in several poses:", "a new side improves its pose"),
}

_Lines = list[tuple[str, str]]
"""Lines of text with their classes."""


def _reasons(weighed: Weighed, chosen: int, reason: RotationReason, candidates: Sequence[str]) -> tuple[_Lines, _Lines]:
    """Return lines of text with the purpose of the rotation and the numbers for it."""
    cost = [("cost of the motion", "small"), (f"{weighed.cost[chosen]:.2f}, at most {max(weighed.cost):.2f}", "small")]
    if len(candidates) < 2:
        return [(words, "small") for words in _ALONE.get(reason, ())], cost
    left, worst = (percent_words(min(1.0, exp(value))) for value in (weighed.confusion[chosen], max(weighed.confusion)))
    why = [
        ("separates", "small"),
        (short(candidates[0], _LETTERS), "step-name"),
        ("and", "small"),
        (short(candidates[1], _LETTERS), "step-name"),
    ]
    numbers = []
    if weighed.similarity is not None:
        least, most = min(weighed.similarity), max(weighed.similarity)
        numbers = [
            (f"similarity there {weighed.similarity[chosen]:.2f}", "small"),
            (f"({least:.2f} to {most:.2f} all around)", "small"),
        ]
    numbers += [
        ("chance of confusion left", "small"),
        (f"{left} there, {worst} at worst", "small"),
    ]
    return why, [*numbers, *cost]


def _words(weighed: Weighed, i: int, azimuth_deg: float) -> str:
    similarity = "" if weighed.similarity is None else f"; similarity of the candidates {weighed.similarity[i]:.2f}"
    words = "to {}°: log confusion {:.2f}, motion {:.2f}{}"
    return filled(words, azimuth_words(azimuth_deg), weighed.confusion[i], weighed.cost[i], similarity)


def _radii(values: Sequence[float]) -> list[float]:
    """Scale values to radii between the inner circle (smallest value) and the outer one."""
    low, high = min(values), max(values)
    span = high - low
    return [_INNER + (_OUTER - _INNER) * ((value - low) / span if span > 0 else 0.5) for value in values]


def _lengths(values: Sequence[float]) -> list[float]:
    most = max(values)
    return [(_BARS[1] - _BARS[0]) * (value / most if most > 0 else 0.0) for value in values]
