"""Chart of a search: the score of each leading candidate after each view."""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from math import ceil, floor, inf
from typing import Final

from rig.charts import svg
from rig.charts.svg import Point

_WIDTH: Final = 400.0
_HEIGHT: Final = 290.0
_LEFT, _TOP, _RIGHT, _BOTTOM = 44.0, 22.0, 226.0, 244.0
_NAME_X: Final = _RIGHT + 28
_LINE_HEIGHT: Final = 16.0
_NAME_LETTERS: Final = 12
_CANDIDATES: Final = 5
_TICK_PX: Final = 18.0
"""Room for the number of a view."""
_FAR: Final = 3.0
"""A threshold is off the scale if its distance from the scores exceeds their range by this factor."""
_STEPS: Final = [digit * 10.0**power for power in range(-3, 308) for digit in (1, 2, 5)][2:]
"""From 0.005: a damaged run may hold a score of any size."""


def score_chart(
    rounds: Sequence[Mapping[str, float]],
    *,
    winner: str | None = None,
    truth: str | None = None,
    min_score: float | None = None,
) -> str:
    """Draw the score per view of the leading candidates after each view; names are at the ends of the lines.

    The candidates are the best five of the last round.

    Parameters
    ----------
    rounds
        The scores of the leading candidates after each view, by name.
    winner
        The answer; its line is thick.
    truth
        The object on the table; its name has a mark.
    min_score
        An object with a lower score is unknown. The line is dashed, and named beside the plot; without a line if it is
        far from the scores.

    Returns
    -------
    SVG markup. A line has a gap after views at which its candidate was not among the leading ones.

    Raises
    ------
    ValueError
        There is no round, or one without candidates.
    """
    if not rounds or not all(rounds):
        raise ValueError("a score chart needs at least one round, and a candidate in each")
    names = sorted(rounds[-1], key=lambda name: -rounds[-1][name])[:_CANDIDATES]
    shown = [scores[name] for scores in rounds for name in names if name in scores]
    ticks = _ticks(shown, min_score, several=len(names) > 1)
    low, high = ticks[0], ticks[-1]

    def at(view: int, score: float) -> Point:
        share = view / (len(rounds) - 1) if len(rounds) > 1 else 0.5
        return (_LEFT + 14 + (_RIGHT - _LEFT - 28) * share, _BOTTOM - (_BOTTOM - _TOP) * (score - low) / (high - low))

    parts = [svg.text("score per view", (2, 11), "small", anchor="start")]
    for tick in ticks:
        y = at(0, tick)[1]
        parts.append(svg.line((_LEFT, y), (_RIGHT, y), "grid"))
        parts.append(
            svg.text(
                f"{tick:.3f}" if ticks[1] - low < 0.009 else f"{tick:.2f}", (_LEFT - 6, y + 4), "axis", anchor="end"
            )
        )
    every = ceil(_TICK_PX * len(rounds) / (_RIGHT - _LEFT))
    parts += [svg.text(str(v + 1), (at(v, low)[0], _BOTTOM + 18), "axis") for v in range(0, len(rounds), every)]
    parts.append(svg.text("views taken", ((_LEFT + _RIGHT) / 2, _BOTTOM + 38), "small"))
    if min_score is not None and low <= min_score <= high:
        y = at(0, min_score)[1]
        parts.append(svg.line((_LEFT, y), (_RIGHT + 8, y), "threshold"))
    for rank in reversed(range(len(names))):  # the best is drawn last, on top
        parts.extend(_line(rounds, names[rank], _class(rank, names[rank] == winner), at))
    parts.extend(_legend(rounds, names, winner, truth, min_score, (low, high), at))
    finals = ", ".join(f"{name} {rounds[-1][name]:.3f}" for name in names)
    label = f"Scores per view of the leading candidates after {len(rounds)} views: {finals}"
    return svg.drawing(_WIDTH, _HEIGHT, label, parts)


