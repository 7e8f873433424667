"""The lock that reserves a bench for one program, and the holder of the lock.

Decision: docs/decisions/0009.
"""

import errno
import fcntl
import os
import signal
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from pydantic import ValidationError

from rig.core.clock import Clock
from rig.core.errors import BenchBusy
from rig.core.files import no_follow
from rig.core.next_steps import Do
from rig.safety.saved_state import (
    SERVER_FILE,
    SERVER_FOLDER,
    Holder,
    ServerAddress,
    make_folder,
    storing,
    this_command,
)

LOCK_ATTEMPTS = 3


class BenchLock:
    """Reserves a bench for this process until it is closed; the kernel releases it when the process dies.

    Raises
    ------
    BenchBusy
        Another process uses the bench; the message says which.
    StateNotStored
        The folder cannot be created.
    """

    def __init__(self, path: Path, clock: Clock) -> None:
        # A server keeps the bench even while it cannot open it: a request to stop must reach its queue.
        if (server := holder(path / SERVER_FOLDER)) is not None and server.pid != os.getpid():
            raise busy(path, server)
        with storing(path / "lock"):
            make_folder(path)
            self._file: TextIO = open(path / "lock", "a+", encoding="utf-8", opener=no_follow)  # noqa: SIM115
        for attempt in range(LOCK_ATTEMPTS):
            if _try_lock(self._file):
                break
            if attempt + 1 == LOCK_ATTEMPTS:
                self._file.close()
                raise busy(path, holder(path))
            clock.sleep(0.02)  # another program may be reading who holds the lock
        mine = Holder(
            pid=os.getpid(),
            command=this_command(),
            since_utc=clock.utc().isoformat(timespec="seconds"),
            terminates=callable(signal.getsignal(signal.SIGTERM)),
        )
        with suppress(OSError):  # full disk: the lock works without the holder's name
            self._file.truncate(0)
            self._file.write(mine.model_dump_json())
            self._file.flush()

    def close(self) -> None:
        with suppress(OSError):
            self._file.truncate(0)
        self._file.close()


def holder(path: Path) -> Holder | None:
    """Return the program that uses the bench with the state folder ``path``; None if there is none.

    The name of a killed program does not count, because its lock is released. A holder whose name is not known has pid
    0.
    """
    try:
        with open(path / "lock", encoding="utf-8", opener=no_follow) as file:
            if _try_lock(file):
                return None
            text = file.read()
    except OSError:  # never locked, or not readable for this user
        return None
    try:
        return Holder.model_validate_json(text)
    except ValidationError:
        return Holder(pid=0, command="", since_utc="")


def server_address(path: Path) -> ServerAddress | None:
    """Return the running server of the bench with the state folder ``path``; None if there is none."""
    who = holder(path / SERVER_FOLDER)
    try:
        found = ServerAddress.model_validate_json((path / SERVER_FOLDER / SERVER_FILE).read_bytes())
    except (OSError, ValidationError):
        return None
    return found if who is not None and who.pid == found.pid else None


def _try_lock(file: TextIO) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            return False
        raise
    return True


def busy(path: Path, who: Holder | None) -> BenchBusy:
    """Return the error that ``who`` uses the bench with the state folder ``path``."""
    name = f"process {who.pid} (`{who.command}`, since {who.since_utc})" if who and who.pid else "another process"
    server = server_address(path)
    if server is not None and who is not None and who.pid == server.pid:
        return BenchBusy(
            f"The bench is served to browsers by {name}.",
            next_step=f"Open {server.url} and work there, or end the server first.",
            evidence={"state": str(path), "page": server.url},
        )
    return BenchBusy(
        f"The bench is in use by {name}.",
        next_step=("Wait until it ends, or", Do.STOP(), "A second bench on this computer needs its own state_dir."),
        evidence={"state": str(path)},
    )
