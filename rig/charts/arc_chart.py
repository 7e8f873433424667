"""The probability of the candidates along the arc of a search in motion."""

from collections.abc import Sequence

from rig.charts.xy import MEASURED, MODEL, OTHER, Axis, Chart, Series

_COLOURS = (MEASURED, OTHER, MODEL)


def arc_chart(decisions: Sequence[tuple[float, dict[str, float]]], *, min_confidence: float) -> Chart:
    """Return the chart of a search.

    Parameters
    ----------
    decisions
        For each decision, the rotation since the first view in degrees, and the probability of each candidate.
    min_confidence
        The confidence that ends the search.
    """
    last = decisions[-1][1]
    names = sorted(last, key=lambda name: -last[name])[: len(_COLOURS)]
    series = [
        Series(name, [at for at, _ in decisions], [found.get(name, 0.0) for _, found in decisions], colour, True, True)
        for name, colour in zip(names, _COLOURS, strict=False)
    ]
    ends = [decisions[0][0], max(decisions[-1][0], decisions[0][0] + 1.0)]
    limit = Series(f"{min_confidence:.1%} ends the search", ends, [min_confidence] * 2, OTHER, False, True, True)
    return Chart(
        "Probability along the arc",
        Axis("rotation since the first view, °"),
        Axis("probability", span=(0.0, 1.0)),
        [*series, limit],
    )
