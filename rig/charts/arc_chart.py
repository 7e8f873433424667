"""The probability of the candidates along the arc of a search in motion."""

from collections.abc import Sequence

from rig.charts.xy import MEASURED, MODEL, OTHER, Axis, Chart, Series
from rig.core.phrases import percent

_COLOURS = (MEASURED, OTHER, MODEL)


def arc_chart(
    decisions: Sequence[tuple[float, dict[str, float]]],
    frames: Sequence[tuple[float, str, float]] = (),
    *,
    min_confidence: float,
    enough_at: float | None = None,
) -> Chart:
    """Return the chart of a search.

    Parameters
    ----------
    decisions
        For each decision, the rotation since the first view in degrees, and the probability of each candidate.
    frames
        For each frame, the rotation, and its best candidate with the probability.
    min_confidence
        The confidence that ends the search.
    enough_at
        Rotation at which the evidence was enough for an answer; None if it was not.
    """
    last = decisions[-1][1]
    names = sorted(last, key=lambda name: -last[name])[: len(_COLOURS)]
    series = []
    for name, colour in zip(names, _COLOURS, strict=False):
        points = {at: found.get(name, 0.0) for at, found in decisions}
        dots = Series(name, list(points), list(points.values()), colour, True, not frames)
        series.append(dots)
        if frames:
            points |= {at: probability for at, best, probability in frames if best == name}
            ordered = sorted(points.items())
            series.append(Series("", [at for at, _ in ordered], [p for _, p in ordered], colour, False, True))
    ends = [decisions[0][0], max(decisions[-1][0], decisions[0][0] + 1.0)]
    series.append(
        Series(f"{percent(min_confidence)} ends the search", ends, [min_confidence] * 2, OTHER, False, True, True)
    )
    if enough_at is not None:
        series.append(Series("enough for an answer", [enough_at] * 2, [0.0, 1.0], MODEL, False, True, True))
    return Chart(
        "Probability along the arc",
        Axis("rotation since the first view, °"),
        Axis("probability", span=(0.0, 1.0)),
        series,
    )
