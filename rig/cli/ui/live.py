"""The events of a running plan on the terminal: a line for each, and a last line that says how far the plan is."""

import os
import signal
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Self

from rich.live import Live
from rich.text import Text

from rig.cli.ui.present import console
from rig.cli.ui.settings import Settings
from rig.core.phrases import counted, duration_words
from rig.events.events import (
    Accepted,
    Decided,
    Enrolled,
    Event,
    FrameUsed,
    Identified,
    Item,
    Ranked,
    Recorded,
    SimilarObjects,
    Started,
    Waiting,
    event_dict,
)
from rig.events.wording import line, ranking_words

KEYS = "Ctrl+Z: pause, Ctrl+C: stop"


class LiveView(AbstractContextManager["LiveView"]):
    """Shows the events of a plan as they come, in a ``with`` block.

    Ctrl+Z (SIGTSTP) stops the program after the next view, when the table holds its angle; `fg` (SIGCONT) resumes it.

    ``plain`` prints as into a pipe. ``left`` returns the time that is left of an enrollment
    after a number of views.
    """

    left: Callable[[int], float] | None = None

    def __init__(self, settings: Settings, *, plain: bool = False) -> None:
        self._settings = settings
        self._screen = console(stderr=settings.json, plain=plain)
        self._live: Live | None = None
        self._wants_pause = False
        self._before: Any = None
        # What the lines need of earlier events.
        self._number = self._what = self._status = self._begun = ""
        self._views = self._taken = 0
        self._ranked: Ranked | None = None
        self._similar: SimilarObjects | None = None

    def __enter__(self) -> Self:
        if signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL:  # a shell without job control ignores it
            self._before = signal.signal(signal.SIGTSTP, self._on_stop)
        return self

    def __exit__(self, *_: object) -> None:
        self.hide()
        if self._before is not None:
            signal.signal(signal.SIGTSTP, self._before)

    def add(self, event: Event) -> None:
        """Show the next event; if the operator has pressed Ctrl+Z, return when the program is resumed."""
        if self._settings.json:
            self._settings.print_json(event_dict(event))
        # in a pipe, the text on stderr would only repeat the JSON
        if self._screen.is_terminal or not self._settings.json:
            if is_end := isinstance(event, Enrolled | Identified | Waiting):
                self.hide()
            for text in filter(None, self._lines(event)):
                self._print(text)
            if self._screen.is_terminal and self._views and not is_end:
                self._show_status(event)
        if isinstance(event, Accepted) and self._wants_pause:
            self._wants_pause = False
            self.hide()
            self._print("Paused. To resume: fg (or SIGCONT).")
            os.kill(os.getpid(), signal.SIGSTOP)

    def hide(self) -> None:
        """Remove the last line until the next event, for a question or a note."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def _lines(self, event: Event) -> list[str]:
        """Return the lines about an event that stay on the screen."""
        match event:
            case Item():
                self._number = f"{event.number} of {event.of} "
            case Started():
                self._views, self._taken, self._ranked = event.views, 0, None
                before, self._begun = self._begun, line(event)
                if event.name is not None:
                    self._what = f"{self._number}{event.name}: "
                    return [f"{self._what}{counted(event.views, 'view')}{self._time(', about {}')}"]
                return [] if before == self._begun else [self._begun]  # of one search after the other, once
            case Accepted():
                self._taken += 1
                if self._ranked is not None and event.evidence.motion is not None:
                    return []  # the frame of a search has its own line
            case FrameUsed() if self._screen.is_terminal:
                return []  # dozens in a second: only the last line shows them
            case Ranked():
                self._ranked = event
            case Decided():
                return [f"  {words}" if (words := ranking_words(self._ranked)) else "", line(event)]
            case SimilarObjects():
                self._similar = event
                return []
            case Recorded():  # no part of the answer, so a replay prints the same
                print(line(event), file=sys.stderr)
                return []
            case Enrolled() if self._similar is not None:
                return [line(event), line(self._similar)]
            case _:
                pass
        return [line(event)]

    def _show_status(self, event: Event) -> None:
        """Show in the last line how far the plan is."""
        far = f"{self._what}{self._taken} of {counted(self._views, 'view')}{self._time(', {} left')}"
        self._status = line(event).strip() if isinstance(event, FrameUsed) else far
        if self._live is None:
            self._live = Live(
                console=self._screen,
                get_renderable=lambda: Text(f"{self._status}   {KEYS}", style="bold"),
                transient=True,
                redirect_stdout=False,  # Rich would interpret terminal escapes in what is printed meanwhile
                redirect_stderr=False,
            )
            self._live.start(refresh=True)

    def _time(self, words: str) -> str:
        return "" if self.left is None else words.format(duration_words(self.left(self._taken)))

    def _print(self, text: str) -> None:
        self._screen.print(text, markup=False, highlight=False, soft_wrap=not self._screen.is_terminal)

    def _on_stop(self, *_: object) -> None:
        self._wants_pause = True
