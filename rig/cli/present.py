"""How the events of a plan read on a terminal."""

import sys
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress

from rig.plans.events import Accepted, Decided, Enrolled, Event, Identified, Moved, Ranked, Rejected, Started, Unwinding
from rig.plans.words import (
    answer_words,
    azimuth_words,
    counted,
    decision_words,
    move_words,
    signed,
    unwinding_words,
)

SHOWN = 3


def line(event: Event) -> str:
    """Return what an event means to the person at the bench; empty where there is nothing to say."""
    match event:
        case Started():
            return ""
        case Moved():
            return f"  at {event.encoder_deg:.2f}° (asked {event.commanded_deg:.2f}°): {move_words(event)}"
        case Unwinding():
            return f"  {unwinding_words(event)}"
        case Rejected():
            return f"view {event.index + 1}, attempt {event.attempt}: not taken, {'; '.join(event.reasons)}"
        case Accepted():
            return f"view {event.index + 1}, azimuth {azimuth_words(event.azimuth_deg)}°"
        case Ranked():
            leaders = ", ".join(f"{c.name} {c.score:.3f}" for c in event.candidates[:SHOWN])
            return f"  leading: {leaders} (sure lead {signed(event.margin, 3)})"
        case Decided():
            return f"  {decision_words(event)} The table goes to {event.target_deg:.1f}°."
        case Enrolled():
            retakes = f", {counted(event.retakes, 'frame')} taken again" if event.retakes else ""
            return f"{event.name}: {counted(event.views, 'view')} enrolled in {event.seconds:.0f} s{retakes}"
        case Identified():
            return (
                f"{answer_words(event)}\n  score {event.score:.3f} a view (unknown below {event.min_score:.3f}), "
                f"{counted(event.views, 'view')}, {event.travelled_deg:.0f}° travelled, {event.seconds:.1f} s"
            )


class Progress:
    """A progress bar on stderr; where that is no terminal, notes alone."""

    def __init__(self, title: str) -> None:
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
