"""Charts of the recorded answers: how many a day, and whether views fit worse than they did."""

from collections import Counter
from collections.abc import Sequence
from datetime import date, timedelta
from math import nan
from typing import Final

from rig.charts.xy import LIMIT, MEASURED, OTHER, Axis, Chart, Series

DAYS: Final = 14  # more of them are too narrow for their dates on a phone


def answers_a_day(answers: Sequence[tuple[date, bool]], today: date) -> Chart:
    """Return the numbers of answers of the last two weeks: pairs of a day and whether the object was found."""
    days = [today - timedelta(days=back) for back in reversed(range(DAYS))]
    places = list(range(DAYS))
    every, others = Counter(day for day, _ in answers), Counter(day for day, is_found in answers if not is_found)
    ticks = tuple(map(float, places))
    names = tuple(f"{day.day}.{day.month}." for day in days)
    return Chart(
        "Answers a day",
        Axis("day", ticks=ticks, names=names),
        Axis("answers", whole=True, span=(0.0,)),
        [
            Series("all", places, [every[day] for day in days], MEASURED, curve=True),
            Series("unknown or ambiguous", places, [others[day] for day in days], OTHER, curve=True),
        ],
    )


def drift_of_scores(scores: Sequence[float | None], photographed_before: int) -> Chart:
    """Return the scores of the found objects in their order, the oldest first.

    The last empty-table image was taken after so many of them. If scores fall since then, the light or the camera has
    changed, and a new image is due.
    """
    values = [nan if score is None else score for score in scores]
    known = [value for value in values if value == value]
    series = [Series("score", range(1, len(values) + 1), values, MEASURED)]
    if 0 < photographed_before < len(values) and known:
        place = photographed_before + 0.5
        ends = [min(known), max(known)]
        series.append(Series("empty-table image", [place, place], ends, LIMIT, dots=False, curve=True, dashed=True))
    return Chart("How well views fit", Axis("found object", whole=True), Axis("score"), series)
