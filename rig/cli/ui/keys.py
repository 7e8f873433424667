"""Pause and go on: a key on a terminal, Ctrl+Z or SIGTSTP anywhere; never in the middle of a motion."""

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
HINT: Final = "p pauses"


class Pause(AbstractContextManager["Pause"]):
    """Watches for the wish to pause, in a ``with`` block; whoever runs a plan calls `point` where it may rest.

    With ``keys``, p or the space bar on the terminal pause and go on. Ctrl+Z, or SIGTSTP from elsewhere, stops the
    process at the next point; `fg` or SIGCONT goes on.
    """

    def __init__(self, *, keys: bool) -> None:
        self._keys = keys and sys.stdin is not None and sys.stdin.isatty()
        self._asked = False
        self._suspend = False
        self._terminal: list[Any] | None = None
        self._before: Any = None

    def __enter__(self) -> Self:
        if signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL:  # a shell without job control has it ignored
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
        """Whether a key pauses."""
        return self._terminal is not None

    def point(self, tell: Callable[[str], None]) -> None:
        """Rest here as long as somebody wants; the table holds its place meanwhile. ``tell`` shows a line."""
        if self._suspend:
            self._suspend = False
            tell("Paused: fg (or SIGCONT) goes on.")
            self._release()
            os.kill(os.getpid(), signal.SIGSTOP)
            self._listen()
            tell("Going on.")
        if self._pressed():
            tell("Paused, the table holds its place: p goes on, Ctrl+C stops and keeps the views.")
            while os.read(sys.stdin.fileno(), 1) not in (bytes([key]) for key in PAUSE_KEYS):
                pass
            tell("Going on.")

    def _pressed(self) -> bool:
        if self._terminal is None:
            return False
        pressed = b""
        while select.select([sys.stdin], [], [], 0)[0]:
            key = os.read(sys.stdin.fileno(), 64)
            if not key:  # the terminal is gone
                self._terminal = None
                break
            pressed += key
        return any(key in pressed for key in PAUSE_KEYS)

    def _on_stop(self, _number: int, _frame: FrameType | None) -> None:
        self._suspend = True

    def _listen(self) -> None:
        if self._keys:
            with suppress(termios.error):  # it is no terminal after all
                self._terminal = termios.tcgetattr(sys.stdin)
                tty.setcbreak(sys.stdin)

    def _release(self) -> None:
        if self._terminal is not None:
            with suppress(termios.error):
                termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._terminal)
            self._terminal = None
