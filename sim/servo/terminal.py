"""Simulated servos in real time on a pseudo-terminal, for any program that opens a serial port."""

import os
import select
import tty
from bisect import insort
from contextlib import AbstractContextManager, suppress

from rig.core.clock import Clock
from sim.servo.bus import Frame, ServoBus

LONGEST_WAIT_S = 0.1


class ServoTerminal(AbstractContextManager["ServoTerminal"]):
    """The host's end of a `ServoBus` as a pseudo-terminal; the end of the ``with`` block removes it.

    A pseudo-terminal has no baud rate: whatever a program asks for, the line runs at the servos'.

    Parameters
    ----------
    bus
        The line; its virtual clock is moved along with ``clock`` while `serve` runs.
    baudrate
        The servos'.
    clock
        The real time.
    """

    def __init__(self, bus: ServoBus, baudrate: int, clock: Clock) -> None:
        self._bus = bus
        self._baudrate = baudrate
        self._clock = clock
        self._coming: list[Frame] = []
        # The near end stays open here, because reading the far end fails if no program has the near end open.
        self._far, self._near = os.openpty()
        tty.setraw(self._near)
        os.set_blocking(self._far, False)
        self.port = os.ttyname(self._near)
        if not bus.connect(lambda frame: insort(self._coming, frame, key=lambda f: f.end_ns)):
            self._close()
            raise ValueError("the bus has a host already")

    def __exit__(self, *_: object) -> None:
        self._bus.disconnect()
        self._close()

    def serve(self, seconds: float | None = None) -> None:
        """Answer for ``seconds``, or without end."""
        begun_ns = self._clock.now_ns()
        ahead_ns = self._bus.clock.now_ns() - begun_ns
        while seconds is None or self._clock.now_ns() - begun_ns < seconds * 1e9:
            now_ns = self._clock.now_ns() + ahead_ns
            self._bus.clock.advance_to(now_ns)
            self._pass_on(now_ns)
            if select.select([self._far], [], [], self._wait_s(now_ns))[0]:
                with suppress(BlockingIOError):
                    self._bus.clock.advance_to(self._clock.now_ns() + ahead_ns)
                    self._bus.send(os.read(self._far, 4096), self._baudrate)

    def _pass_on(self, now_ns: int) -> None:
        """Send the complete answers; they are lost if no program reads them."""
        while self._coming and self._coming[0].end_ns <= now_ns:
            frame = self._coming.pop(0)
            with suppress(BlockingIOError):
                os.write(self._far, frame.data)

    def _wait_s(self, now_ns: int) -> float:
        due_ns = [self._coming[0].end_ns] if self._coming else []
        if (event_ns := self._bus.clock.next_event_ns()) is not None:
            due_ns.append(event_ns)
        return min([max(min(due_ns, default=now_ns + 10**9) - now_ns, 0) * 1e-9, LONGEST_WAIT_S])

    def _close(self) -> None:
        os.close(self._far)
        os.close(self._near)
