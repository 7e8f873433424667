"""A simulated rig head in real time on a pseudo-terminal, for pyserial and any other program."""

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
"""How far time goes on at once: after a halt (a debugger, a busy machine) host and head must both catch up."""


class PacedClock:
    """The clock of a program in real time: whenever it is looked at, a virtual clock catches up with the computer's.

    What is simulated on ``virtual`` happens when somebody asks for the time here, or sleeps.

    Parameters
    ----------
    virtual
        The simulated world's.
    speed
        How many of its seconds pass in one of the computer's.
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
        """Call ``action`` every ``seconds``, in the middle of whatever sleeps or asks for the time then."""
        return self._virtual.every(seconds, action)


class HeadPty:
    """A simulated head behind a pseudo-terminal.

    ``port`` is what a program opens. The head's clock must be kept going, by a `PacedClock`.
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
        """Carry what has come in either direction."""
        try:
            if data := os.read(self._master, 4096):
                self._head.send(data)
        except BlockingIOError:
            pass
        self._head.catch_up()
        if data := self._head.take(self._head.clock.now_ns()):
            with suppress(BlockingIOError):  # nobody reads: the terminal is full, and what comes is lost
                self.sent += os.write(self._master, data)

    def waiting(self) -> int:
        """Return how many bytes of the host have arrived and were not carried to the head yet."""
        count = fcntl.ioctl(self._master, termios.FIONREAD, bytes(4))
        return int.from_bytes(count, sys.byteorder)

    def close(self) -> None:
        self._cancel()
        if self._master >= 0:
            os.close(self._master)
            os.close(self._slave)
        self._master = self._slave = -1
