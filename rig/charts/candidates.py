"""The candidates of a search after each view. An object has one colour in all charts and tables of a page."""

from collections.abc import Mapping, Sequence
from math import inf, isfinite, nan
from typing import Final, NamedTuple

from rig.charts.xy import Axis, Chart, Series
from rig.core.phrases import percent, percent_words, short
from rig.events.events import Candidate, Ranked
from rig.events.wording import NOT_ENROLLED

SHOWN: Final = 5
"""Candidates of a chart: more lines cannot be told from each other."""
_COLOURS: Final = 8  # more colours cannot be told from each other, also by people who see fewer; later ones are dashed
_LETTERS: Final = 36
"""Letters of a name; the tables of a page have all of them."""
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
        if name == NOT_ENROLLED:
            return Style("none", dashed=False)
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
    """Return the chart of the best five candidates: their probabilities, or their scores without them, after each view.

    In the dense search, "not enrolled" is one more. There is at least one view. The line of the ``answer`` is thick. An
    object with a score below ``min_score`` is unknown: a dashed line, left out if it is far from the scores. In motion,
    ``rotated_deg`` is the rotation since the first view, by view, and ``enough_deg`` that after which the evidence was
    enough for an answer.
    """
    values = [{one.name: _value(one) for one in _all(event)} for event in ranked]
    x = [event.index + 1.0 if rotated_deg is None else rotated_deg[event.index] for event in ranked]
    series = []
    best = _best(ranked[-1])
    for one in best:
        points = [after.get(one.name, nan) for after in values]
        colour, dashed = styles[one.name]
        label = f"{short(one.name, _LETTERS)} {_words(one)}"
        series.append(Series(label, x, points, colour, True, True, dashed, bold=one.name == answer))
    words, least = _threshold(ranked[-1], min_score)
    if least is not None:
        shown = [value for one in series for value in one.y if isfinite(value)]
        reach = inf if best[0].probability is not None else _FAR * (max(shown) - min(shown))
        near = min(shown) - reach <= least <= max(shown) + reach
        series.append(Series(words, [x[0], x[-1]], [least if near else nan] * 2, "limit", False, True, True))
    if enough_deg is not None:
        series.append(Series("enough for an answer", [enough_deg] * 2, [0.0, 1.0], "ink", False, True, True))
    across = Axis("views taken", whole=True)
    if rotated_deg is not None:
        across = Axis("rotation since the first view, °", span=(0.0,))
    upwards = Axis("score per view")
    if best[0].probability is not None:
        ticks = tuple(k / 4 for k in range(5))
        upwards = Axis("probability", ticks=ticks, names=tuple(percent(t, 0) for t in ticks))
    return Chart("The leading candidates", across, upwards, series)


def _best(ranked: Ranked) -> list[Candidate]:
    return sorted(ranked.candidates, key=_value, reverse=True)[:SHOWN] + _all(ranked)[len(ranked.candidates) :]


def _all(ranked: Ranked) -> list[Candidate]:
    """Return the candidates, and with probabilities "not enrolled" as the last one."""
    if ranked.decision is None:
        return [*ranked.candidates]
    return [*ranked.candidates, Candidate(NOT_ENROLLED, nan, nan, ranked.decision.not_enrolled)]


def _value(one: Candidate) -> float:
    return one.score if one.probability is None else one.probability


def _words(one: Candidate) -> str:
    return f"{one.score:.3f}" if one.probability is None else percent_words(one.probability)


def _threshold(ranked: Ranked, min_score: float | None) -> tuple[str, float | None]:
    """Return the value at which a search ends, or below which an object is unknown, and its words."""
    if ranked.decision is not None:
        least = ranked.decision.min_confidence
        return f"an object with {percent(least)} ends the search", least
    return (f"below {min_score:.3g} is unknown", min_score) if min_score is not None else ("", None)
