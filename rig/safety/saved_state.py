"""State of a bench that survives its program: the cable's revolutions, a latched fault, and who uses the bench.

`BenchLock` reserves the bench for one program.

Decision: docs/decisions/0004.
"""

import errno
import fcntl
import hashlib
import os
import signal
import sys
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, ClassVar, Final, TextIO

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from rig.core import files
from rig.core.clock import Clock
from rig.core.errors import BenchBusy, MotionStopped, Problem, RigError, StateNotStored, os_errors_as
from rig.core.files import no_follow
from rig.core.masking import masked
from rig.core.next_steps import Do
from rig.safety.stop_channel import StopAnswer, StopListener, StopRequest, listen

VERSION = 1  # a state of another version counts as damaged, because it may have contained a fault
LATCH_BYTES = 8192
"""Size of the file of the latched fault. It is written again in place, which needs no room on the disk."""
SESSION = "session.json"
SERVER_FOLDER = "web"
SERVER_FILE = "server.json"
_MAKE_ROOM = (Do.FREE_DISK(), "Or set state_dir to a folder that you may write to.")


class _Saved(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SavedTable(_Saved):
    """The table at its last rest; positions are the servo's own, in degrees, counted since its last power-up.

    ``shift_deg`` must be added to them (revolutions that the servo lost, an angle that the operator set). ``path_deg``
    is the range of a motion that had not ended when this was stored. ``zero_deg``, ``direction`` and ``gear_ratio`` are
    the settings that convert positions to table angles.
    """

    model_number: int
    bus_id: int
    firmware: int
    position_deg: float
    shift_deg: float
    path_deg: tuple[float, float] | None = None
    zero_deg: float
    direction: int
    gear_ratio: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LatchedFault(Problem):
    """A latched fault, which must be acknowledged before the table moves again: an error, and its time."""

    utc: str
    """When it was latched."""

    @classmethod
    def of(cls, error: RigError, utc: str) -> "LatchedFault":
        """Return ``error`` as a fault that can be stored."""
        one = error.problem
        return cls(title=one.title, code=one.code, detail=one.detail, evidence=one.evidence, steps=one.steps, utc=utc)


_FAULT: Final = TypeAdapter(LatchedFault)
_DERIVED: Final[dict[str, Any]] = {"type": True, "next_step": True, "steps": {"__all__": {"command"}}}
"""Fields of a fault that are not stored: another version of the program may word them differently."""


class BenchState(_Saved):
    """The whole stored state; ``damage`` (not stored) is the reason why an earlier state could not be read.

    ``checksum`` is set in the file only: SHA-256 of the other values.
    """

    version: int = VERSION
    table: SavedTable | None = None
    fault: LatchedFault | None = None
    checksum: str | None = None
    damage: str = ""

    def with_checksum(self) -> "BenchState":
        values = self.model_dump_json(exclude={"checksum": True, "damage": True, "fault": _DERIVED})
        return self.model_copy(update={"checksum": hashlib.sha256(values.encode()).hexdigest()})


class Holder(_Saved):
    """The program that uses a bench; ``terminates`` is whether it handles SIGTERM and ends in an orderly way."""

    pid: int
    command: str
    since_utc: str
    terminates: bool = False


class SessionEnd(StrEnum):
    """The ways in which a program ends its session with the bench."""

    FINISHED = "finished"
    FAILED = "failed"
    INTERRUPTED = "interrupted"
    """By Ctrl+C or another signal."""
    STOPPED = "stopped"
    """By ``rig stop``."""

    @classmethod
    def of(cls, error: BaseException | None) -> "SessionEnd":
        """Return the end of a session that ended with this exception, or without one."""
        match error:
            case None:
                return cls.FINISHED
            case GeneratorExit() if error.__context__ is not None:  # a job was closed because showing it failed
                return cls.of(error.__context__)
            case MotionStopped():
                return cls.STOPPED
            case Exception():
                return cls.FAILED
            case _:
                return cls.INTERRUPTED


class SavedSession(_Saved):
    """A session of a program with the bench; ``ended`` is None until it ends, and stays so if the program dies."""

    command: str
    since_utc: str
    ended: SessionEnd | None = None


class ServerAddress(_Saved):
    """The server that uses a bench (`rig serve`): its page, and a token for the commands of the same user."""

    pid: int
    url: str
    token: str
    certificate: str | None = None


class MemoryStore:
    """State that ends with its program, for a simulated bench.

    All stores have these methods. Those of a `FileStore` that write raise `StateNotStored` if the disk is full, or may
    not be written to; `read_file` raises it if the file exists but cannot be read.

    ``outlasts_program`` says whether the next program finds the state: a latched fault then stays latched until it is
    acknowledged.
    """

    outlasts_program: ClassVar[bool] = False

    def __init__(self) -> None:
        self.state = BenchState()
        self.stop = False
        self.files: dict[str, bytes] = {}

    def load(self) -> BenchState:
        return self.state

    def save(self, state: BenchState) -> None:
        """Store ``state``; on return it survives a power cut."""
        self.state = state

    def latch(self, fault: LatchedFault | None) -> None:
        """Store the latched fault, even on a full disk if a state was saved before; None removes it."""
        self.state = self.state.model_copy(update={"fault": fault})

    def listen(self) -> None:
        """Receive requests to stop from now on."""
        self.stop = False

    def stop_requested(self) -> bool:
        """Return whether the operator requested a stop; called in each round of the control loop."""
        return self.stop

    def request_stop(self) -> None:
        """Request a stop from the program that uses the bench; may be called from any thread."""
        self.stop = True

    def clear_stop(self) -> None:
        """Take the requests as carried out: the torque is off. Who waits for an answer gets it."""
        self.stop = False

    def stop_listening(self) -> None:
        """Receive no more requests to stop."""

    def read_file(self, name: str) -> bytes | None:
        """Return the file ``name`` that was stored beside the state; None if there is none."""
        return self.files.get(name)

    def store_file(self, name: str, content: bytes) -> None:
        """Store a file beside the state; on return it survives a power cut."""
        self.files[name] = content

    def remove_file(self, name: str) -> None:
        """Delete the file ``name`` if it exists."""
        self.files.pop(name, None)


class FileStore:
    """State in the folder ``path``: ``state.json``, and the file ``latch`` with the latched fault.

    ``latch`` has a fixed size and is written in place, so a full disk does not lose a fault. It is filled with spaces
    if there is no fault. A file beside the folder shows that the bench has been used: if the folder was emptied or
    deleted, that is not a new bench. Requests to stop come through the socket of `rig.safety.stop_channel`.
    """

    outlasts_program: ClassVar[bool] = True

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path / "state.json"
        self._stops: StopListener | None = None
        self._heard = 0
        self._latch = path / "latch"
        self._used = path.with_name(f"{path.name}.used")

    def load(self) -> BenchState:
        """Return the stored state.

        If a file cannot be read, the state is empty with the reason in ``damage``, and a fault is latched, because the
        file may have contained one.
        """
        state, fault, damage = BenchState(), None, ""
        # The state: its checksum finds a byte that the disk changed.
        try:
            state = BenchState.model_validate_json(self._file.read_bytes())
            if state.version != VERSION:
                damage = f"{self._file} has version {state.version}, but this program reads version {VERSION}"
            elif state.checksum != state.with_checksum().checksum:
                damage = f"{self._file} is damaged: its checksum is not that of its values"
        except FileNotFoundError:
            if not self._latch.exists() and not self._used.exists():
                return state  # a new bench
            damage = f"{self._file} is missing"
        except OSError as error:
            damage = f"{self._file} cannot be read: {error.strerror}"
        except ValidationError as error:
            damage = f"{self._file} is damaged: {error.errors(include_url=False)[0]['msg']}"
        # The latch is newer than the state if the disk was full.
        try:
            text = self._latch.read_bytes()
            if len(text) != LATCH_BYTES:
                damage = damage or f"{self._latch} is damaged: it has {len(text)} bytes"
            if text.strip():
                fault = _FAULT.validate_json(text)
        except FileNotFoundError:
            damage = damage or f"{self._latch} is missing"
        except OSError as error:
            damage = damage or f"{self._latch} cannot be read: {error.strerror}"
        except ValidationError as error:
            damage = damage or f"{self._latch} is damaged: {error.errors(include_url=False)[0]['msg']}"
        if damage:
            return BenchState(damage=damage, fault=state.fault or fault or _fault_of_damage(damage))
        return state.model_copy(update={"fault": state.fault or fault, "checksum": None})

    def latch(self, fault: LatchedFault | None) -> None:
        with storing(self._latch):
            self.path.mkdir(parents=True, exist_ok=True)
            self._write_latch(fault)

    def _write_latch(self, fault: LatchedFault | None) -> None:
        text = b"" if fault is None else _FAULT.dump_json(fault, exclude=_DERIVED)
        if fault is not None and len(text) >= LATCH_BYTES:  # what it is and the first steps fit in any case
            steps = tuple(step[:500] if isinstance(step, str) else step for step in fault.steps)
            text = _FAULT.dump_json(
                replace(fault, detail=fault.detail[:500], steps=steps, evidence={}), exclude=_DERIVED
            )
        content = text.ljust(LATCH_BYTES - 1) + b"\n"
        if not self._latch_is_reserved():
            files.write(self._latch, content)
            return
        descriptor = os.open(self._latch, os.O_WRONLY | os.O_NOFOLLOW)
        try:
            os.pwrite(descriptor, content, 0)
            os.fdatasync(descriptor)  # the file keeps its size and its place on the disk
        finally:
            os.close(descriptor)

    def _latch_is_reserved(self) -> bool:
        return self._latch.is_file() and self._latch.stat().st_size == LATCH_BYTES

    def save(self, state: BenchState) -> None:
        with storing(self._file):
            self.path.mkdir(parents=True, exist_ok=True)
            if not self._latch_is_reserved():  # its room is taken before the first motion
                self._write_latch(state.fault)
            stored = state.with_checksum().model_dump_json(indent=1, exclude={"damage": True, "fault": _DERIVED})
            files.write(self._file, stored.encode())
            if not self._used.exists():  # last: it says that there is a state to be missed
                files.write(
                    self._used, f"This bench has been used. Its state is in the folder {self.path.name}.\n".encode()
                )

    def listen(self) -> None:
        if self._stops is None:
            self._stops = listen(self.path)
        self._heard = self._stops.count()  # older requests were meant for an earlier program

    def stop_requested(self) -> bool:
        return self._stops is not None and self._stops.count() != self._heard

    def clear_stop(self) -> None:
        if self._stops is not None:
            self._heard = self._stops.count()
            self._stops.answer(StopAnswer.TORQUE_OFF)

    def request_stop(self) -> None:
        if self._stops is not None:
            self._stops.add()
        else:
            StopRequest(self.path).close()

    def stop_listening(self) -> None:
        if self._stops is not None:
            self._stops.close()
            self._stops = None

    def read_file(self, name: str) -> bytes | None:
        step = "Give yourself permission to read the file, or delete it."
        with os_errors_as(StateNotStored, f"{self.path / name} cannot be read.", next_step=step):
            try:
                return (self.path / name).read_bytes()
            except FileNotFoundError:
                return None

    def store_file(self, name: str, content: bytes) -> None:
        with os_errors_as(StateNotStored, f"{name} cannot be stored in {self.path}.", next_step=_MAKE_ROOM):
            self.path.mkdir(parents=True, exist_ok=True)
            files.write(self.path / name, content)

    def remove_file(self, name: str) -> None:
        with suppress(OSError):
            (self.path / name).unlink()


StateStore = MemoryStore | FileStore


def begin_session(store: StateStore, clock: Clock) -> SavedSession | None:
    """Store that this program uses the bench, and return the session before; None if it is not known."""
    before = _session(store)
    _store_session(store, SavedSession(command=this_command(), since_utc=clock.utc().isoformat(timespec="seconds")))
    return before


def end_session(store: StateStore, ended: SessionEnd) -> None:
    """Store how the present session ends."""
    if (session := _session(store)) is not None:
        _store_session(store, session.model_copy(update={"ended": ended}))


def _session(store: StateStore) -> SavedSession | None:
    try:
        return SavedSession.model_validate_json(store.read_file(SESSION) or b"")
    except (StateNotStored, ValidationError):
        return None


def _store_session(store: StateStore, session: SavedSession) -> None:
    with suppress(StateNotStored):  # full disk: only the record of the session is missing
        store.store_file(SESSION, session.model_dump_json().encode())


def this_command() -> str:
    """Return the command line, without passwords: other persons see it."""
    command = " ".join(map(masked, [Path(sys.argv[0]).name, *sys.argv[1:]]))
    return command.encode(errors="replace").decode()  # arguments may have bytes that are not UTF-8


def _fault_of_damage(damage: str) -> LatchedFault:
    return LatchedFault(
        code=StateNotStored.code,
        title=StateNotStored.title,
        detail=f"The bench's stored state is lost, and a fault may be lost with it: {damage}.",
        steps=("Look at the table and its cable.", Do.ACKNOWLEDGE()),
        utc="an unknown time",
    )


def storing(path: Path) -> AbstractContextManager[None]:
    """Raise `StateNotStored` if the system does not let the ``with`` block write to ``path``."""
    what = f"The bench's state cannot be written to {path}; the table may not move without it."
    return os_errors_as(StateNotStored, what, next_step=_MAKE_ROOM)


LOCK_ATTEMPTS = 3  # a reader of the holder locks for a moment; with more attempts, a busy bench is reported later


class BenchLock:
    """Reserves a bench for this process until it is closed; the kernel releases it when the process dies.

    Raises `BenchBusy`: another process uses the bench; the message says which. `StateNotStored`: the folder cannot be
    created.
    """

    def __init__(self, path: Path, clock: Clock) -> None:
        # A server keeps the bench even while it cannot open it: a request to stop must reach its queue.
        if (server := holder(path / SERVER_FOLDER)) is not None and server.pid != os.getpid():
            raise busy(path, server)
        with storing(path / "lock"):
            path.mkdir(parents=True, exist_ok=True)
            self._file: TextIO = open(path / "lock", "a+", encoding="utf-8", opener=no_follow)  # noqa: SIM115
        for attempt in range(LOCK_ATTEMPTS):
            if _try_lock(self._file):
                break
            if attempt + 1 == LOCK_ATTEMPTS:
                self._file.close()
                raise busy(path, holder(path))
            clock.sleep(0.02)  # another program may be reading who holds the lock
        # For the message of the next program, and for `rig stop`.
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
