"""A simulated rig head in real time on a pseudo-terminal, for any program that opens a serial port."""

import fcntl
import os
import pty
import sys
import termios
import tty
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime

from rig.core.clock import SystemClock
from sim.clock import VirtualClock
from sim.head.board import SimHead

PUMP_S = 0.001
LONGEST_STEP_NS = 20_000_000
"""Longest time step: after a pause (a debugger, a busy computer) host and head must both catch up."""


class PacedClock:
    """A real-time clock: each time it is read, a virtual clock catches up with the computer's clock.

    Simulated activity on ``virtual`` happens when a program reads this clock or sleeps.

    Parameters
    ----------
    virtual
        The simulated world's clock.
    speed
        Virtual seconds for each second of the computer.
    """

    def __init__(self, virtual: VirtualClock, speed: float = 1.0) -> None:
        self._virtual = virtual
        self._speed = speed
        self._system = SystemClock()
        self._real_ns = self._system.now_ns()

    def now_ns(self) -> int:
        real_ns = self._system.now_ns()
        step_ns = min(round((real_ns - self._real_ns) * self._speed), LONGEST_STEP_NS)
        self._real_ns = real_ns
        self._virtual.advance_to(self._virtual.now_ns() + step_ns)
        return self._virtual.now_ns()

    def sleep(self, seconds: float) -> None:
        until_ns = self.now_ns() + round(seconds * 1e9)
        while (now_ns := self.now_ns()) < until_ns:
            self._system.sleep(min(PUMP_S, (until_ns - now_ns) * 1e-9 / self._speed))

    def utc(self) -> datetime:
        return self._virtual.utc()

    def every(self, seconds: float, action: Callable[[], None]) -> Callable[[], None]:
        """Call ``action`` every ``seconds`` while a program sleeps or reads the time; return what stops it."""
        return self._virtual.every(seconds, action)


class HeadPty:
    """A simulated head behind a pseudo-terminal.

    A program opens ``port``. A `PacedClock` must advance the head's clock.
    """

    def __init__(self, head: SimHead) -> None:
        self._head = head
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        self.sent = 0
        """Bytes that the head has sent so far."""
        self._cancel = head.clock.every(PUMP_S, self.pump)

    def pump(self) -> None:
        """Transfer the received bytes in both directions."""
        try:
            if data := os.read(self._master, 4096):
                self._head.send(data)
        except BlockingIOError:
            pass
        self._head.catch_up()
        if data := self._head.take(self._head.clock.now_ns()):
            with suppress(BlockingIOError):  # the terminal is full because no program reads; the bytes are lost
                self.sent += os.write(self._master, data)

    def waiting(self) -> int:
        """Return the number of received bytes of the host that were not transferred to the head yet."""
        count = fcntl.ioctl(self._master, termios.FIONREAD, bytes(4))
        return int.from_bytes(count, sys.byteorder)

    def close(self) -> None:
        self._cancel()
        if self._master >= 0:
            os.close(self._master)
            os.close(self._slave)
        self._master = self._slave = -1
