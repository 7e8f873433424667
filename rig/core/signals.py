"""Signals that end the program. They unwind the stack once, and do not interrupt a clean-up that has begun.

Decision: docs/decisions/0003.
"""

import atexit
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

from rig.core.clock import SystemClock

EXIT_BY_SIGNAL: Final = 128
"""Plus the number of the signal: the exit code of a program that a signal ended, as in shells."""
AGAIN_S: Final = 0.001
"""Time after which a signal comes again that Python has dropped, because it came in a callback such as `__del__`."""
HOLD_S: Final = 2.0
"""How long signals wait for a clean-up, and for the stack to unwind. Then the next signal interrupts again."""

ENDING: Final = tuple(
    signal.Signals[name]
    for name in (
        *("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGABRT", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGVTALRM"),
        *("SIGPROF", "SIGXCPU", "SIGPOLL", "SIGPWR", "SIGSTKFLT", "SIGSYS", "SIGTRAP"),
    )
    if name in signal.Signals.__members__
)
"""Signals that end a program by default, and that a program can handle."""

_ALWAYS: Final = (signal.SIGINT, signal.SIGQUIT)


@dataclass(slots=True)
class _State:
    depth: int = 0
    held_ns: int = 0
    waiting: int | None = None
    raised_ns: int | None = None
    raised: int = 0
    dropping: bool = False
    """Whether Python drops exceptions now, because `_raise_again` runs."""
    report_dropped: Callable[["sys.UnraisableHookArgs"], None] = sys.__unraisablehook__


_state = _State()
_clock = SystemClock()


def handle_signals() -> None:
    """Have each signal in `ENDING` unwind the stack, so that every open device is closed (torque off).

    SIGINT and SIGQUIT are handled in any case, because a stop must reach a moving table: a shell without job control
    starts background jobs with both ignored, and their children inherit that. Other ignored signals stay ignored, such
    as SIGHUP, which `nohup` ignores.
    """
    _state.raised_ns = None
    if sys.unraisablehook is not _raise_again:
        _state.report_dropped, sys.unraisablehook = sys.unraisablehook, _raise_again
    atexit.register(_ignore_signals)  # a second registration has no further effect
    for number in ENDING:
        if number in _ALWAYS or signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _end)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Let signals wait until the end of a ``with`` block, but at most `HOLD_S`: the block stops the table.

    Signals that `handle_signals` handles wait, and Ctrl+C in a program that does not call it.
    """
    if threading.current_thread() is not threading.main_thread():  # signals interrupt only the main thread
        yield
        return
    swapped = _state.depth == 0 and signal.getsignal(signal.SIGINT) is _python_default
    if _state.depth == 0:
        _state.held_ns = _clock.now_ns()
    _state.depth += 1
    try:
        if swapped:
            signal.signal(signal.SIGINT, _end)
        yield
    finally:
        _state.depth -= 1
        if swapped:
            signal.signal(signal.SIGINT, _python_default)
        if _state.depth == 0 and (number := _state.waiting) is not None:
            _state.waiting = None
            _raise(number)


_python_default = signal.default_int_handler


def _ignore_signals() -> None:
    """Ignore more signals while the interpreter ends: they would replace the exit code of the first one."""
    for number in ENDING:
        if signal.getsignal(number) is _end:
            signal.signal(number, signal.SIG_IGN)


def _end(number: int, _frame: object) -> None:
    now_ns = _clock.now_ns()
    if _state.dropping:
        return  # Python would drop this one, too; it comes again
    if _state.depth and now_ns - _state.held_ns < HOLD_S * 1e9:
        _state.waiting = _state.waiting or number
    elif _state.raised_ns is None or now_ns - _state.raised_ns >= HOLD_S * 1e9:
        _raise(number)
    # else the stack unwinds already


def _raise_again(dropped: "sys.UnraisableHookArgs") -> None:
    """Send a signal again whose exception Python has dropped; otherwise the program would continue."""
    if _state.raised_ns is not None and isinstance(dropped.exc_value, KeyboardInterrupt | SystemExit):
        _state.raised_ns, _state.dropping = None, True
        try:
            threading.Thread(target=_send_again, daemon=True).start()
        finally:
            _state.dropping = False
    else:
        _state.report_dropped(dropped)


def _send_again() -> None:
    main_thread = threading.main_thread().ident
    assert main_thread is not None
    while _state.raised_ns is None:  # until the handler has raised it
        _clock.sleep(AGAIN_S)
        signal.pthread_kill(main_thread, _state.raised)


def _raise(number: int) -> None:
    _state.raised_ns, _state.raised = _clock.now_ns(), number
    raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(EXIT_BY_SIGNAL + number)