def _ticks(values: Sequence[float], min_score: float | None, *, several: bool) -> list[float]:
    """Return three to seven round numbers that span ``values`` and ``min_score``.

    The span excludes a threshold that is far away: otherwise the lines of several candidates, which may differ in the
    third decimal, would coincide.
    """
    low, high = min(values), max(values)
    if min_score is not None:
        reach = _FAR * (high - low) if several else inf
        if low - reach <= min_score <= high + reach:
            low, high = min(low, min_score), max(high, min_score)
    for step in _STEPS:
        first, last = floor(low / step + 1e-9), ceil(high / step - 1e-9)
        if last - first <= 6 and step > 1e-9 * max(abs(low), abs(high)):  # below, neighbouring numbers would be equal
            break
    return [step * i for i in range(min(first, last - 2), last + 1)]


def _class(rank: int, wins: bool) -> str:
    return f"candidate c{rank}{' winner' if wins else ''}"


def _line(
    rounds: Sequence[Mapping[str, float]], name: str, class_: str, at: Callable[[int, float], Point]
) -> list[str]:
    points = [at(view, scores[name]) if name in scores else None for view, scores in enumerate(rounds)]
    parts = [svg.line(a, b, class_) for a, b in pairwise(points) if a and b]
    for view, point in enumerate(points):
        if point:
            words = f"{name} after view {view + 1}: {rounds[view][name]:.3f}"
            parts.append(svg.circle(point, 4 if "winner" in class_ else 3, f"{class_} dot", svg.title(words)))
    return parts


def _legend(
    rounds: Sequence[Mapping[str, float]],
    names: Sequence[str],
    winner: str | None,
    truth: str | None,
    min_score: float | None,
    span: tuple[float, float],
    at: Callable[[int, float], Point],
) -> list[str]:
    """Draw names and last scores beside the plot, best first, each connected with the end of its line."""
    ends = [at(len(rounds) - 1, rounds[-1][name]) for name in names]
    parts = []
    if min_score is None:
        rows = _spread([y for _, y in ends])
    else:  # the threshold has a row among the names, so that no line is drawn over its label
        low, high = span
        y = at(0, min(max(min_score, low), high))[1]
        place = sum(end[1] <= y for end in ends)
        rows = _spread([*(end[1] for end in ends[:place]), y, *(end[1] for end in ends[place:])])
        row = rows.pop(place)
        arrow, where = (" ↓", ", below the scale") if min_score < low else (" ↑", ", above the scale")
        if low <= min_score <= high:
            arrow = where = ""
            parts.append(svg.path([(_RIGHT + 8, y), (_NAME_X - 5, row)], "threshold leader"))
        words = f"threshold {round(min_score, 3):g}"
        label = svg.text(f"{words}{arrow}", (_NAME_X, row + 4), "threshold-label", anchor="start")
        parts.append(svg.element("g", svg.title(f"{words}{where}"), label))
    for rank, (name, end, y) in enumerate(zip(names, ends, rows, strict=True)):
        class_ = _class(rank, name == winner)
        parts.append(svg.path([(end[0] + 5, end[1]), (_RIGHT + 8, end[1]), (_NAME_X - 5, y)], f"{class_} leader"))
        short = name if len(name) <= _NAME_LETTERS else f"{name[: _NAME_LETTERS - 1]}…"
        mark = " ●" if name == truth else ""
        words = f"{rounds[-1][name]:.3f} {short}{mark}"
        parts.append(
            svg.element("g", svg.title(name), svg.text(words, (_NAME_X, y + 4), f"{class_} name", anchor="start"))
        )
    if truth in names:
        parts.append(svg.text("● on the table", (_NAME_X, _BOTTOM + 38), "small", anchor="start"))
    return parts


def _spread(wanted: Sequence[float]) -> list[float]:
    """Return rows close to the ``wanted`` ones (ascending), at least one line apart, within the plot."""
    rows: list[float] = []
    for y in wanted:
        rows.append(max(y, rows[-1] + _LINE_HEIGHT) if rows else max(y, _TOP))
    for i in reversed(range(len(rows))):
        limit = _BOTTOM if i == len(rows) - 1 else rows[i + 1] - _LINE_HEIGHT
        rows[i] = min(rows[i], limit)
    return rows
