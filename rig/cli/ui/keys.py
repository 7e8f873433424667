"""Pause a plan between two views: with a key on the terminal, or with Ctrl+Z (SIGTSTP)."""

import os
import select
import signal
import sys
import termios
import tty
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from types import FrameType, TracebackType
from typing import Any, Final, Self

PAUSE_KEYS: Final = b"p "
HINT: Final = "p: pause"
WAIT_S: Final = 0.1
"""Longest wait for a key: Python handles a signal that came just before a wait only after it."""


def read_keys(wait_s: float) -> bytes | None:
    """Return keys that are pressed within a time: none if it ends, and None if the terminal is gone."""
    if not select.select([sys.stdin], [], [], wait_s)[0]:
        return b""
    try:
        return os.read(sys.stdin.fileno(), 64) or None
    except OSError:
        return None


class Pause(AbstractContextManager["Pause"]):
    """Watches for a request to pause, in a ``with`` block.

    The owner of the plan calls `point` where the plan can pause. With ``keys``, p or the space bar pauses and resumes.
    Ctrl+Z (SIGTSTP) stops the process at the next point; `fg` (SIGCONT) resumes it.
    """

    def __init__(self, *, keys: bool) -> None:
        self._keys = keys and sys.stdin is not None and sys.stdin.isatty()
        self._asked = False
        self._suspend = False
        self._terminal: list[Any] | None = None
        self._before: Any = None

    def __enter__(self) -> Self:
        if signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL:  # a shell without job control ignores it
            self._before = signal.signal(signal.SIGTSTP, self._on_stop)
        self._listen()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._release()
        if self._before is not None:
            signal.signal(signal.SIGTSTP, self._before)
            self._before = None

    @property
    def listens(self) -> bool:
        """Whether the pause keys work."""
        return self._terminal is not None

    def point(self, show: Callable[[str], None]) -> None:
        """Pause here if the operator asked for it; the table holds its angle.

        ``show`` gets the words for the state: how to resume, and an empty text when the pause is over.
        """
        if self._suspend:
            self._suspend = False
            show("Paused. To resume: fg (or SIGCONT).")
            self._release()
            os.kill(os.getpid(), signal.SIGSTOP)
            self._listen()
            show("")
        if self._pressed():
            show("Paused. The table holds its angle. p: resume, Ctrl+C: stop")
            try:
                while self._terminal is not None and not self._pressed():
                    select.select([sys.stdin], [], [], WAIT_S)
            finally:
                show("")

    def _pressed(self) -> bool:
        pressed = b""
        while self._terminal is not None and (keys := read_keys(0.0)) != b"":
            if keys is None:
                self._terminal = None
            else:
                pressed += keys
        return any(key in pressed for key in PAUSE_KEYS)

    def _on_stop(self, _number: int, _frame: FrameType | None) -> None:
        self._suspend = True

    def _listen(self) -> None:
        if self._keys:
            with suppress(termios.error):  # not a terminal after all
                self._terminal = termios.tcgetattr(sys.stdin)
                tty.setcbreak(sys.stdin)

    def _release(self) -> None:
        if self._terminal is not None:
            with suppress(termios.error):
                termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._terminal)
            self._terminal = None
