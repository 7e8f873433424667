"""Virtual time: integer nanoseconds that pass only while a program sleeps.

Decision: docs/decisions/0001.
"""

import heapq
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from itertools import count
from typing import Final

from rig.core.clock import Clock, seconds_between

EPOCH = datetime(2020, 1, 1, tzinfo=UTC)
"""Default civil time at virtual time 0; fixed, so that a run is reproducible to the byte."""


class Timer:
    """A callback that is scheduled for a virtual time; `cancel` removes it."""

    def __init__(self, callback: Callable[[], None]) -> None:
        self.callback: Callable[[], None] | None = callback

    def cancel(self) -> None:
        self.callback = None


class VirtualClock:
    """A `rig.core.clock.Clock` whose time advances when a program sleeps.

    Emulators schedule their own activity (a byte arrives, a watchdog expires) with `call_at`. A sleep runs the
    callbacks that fall due, each at its own time and those with equal times in the order of their scheduling.
    """

    def __init__(self, start_utc: datetime = EPOCH) -> None:
        self._now_ns = 0
        self._start_utc = start_utc
        self._timers: list[tuple[int, int, Timer]] = []
        self._order = count()

    def now_ns(self) -> int:
        return self._now_ns

    def utc(self) -> datetime:
        return self._start_utc + timedelta(microseconds=self._now_ns // 1000)

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            self.advance_to(self._now_ns + round(seconds * 1e9))

    def set_civil(self, seconds: float) -> None:
        """Move the civil time by ``seconds``, as a time server does; `now_ns` does not change."""
        self._start_utc += timedelta(seconds=seconds)

    def call_at(self, at_ns: int, callback: Callable[[], None]) -> Timer:
        """Schedule ``callback`` for ``at_ns``; a time in the past means the next time the clock advances."""
        timer = Timer(callback)
        heapq.heappush(self._timers, (max(at_ns, self._now_ns), next(self._order), timer))
        return timer

    def every(self, seconds: float, action: Callable[[], None]) -> Callable[[], None]:
        """Call ``action`` every ``seconds`` of virtual time, during sleeps; return the function that stops it."""
        timer: Timer
        over = False

        def tick() -> None:
            nonlocal timer
            action()
            if not over:
                timer = self.call_at(self._now_ns + round(seconds * 1e9), tick)

        def cancel() -> None:
            nonlocal over
            over = True
            timer.cancel()

        timer = self.call_at(self._now_ns + round(seconds * 1e9), tick)
        return cancel

    def next_event_ns(self) -> int | None:
        """Return the time of the next pending callback, or None."""
        while self._timers and self._timers[0][2].callback is None:
            heapq.heappop(self._timers)
        return self._timers[0][0] if self._timers else None

    def advance_to(self, at_ns: int) -> None:
        """Advance time to ``at_ns`` and run the callbacks that fall due, including those at ``at_ns``."""
        while (due_ns := self.next_event_ns()) is not None and due_ns <= at_ns:
            timer = heapq.heappop(self._timers)[2]
            self._now_ns = max(self._now_ns, due_ns)
            callback, timer.callback = timer.callback, None
            if callback is not None:
                callback()
        self._now_ns = max(self._now_ns, at_ns)


class PacedClock(VirtualClock):
    """A `VirtualClock` that also takes real time: ``speed`` seconds pass in a second of the computer's clock.

    Time that the program spends computing is not added, so a slow computer does not trip the watchdogs.
    """

    def __init__(self, speed: float, computer: Clock) -> None:
        super().__init__(computer.utc())
        self._speed = speed
        self._computer = computer
        self._ahead_s = 0.0
        self._slept_ns = computer.now_ns()

    def utc(self) -> datetime:
        return self._computer.utc()

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        now_ns = self._computer.now_ns()
        elapsed_s, self._slept_ns = seconds_between(self._slept_ns, now_ns), now_ns
        self._ahead_s = max(self._ahead_s - elapsed_s, 0.0) + max(seconds, 0.0) / self._speed
        if self._ahead_s > _LEAST_SLEEP_S:
            self._computer.sleep(self._ahead_s)


_LEAST_SLEEP_S: Final = 0.002
"""Shorter waits are added up."""
