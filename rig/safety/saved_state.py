"""What a bench must not forget when its program ends: how far the cable is wound up, a latched fault, who holds it."""

import errno
import fcntl
import json
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol, TextIO

from pydantic import BaseModel, ConfigDict, ValidationError

from rig.core import files
from rig.core.clock import Clock
from rig.core.errors import BenchBusy, RigError, StateNotStored

VERSION = 1
LOCK_ATTEMPTS = 3


class _Saved(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SavedTable(_Saved):
    """The table at its last rest; positions are the servo's own, in degrees, as it counts since its last power-up.

    ``shift_deg`` is what must be added to them (turns that the servo forgot, a zero that was declared), ``path_deg``
    the reach of a motion that had not ended when this was written.
    """

    model_number: int
    bus_id: int
    firmware: int
    position_deg: float
    shift_deg: float
    path_deg: tuple[float, float] | None = None


class LatchedFault(_Saved):
    """A latched fault: what `rig.core.errors` said, and when."""

    code: int
    title: str
    what: str
    next_step: str
    evidence: dict[str, Any] = {}
    utc: str

    @classmethod
    def of(cls, error: RigError, utc: str) -> "LatchedFault":
        """Return the fault that ``error`` tells of, as it can be kept in a file."""
        evidence = json.loads(json.dumps(error.evidence, default=str))
        return cls(
            code=error.code, title=error.title, what=error.what, next_step=error.next_step, evidence=evidence, utc=utc
        )


class BenchState(_Saved):
    """All of it; ``damage`` says why an earlier state could not be read, and is not kept."""

    version: int = VERSION
    table: SavedTable | None = None
    fault: LatchedFault | None = None
    damage: str = ""


class Holder(_Saved):
    """The program that holds a bench; ``terminates`` says that SIGTERM ends it in an orderly way."""

    pid: int
    command: str
    since_utc: str
    terminates: bool = False


class StateStore(Protocol):
    """Where the state of one bench is kept."""

    def load(self) -> BenchState: ...

    def save(self, state: BenchState) -> None:
        """Keep ``state``; on return it outlives a power cut.

        Raises
        ------
        StateNotStored
            The disk is full, or may not be written to.
        """
        ...

    def stop_requested(self) -> bool:
        """Return whether somebody asked for a stop; asked in every round of the control loop."""
        ...

    def clear_stop(self) -> None:
        """Take the request back: it was heeded, or came from a time before."""
        ...

    def read_file(self, name: str) -> bytes | None:
        """Return what was kept beside the state under ``name``; None where nothing was.

        Raises
        ------
        StateNotStored
            It is there and cannot be read.
        """
        ...

    def store_file(self, name: str, content: bytes) -> None:
        """Keep something beside the state; on return it outlives a power cut.

        Raises
        ------
        StateNotStored
            The disk is full, or may not be written to.
        """
        ...

    def remove_file(self, name: str) -> None:
        """Let go of what was kept under ``name``, if anything was."""
        ...


class MemoryStore:
    """A state that ends with its program: a simulated bench's."""

    def __init__(self) -> None:
        self.state = BenchState()
        self.stop = False
        self.files: dict[str, bytes] = {}

    def load(self) -> BenchState:
        return self.state

    def save(self, state: BenchState) -> None:
        self.state = state

    def stop_requested(self) -> bool:
        return self.stop

    def clear_stop(self) -> None:
        self.stop = False

    def read_file(self, name: str) -> bytes | None:
        return self.files.get(name)

    def store_file(self, name: str, content: bytes) -> None:
        self.files[name] = content

    def remove_file(self, name: str) -> None:
        self.files.pop(name, None)


class FileStore:
    """A state in the folder ``path``: ``state.json``, and the ``stop`` that `request_stop` leaves there."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path / "state.json"
        self._stop = path / "stop"

    def load(self) -> BenchState:
        """Return what was kept; of a file that cannot be read nothing, and why."""
        try:
            text = self._file.read_bytes()
        except FileNotFoundError:
            return BenchState()
        except OSError as error:
            return BenchState(damage=f"{self._file} cannot be read: {error.strerror}")
        try:
            state = BenchState.model_validate_json(text)
        except ValidationError as error:
            return BenchState(damage=f"{self._file} is damaged: {error.errors(include_url=False)[0]['msg']}")
        if state.version != VERSION:
            return BenchState(damage=f"{self._file} is of version {state.version}, this program knows {VERSION}")
        return state

    def save(self, state: BenchState) -> None:
        try:
            _make_folder(self.path)
            files.write(self._file, state.model_dump_json(indent=1, exclude={"damage"}).encode())
        except OSError as error:
            raise _not_kept(self._file, error) from error

    def stop_requested(self) -> bool:
        return self._stop.exists()

    def clear_stop(self) -> None:
        self._stop.unlink(missing_ok=True)

    def request_stop(self) -> None:
        """Ask whoever holds the bench to stop."""
        try:
            _make_folder(self.path)
            self._stop.touch()
        except OSError as error:
            raise _not_kept(self._stop, error) from error

    def read_file(self, name: str) -> bytes | None:
        try:
            return (self.path / name).read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise StateNotStored(
                f"{self.path / name} cannot be read.",
                next_step="Give yourself the right to read it, or remove it.",
                evidence={"reason": error.strerror or str(error)},
            ) from error

    def store_file(self, name: str, content: bytes) -> None:
        try:
            _make_folder(self.path)
            files.write(self.path / name, content)
        except OSError as error:
            raise StateNotStored(
                f"{name} cannot be kept in {self.path}.",
                next_step="Make room on the disk, or set state_dir to a folder that you may write to.",
                evidence={"reason": error.strerror or str(error)},
            ) from error

    def remove_file(self, name: str) -> None:
        with suppress(OSError):
            (self.path / name).unlink()


class BenchLock:
    """Holds a bench for this process alone, as long as it is open; the kernel lets go of it when the process dies.

    Raises
    ------
    BenchBusy
        Another process holds it; the evidence says which.
    StateNotStored
        The folder cannot be made.
    """

    def __init__(self, path: Path, clock: Clock) -> None:
        try:
            _make_folder(path)
            self._file: TextIO = (path / "lock").open("a+", encoding="utf-8")
        except OSError as error:
            raise _not_kept(path / "lock", error) from error
        for attempt in range(LOCK_ATTEMPTS):
            if _try_lock(self._file):
                break
            if attempt + 1 == LOCK_ATTEMPTS:
                self._file.close()
                raise busy(path, holder(path))
            clock.sleep(0.02)  # somebody may only be looking who holds it
        FileStore(path).clear_stop()  # meant for whoever held the bench before
        mine = Holder(
            pid=os.getpid(),
            command=" ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
            since_utc=clock.utc().isoformat(timespec="seconds"),
            terminates=callable(signal.getsignal(signal.SIGTERM)),
        )
        with suppress(OSError):  # a full disk: the lock holds, only its holder's name is missing
            self._file.truncate(0)
            self._file.write(mine.model_dump_json())
            self._file.flush()

    def close(self) -> None:
        with suppress(OSError):
            self._file.truncate(0)
        self._file.close()


def holder(path: Path) -> Holder | None:
    """Return who holds the bench with the state folder ``path``: None if nobody does.

    A name that a killed program left behind counts for nothing: its lock went with it. A holder whose name is not known
    has the pid 0.
    """
    try:
        with (path / "lock").open("r", encoding="utf-8") as file:
            if _try_lock(file):
                return None
            text = file.read()
    except OSError:  # nobody ever held it; or who did, is not for this user to know
        return None
    try:
        return Holder.model_validate_json(text)
    except ValidationError:
        return Holder(pid=0, command="", since_utc="")


def _try_lock(file: TextIO) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            return False
        raise
    return True


def busy(path: Path, who: Holder | None) -> BenchBusy:
    """Return the error that the bench with the state folder ``path`` is held by ``who``."""
    name = f"process {who.pid} (`{who.command}`, since {who.since_utc})" if who and who.pid else "another process"
    return BenchBusy(
        f"The bench is in use by {name}.",
        next_step="Wait until it is done, or end it with `rig stop` (table stopped, torque off). "
        "Another bench on this computer needs a state_dir of its own.",
        evidence={"state": str(path)},
    )


def _make_folder(path: Path) -> None:
    if not path.is_dir():
        path.mkdir(parents=True, exist_ok=True)


def _not_kept(path: Path, error: OSError) -> StateNotStored:
    return StateNotStored(
        f"The bench's state cannot be written to {path}, so nothing may move.",
        next_step="Make room on the disk, or set state_dir to a folder that you may write to.",
        evidence={"reason": error.strerror or str(error)},
    )
