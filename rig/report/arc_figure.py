"""The figure of a search in motion: the probability along the arc, and the time at which the evidence was enough."""

from typing import NamedTuple

from markupsafe import Markup

from hbr import Outcome
from hbr.core.angles import wrap180
from rig.charts.arc_chart import arc_chart
from rig.core.phrases import azimuth_words, counted
from rig.events.events import FrameUsed
from rig.report.records import IdentificationRecord


class ArcFigure(NamedTuple):
    """A chart and its text; both are empty for a search at rest."""

    chart: Markup = Markup()
    words: str = ""


def arc_figure(record: IdentificationRecord) -> ArcFigure:
    """Return the figure of a search."""
    rotated_deg, last_deg, rotated = 0.0, None, {}
    for view in record.views:
        if last_deg is not None:
            rotated_deg += abs(wrap180(view.azimuth_deg - last_deg))
        last_deg = view.azimuth_deg
        rotated[view.index] = rotated_deg
    decisions = [
        (rotated[ranked.index], {c.name: c.probability or 0.0 for c in ranked.candidates})
        for ranked in record.ranked
        if ranked.index in rotated
    ]
    confidence = next((ranked.decision.min_confidence for ranked in record.ranked if ranked.decision), None)
    if confidence is None or len(decisions) < 2 or all(view.evidence.motion is None for view in record.views):
        return ArcFigure()
    frames = [used for used in record.used if used.index in rotated]
    enough = next((used for used in frames if used.outcome is not Outcome.CONTINUE), None)
    chart = arc_chart(
        decisions,
        [(rotated[used.index], used.name, used.probability) for used in frames],
        min_confidence=confidence,
        enough_at=None if enough is None else rotated[enough.index],
    )
    return ArcFigure(Markup(chart.svg(themed=True)), _words(frames, enough, rotated))


def _words(frames: list[FrameUsed], enough: FrameUsed | None, rotated: dict[int, float]) -> str:
    """Return which frames were used, and when they were enough; empty for runs that do not contain this."""
    if not frames:
        return ""
    last = frames[-1]
    used = f"{counted(len(frames), 'frame')} of the rotation used (views {frames[0].index + 1} to {last.index + 1})"
    used += f", {last.rejected} rejected."
    if enough is None:
        return f"{used} Their evidence was not enough for an answer before the search ended."
    when = f"{enough.seconds:.1f} s after the start"
    where = f"azimuth {azimuth_words(enough.azimuth_deg)}°, after {rotated[enough.index]:.0f}° of rotation"
    return (
        f"{used} The evidence was enough for an answer from view {enough.index + 1} on: {when}, at {where}. "
        f"The last frame came after {last.seconds:.1f} s."
    )
