"""The page about the last moves of the table: angle, rate of the platter, ringing after the stop, and load."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from rig.charts.xy import LIMIT, MODEL, Axis, Chart, Series
from rig.core.phrases import angle_words, counted, number
from rig.core.templates import environment

BEFORE_S: Final = 0.2
"""Time before the end of the servo's profile from which the ringing is drawn."""


def motion_report(moves: Sequence[Mapping[str, Any]], *, bench: str, quiet_dps: float) -> str:
    """Return the page about moves as `rig.motion.traces` stores them, the newest first."""
    shown = [
        {
            "title": f"{move['utc'][:19].replace('T', ' ')}, from {angle_words(move['from_deg'])} to "
            + (angle_words(move["to_deg"]) if move["goals"] else "nowhere"),
            "line": _line(move),
            "charts": [Markup(chart.svg()) for chart in charts(move, quiet_dps)],
        }
        for move in reversed(moves)
    ]
    return (
        environment("rig.report", "rig.charts")
        .get_template("motion.html.j2")
        .render(
            title=f"Motion of {bench}",
            date=None,
            totals=[],
            summary=f"The last {counted(len(moves), 'move')}, the newest first. If a table rings, the rate by the gyro "
            "swings about 0 after the end of the servo's profile.",
            shown=shown,
        )
    )


def charts(move: Mapping[str, Any], quiet_dps: float) -> list[Chart]:
    """Return the charts of one move."""
    time, at, rate = move["time_s"], np.array(move["gyro_s"]), np.array(move["gyro_dps"])
    if not time:
        return []
    goals = [goal for goal in move["goals"] for _ in range(2)]
    steps = [*(goal[0] for goal in goals[1:]), time[-1]]
    seconds, degrees = Axis("seconds"), Axis("°")
    lag = [
        _nan_if_none(profile) - encoder
        for profile, encoder in zip(move["profile_deg"], move["encoder_deg"], strict=True)
    ]
    drawn = [
        Chart(
            "Angle of the shaft",
            seconds,
            degrees,
            [
                Series("goal", steps, [goal[1] for goal in goals], LIMIT, dots=False, curve=True, dashed=True),
                Series("encoder", time, move["encoder_deg"]),
            ],
        ),
        Chart("Rate of the platter by the gyro", seconds, Axis("°/s"), [_rate(at, rate)]),
        Chart("Shaft behind the servo's profile", seconds, degrees, [Series("", time, lag, curve=True)]),
        Chart("Load", seconds, Axis("% of the torque"), [Series("", time, move["load_percent"], curve=True)]),
    ]
    if move["arrived_s"] is not None:
        after = at >= move["arrived_s"] - BEFORE_S
        ends = [move["arrived_s"] - BEFORE_S, max([*at[-1:].tolist(), time[-1]])]
        limits = [
            Series("" if sign > 0 else "table.quiet_dps", ends, [sign * quiet_dps] * 2, LIMIT, False, True, True)
            for sign in (1, -1)
        ]
        ringing = [_rate(at[after], rate[after]), *limits]
        drawn.insert(2, Chart("The same around the end of the profile", seconds, Axis("°/s"), ringing))
    return [chart for chart in drawn if any(np.isfinite(series.y).any() for series in chart.series)]


def _nan_if_none(value: float | None) -> float:
    return float("nan") if value is None else value


def _rate(at: Any, rate: Any) -> Series:
    return Series("", at.tolist(), rate.tolist(), MODEL, dots=False, curve=True)


def _line(move: Mapping[str, Any]) -> str:
    """Return the result of a move in words."""
    if move["settled_s"] is None:
        return "failed or interrupted"
    line = f"{number(move['settled_s'], '.2f')} s"
    if move["arrived_s"] is not None:
        line += f", at rest {number(move['settled_s'] - move['arrived_s'], '.2f')} s after the servo's profile ended"
    return line
