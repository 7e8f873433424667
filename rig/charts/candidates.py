"""The candidates of a search after each view. An object has one colour in all charts and tables of a page."""

from collections.abc import Mapping, Sequence
from math import nan
from typing import Final, NamedTuple

from rig.charts.xy import Axis, Chart, Series
from rig.core.phrases import percent, percent_words
from rig.events.events import Candidate, Ranked

SHOWN: Final = 5
"""Candidates of a chart: more lines cannot be told from each other."""
_COLOURS: Final = 8
_FAR: Final = 3.0
"""A threshold is off the scale if its distance from the scores exceeds their range by this factor."""


class Style(NamedTuple):
    """The colour of an object, a class of `chart.css`, and whether its lines are dashed."""

    colour: str
    dashed: bool


class Styles:
    """Gives each object its style in the order of the first request: eight colours, then the same ones dashed."""

    def __init__(self) -> None:
        self._styles: dict[str, Style] = {}

    def __getitem__(self, name: str) -> Style:
        place = len(self._styles)
        return self._styles.setdefault(name, Style(f"c{place % _COLOURS}", place // _COLOURS % 2 == 1))


def candidates_chart(
    ranked: Sequence[Ranked],
    styles: Styles,
    *,
    answer: str | None = None,
    min_score: float | None = None,
    rotated_deg: Mapping[int, float] | None = None,
    enough_deg: float | None = None,
) -> Chart:
    """Return the chart of the best five candidates of the last view: their probabilities, or their scores without them.

    Parameters
    ----------
    ranked
        The candidates after each view; at least one view.
    styles
        The styles of the page.
    answer
        The object that was found; its line is thick.
    min_score
        An object with a lower score is unknown: a dashed line, without it if it is far from the scores.
    rotated_deg
        For each view of a search in motion, the rotation since the first view.
    enough_deg
        The rotation after which the evidence was enough for an answer; None if it was not.
    """
    has_probability = ranked[-1].candidates[0].probability is not None
    names = [one.name for one in sorted(ranked[-1].candidates, key=_value, reverse=True)[:SHOWN]]
    values = [{one.name: _value(one) for one in event.candidates} for event in ranked]
    x = [event.index + 1.0 if rotated_deg is None else rotated_deg[event.index] for event in ranked]
    series = []
    for name in names:
        words = percent_words(values[-1][name]) if has_probability else f"{values[-1][name]:.3f}"
        points = [after.get(name, nan) for after in values]
        colour, dashed = styles[name]
        series.append(Series(f"{name} {words}", x, points, colour, True, True, dashed, bold=name == answer))
    ends = [x[0], max(x[-1], x[0] + 1.0)]
    series += _threshold(ranked, values, names, ends, min_score)
    if enough_deg is not None:
        series.append(Series("enough for an answer", [enough_deg] * 2, [0.0, 1.0], "ink", False, True, True))
    if rotated_deg is None:
        across = Axis("views taken", whole=True)
    else:
        across = Axis("rotation since the first view, °", span=(0.0,))
    if has_probability:
        ticks = tuple(k / 4 for k in range(5))
        upwards = Axis("probability among the enrolled objects", ticks=ticks, names=tuple(percent(t, 0) for t in ticks))
    else:
        upwards = Axis("score per view")
    return Chart("The leading candidates", across, upwards, series)


def _value(one: Candidate) -> float:
    return one.score if one.probability is None else one.probability


def _threshold(
    ranked: Sequence[Ranked],
    values: Sequence[Mapping[str, float]],
    names: Sequence[str],
    ends: Sequence[float],
    min_score: float | None,
) -> list[Series]:
    """Return the line at which a search ends, or below which an object is unknown."""
    if ranked[-1].decision is not None:
        least = ranked[-1].decision.min_confidence
        return [Series(f"{percent(least)} ends the search", ends, [least] * 2, "limit", False, True, True)]
    if min_score is None:
        return []
    shown = [after[name] for after in values for name in names if name in after]
    reach = _FAR * (max(shown) - min(shown))
    near = min(shown) - reach <= min_score <= max(shown) + reach
    line = [min_score] * 2 if near else [nan] * 2
    return [Series(f"below {min_score:.3g} is unknown", ends, line, "limit", False, True, True)]
