"""Moves a simulated world along with the computer's clock."""

import select
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from threading import RLock
from types import MappingProxyType
from typing import Final, Protocol

from rig.core.clock import SystemClock
from rig.core.signals import uninterrupted
from sim.clock import VirtualClock

STEP_NS: Final = 20_000_000
"""Longest step of the world. After a pause of this program, requests are answered between the steps that catch up."""
ACTIVE_NS: Final = 100_000_000
"""Time after the last byte during which a port is checked every `ACTIVE_WAIT_S`."""
# shorter than a USB adapter's latency; longer waits would slow the control loop of the program
ACTIVE_WAIT_S: Final = 0.001
LONGEST_WAIT_S: Final = 0.1  # how late a program that connects is noticed


class Port(Protocol):
    """A port through which other programs use the world: a pseudo-terminal, for example."""

    def fileno(self) -> int:
        """Return the file descriptor that becomes readable when a program writes; -1 while unplugged."""

    def pump(self) -> bool:
        """Transfer the waiting bytes in both directions; return whether there were any."""


class RealTime:
    """A world whose time passes as the computer's does.

    Each use of the world from another thread needs `present`.

    Other programs use the world through the ``ports``.

    ``over`` says whether the world has ended: its time stands still.
    """

    def __init__(self, clock: VirtualClock, ports: Sequence[Port] = ()) -> None:
        self.over = False
        self._clock = clock
        self._ports = ports
        self._system = SystemClock()
        self._lead_ns = clock.now_ns() - self._system.now_ns()
        self._lock = RLock()
        self._active_until_ns = 0

    def now_ns(self) -> int:
        """Return the present on the world's clock; after a transfer on a bus, the world may be a little ahead of it."""
        return self._system.now_ns() + self._lead_ns

    def system_ns(self, world_ns: int) -> int:
        """Return a time of the world on the computer's monotonic clock, which all programs share."""
        return world_ns - self._lead_ns

    @contextmanager
    def present(self) -> Iterator[None]:
        """Hold the world at the present for the duration of a ``with`` block."""
        with self._lock:
            self._catch_up()
            yield

    def wait(self) -> None:
        """Wait until the present has reached the time of the world, which is ahead after a transfer on a bus."""
        self._system.sleep((self._clock.now_ns() - self.now_ns()) * 1e-9)

    def run(
        self, seconds: float | None = None, inputs: Mapping[int, Callable[[], object]] = MappingProxyType({})
    ) -> None:
        """Let the time pass for ``seconds``, or until `over` is set.

        ``inputs`` are further file descriptors, each with a function to call when it is readable.
        """
        end_ns = None if seconds is None else self.now_ns() + round(seconds * 1e9)
        try:
            while not self.over and (end_ns is None or self.now_ns() < end_ns):
                with uninterrupted(), self.present():
                    wait_s = self._wait_s()
                    ports = [port.fileno() for port in self._ports if port.fileno() >= 0]
                try:
                    readable = select.select([*ports, *inputs], [], [], wait_s)[0]
                except OSError:  # another thread has unplugged a port meanwhile
                    continue
                for descriptor in readable:
                    if descriptor in inputs:
                        inputs[descriptor]()
        finally:
            with self._lock:  # other threads do not use the world from now on
                self.over = True

    def _catch_up(self) -> None:
        now_ns = self.now_ns()
        while not self.over:
            for port in self._ports:
                if port.pump():
                    self._active_until_ns = now_ns + ACTIVE_NS
            world_ns = self._clock.now_ns()
            if world_ns >= now_ns:
                return
            self._clock.advance_to(min(now_ns, world_ns + STEP_NS))

    def _wait_s(self) -> float:
        now_ns = self.now_ns()
        due_ns = self._clock.next_event_ns()
        wait_s = LONGEST_WAIT_S if due_ns is None else min(max(due_ns - now_ns, 0) * 1e-9, LONGEST_WAIT_S)
        return min(wait_s, ACTIVE_WAIT_S) if now_ns < self._active_until_ns else wait_s
