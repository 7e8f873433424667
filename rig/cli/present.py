"""How the events of a plan read on a terminal."""

import sys
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress

from rig.plans.events import Accepted, Decided, Enrolled, Event, Identified, Moved, Ranked, Rejected, Started

SHOWN = 3


def sentence(event: Event) -> str:
    """Return what an event means to the person at the bench; empty where there is nothing to say."""
    match event:
        case Started():
            return ""
        case Moved():
            return _moved(event)
        case Rejected():
            return f"view {event.index + 1}, attempt {event.attempt}: not taken, {'; '.join(event.reasons)}"
        case Accepted():
            return f"view {event.index + 1} at {event.azimuth_deg:.1f}°"
        case Ranked():
            leaders = ", ".join(f"{c.name} {c.score:.3f}" for c in event.candidates[:SHOWN])
            return f"  leading: {leaders} (margin {event.margin:.3f})"
        case Decided():
            return f"  {_decided(event)}"
        case Enrolled():
            retakes = f", {event.retakes} retaken" if event.retakes else ""
            return f"{event.name}: {event.views} views enrolled in {event.seconds:.0f} s{retakes}"
        case Identified():
            return _identified(event)


def _moved(event: Moved) -> str:
    text = f"  table at {event.encoder_deg:.2f}° (asked {event.commanded_deg:.2f}°), turned: encoder "
    text += f"{event.rotation_encoder_deg:+.2f}°"
    if event.rotation_imu_deg is None:
        text += ", IMU has no answer"
    else:
        text += f", IMU {event.rotation_imu_deg:+.2f} ± {event.imu_sigma_deg:.2f}°"
    return text if event.agrees else f"{text}: THEY DISAGREE by more than {event.bound_deg:.2f}°; the IMU is believed"


def _decided(event: Decided) -> str:
    if event.s_left is None or event.s_right is None:
        why = "a second view is needed"
    else:
        sign = "≤" if event.side == "left" else ">"
        why = (
            f"{event.side}: the {len(event.rivals)} leading candidates look less alike there, "
            f"S_left {event.s_left:.2f} {sign} S_right {event.s_right:.2f}"
        )
    return f"{why}; camera {event.rotation_deg:+.1f}° around the object, table to {event.target_deg:.1f}°"


def _identified(event: Identified) -> str:
    work = f"{event.views} views, {event.travelled_deg:.0f}° travelled, {event.seconds:.1f} s; {event.reason}"
    nearest = ", ".join(f"{c.name} {c.score:.3f}" for c in event.candidates[:SHOWN])
    if event.name is None:
        return f"unknown: nearest are {nearest} ({work})"
    answer = f"{event.name}: stands turned by {event.yaw_deg:.0f}°"
    return f"{answer}, score {event.score:.3f}, margin {event.margin:.3f} ({work})"


class Progress:
    """A progress bar on stderr; where that is no terminal, notes alone."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._bar = RichProgress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            disable=not sys.stderr.isatty(),
        )
        self._task = self._bar.add_task(title, total=None, start=False)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._bar.stop()

    def start(self, total: int) -> None:
        self._bar.start_task(self._task)
        self._bar.update(self._task, total=total)

    def advance(self) -> None:
        self._bar.advance(self._task)

    def note(self, text: str) -> None:
        self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)
