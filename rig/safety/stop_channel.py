"""Requests to stop a bench: a local socket in its state folder, which the control loop reads in each round.

A connection is a request. It waits in the kernel until the program looks, so a request needs no disk, no queue and no
thread, and a program that dies answers at once: its connections close. The permissions of the folder and of the socket
decide who may stop the bench.

Decision: docs/decisions/0003.
"""

import os
import select
import socket
import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import StrEnum
from pathlib import Path
from typing import Final
from weakref import WeakValueDictionary

from rig.core.clock import Clock, seconds_between
from rig.core.errors import StateNotStored, os_errors_as
from rig.core.next_steps import Do

NAME: Final = "stop"
BACKLOG: Final = 64  # requests to stop wait in the kernel until the control loop looks; the next one would be rejected
MAX_PATH_BYTES: Final = 100
"""The address of a socket has at most 103 (macOS) or 107 bytes."""
POLL_S: Final = 0.02  # shorter than a person notices


class StopAnswer(StrEnum):
    """What became of a request to stop."""

    TORQUE_OFF = "torque-off"
    """The table was stopped, and its servo reports that the torque is off."""
    NOT_CONFIRMED = "not-confirmed"
    """The program has heard the request, but its servo does not answer, or no servo is connected."""
    ENDED = "ended"
    """The program has ended."""


_BYTES: Final = {StopAnswer.TORQUE_OFF: b"0", StopAnswer.NOT_CONFIRMED: b"?"}


def stop_answer(byte: bytes) -> StopAnswer:
    """Return the answer that a program sent; no byte means that the connection was closed without one."""
    return next((answer for answer, sent in _BYTES.items() if sent == byte), StopAnswer.ENDED)


class StopListener:
    """Receives the requests to stop one bench; made by `listen`. All methods may be called from any thread."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._waiting: list[socket.socket] = []
        self._requests = 0
        self.users = 0
        step = (Do.FREE_DISK(), "Or set state_dir to a local folder that you may write to.")
        with os_errors_as(StateNotStored, f"No requests to stop can be received in {folder}.", next_step=step):
            folder.mkdir(parents=True, exist_ok=True)
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                self._socket.setblocking(False)
                _remove_socket(folder / NAME)
                with _address(folder) as address:
                    self._socket.bind(address)
                (folder / NAME).chmod(0o600)
                self._socket.listen(BACKLOG)
            except OSError:
                self._socket.close()
                raise
        self._ready = select.poll()
        self._ready.register(self._socket, select.POLLIN)

    def __del__(self) -> None:
        if hasattr(self, "_socket"):  # a program that did not close its bench
            self._socket.close()

    def count(self) -> int:
        """Return the number of requests so far. Called in each round of the control loop."""
        with self._lock:
            while self._ready.poll(0):
                self._requests += 1
                try:
                    connection, _ = self._socket.accept()
                except BlockingIOError:
                    self._requests -= 1
                    break
                except OSError:  # too many open files: the request counts, and no answer is possible
                    break
                connection.setblocking(False)
                self._waiting.append(connection)
            return self._requests

    def add(self) -> None:
        """Request a stop from within the program."""
        with self._lock:
            self._requests += 1

    def answer(self, answer: StopAnswer) -> None:
        """Answer all who wait, after the stop was carried out."""
        with self._lock:
            for connection in self._waiting:
                with suppress(OSError), connection:  # the program that asked may have ended
                    connection.send(_BYTES[answer])
            self._waiting.clear()

    def close(self) -> None:
        """Give the listener back; the last user closes the socket."""
        with _registry_lock:
            self.users -= 1
            if self.users > 0:
                return
            _listeners.pop(self._folder, None)
        with self._lock:
            for connection in self._waiting:
                connection.close()
            self._waiting.clear()
            self._socket.close()


_listeners: Final[WeakValueDictionary[Path, StopListener]] = WeakValueDictionary()
_registry_lock: Final = threading.Lock()


def listen(folder: Path) -> StopListener:
    """Return this program's listener for the bench with the state folder ``folder``; close it after use.

    A server and the bench that it opens share one listener.

    Raises `StateNotStored`: the socket cannot be made in the folder.
    """
    folder = folder.absolute()
    with _registry_lock:
        listener = _listeners.get(folder)
        if listener is None:
            listener = _listeners[folder] = StopListener(folder)
        listener.users += 1
        return listener


class StopRequest:
    """A request to stop, sent to the program that uses the bench with the state folder ``folder``; it never waits.

    Its ``connection`` receives the answer: one byte, or its end. It is None if no program listens.
    """

    def __init__(self, folder: Path) -> None:
        self.connection: socket.socket | None = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.connection.setblocking(False)
        try:
            with _address(folder.absolute()) as address:
                self.connection.connect(address)
        except BlockingIOError:  # the program does not look, and many requests wait for it already
            pass
        except OSError:  # there is no socket, or no program listens to it any more
            self.close()

    def close(self) -> None:
        if self.connection is not None:
            self.connection.close()
            self.connection = None

    def answer(self) -> StopAnswer | None:
        """Return the answer; None if there is none yet."""
        assert self.connection is not None
        try:
            return stop_answer(self.connection.recv(1))
        except BlockingIOError:
            return None
        except OSError:
            return StopAnswer.ENDED

    def wait(self, clock: Clock, seconds: float) -> StopAnswer | None:
        """Return the answer, for which this waits at most ``seconds``; None if there is none by then."""
        start_ns = clock.now_ns()
        while (found := self.answer()) is None and seconds_between(start_ns, clock.now_ns()) < seconds:
            clock.sleep(POLL_S)
        return found


@contextmanager
def _address(folder: Path) -> Iterator[str]:
    """Yield an address of the folder's socket that is short enough for the system."""
    path = str(folder / NAME)
    if len(os.fsencode(path)) <= MAX_PATH_BYTES or not hasattr(os, "O_PATH"):
        yield path
        return
    descriptor = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{descriptor}/{NAME}"
    finally:
        os.close(descriptor)


def _remove_socket(path: Path) -> None:
    """Remove the socket that a killed program left behind, but nothing else that has its name."""
    with suppress(FileNotFoundError):
        if stat.S_ISSOCK(path.lstat().st_mode):
            path.unlink()
