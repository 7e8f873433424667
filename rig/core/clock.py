"""The clock of a bench: the only module that asks the operating system for the time."""

import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Protocol


class Clock(Protocol):
    """The time of a bench; injected into all code that waits or needs the time."""

    def now_ns(self) -> int:
        """Return monotonic time in nanoseconds; only differences have a meaning."""

    def sleep(self, seconds: float) -> None:
        """Wait for ``seconds``; zero and negative values return at once."""

    def utc(self) -> datetime:
        """Return the civil time, for records that people read."""

    def every(self, seconds: float, action: Callable[[], None]) -> Callable[[], None]:
        """Call ``action`` about every ``seconds`` in the background, until the returned function is called.

        ``action`` may run in another thread: it must not raise, and must lock the data that it shares.
        """


class SystemClock:
    """The computer's own monotonic clock."""

    def now_ns(self) -> int:
        return time.monotonic_ns()  # noqa: TID251 - this is the clock that is injected elsewhere

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            time.sleep(seconds)  # noqa: TID251

    def utc(self) -> datetime:
        return datetime.now(UTC)  # noqa: TID251

    def every(self, seconds: float, action: Callable[[], None]) -> Callable[[], None]:
        over = threading.Event()

        def run() -> None:
            while not over.wait(seconds):
                action()

        thread = threading.Thread(target=run, daemon=True)
        thread.start()

        def cancel() -> None:
            over.set()
            if thread is not threading.current_thread():
                thread.join()

        return cancel


def seconds_between(start_ns: int, end_ns: int) -> float:
    """Return ``end_ns - start_ns`` in seconds."""
    return (end_ns - start_ns) * 1e-9
