"""Access to the server: tokens, logins, and the lease of the one operator.

Decision: docs/decisions/0020.
"""

import hashlib
import hmac
import secrets
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from rig.core.clock import Clock, seconds_between
from rig.core.errors import ConfigError, LeaseHeld, LoginRequired, StateNotStored, UsageError, os_errors_as
from rig.core.files import read, write
from rig.core.next_steps import Do

TOKENS: Final = "tokens.json"
MAX_NAME: Final = 50  # a line of the list of tokens
MAX_BYTES: Final = 1_000_000  # far above a file of all tokens of a laboratory
SESSION_S: Final = 12 * 3600.0
"""Time for which a login is valid: a working day."""
MAX_SESSIONS: Final = 1000  # a script that logs in for each request must not fill the memory; the oldest session ends
LEASE_S: Final = 45.0
"""Time after which a lease that is not renewed is free, because the operator's browser was closed."""


def new_token() -> str:
    return f"rig_{secrets.token_urlsafe(32)}"


class Role(StrEnum):
    """The rights of a token: to watch, also to propose jobs that an operator approves, or to operate the bench."""

    WATCH = "watch"
    PROPOSE = "propose"
    OPERATE = "operate"


class StoredToken(BaseModel):
    """A token as the server stores it: only its hash."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(min_length=1, max_length=MAX_NAME)
    role: Role
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    created_utc: AwareDatetime
    expires_utc: AwareDatetime | None = None


@dataclass(frozen=True, slots=True)
class Person:
    """The sender of a request: the name and the rights of the token. ``client`` distinguishes browser windows."""

    name: str
    role: Role
    client: str = ""

    @property
    def key(self) -> tuple[str, str]:
        return self.name, self.client

    def as_json(self) -> dict[str, str]:
        return {"name": self.name, "client": self.client}


LOCAL: Final = "local"
"""Name of all users of this computer, if they need no token."""

_STORED: Final = TypeAdapter(list[StoredToken])


class Tokens:
    """The tokens of a server, in a file that only its user can read. While it is damaged, the last good ones count."""

    def __init__(self, folder: Path, clock: Clock) -> None:
        self._file = folder / TOKENS
        self._clock = clock
        self._known: list[StoredToken] = []
        self._read_at: tuple[int, int, int] | None = None
        self._damage: ConfigError | None = None
        self._changing = threading.Lock()
        self._used: dict[str, datetime] = {}
        """When a token was valid for the last time, by its hash."""

    def new(self, name: str, role: Role, days: float | None = None, *, replace: bool = True) -> str:
        """Make a token, store its hash, and return it.

        Raises `UsageError`: the name cannot be used, or a token has it and ``replace`` is False. `ConfigError`: the
        file is damaged. `StateNotStored`: it cannot be written.
        """
        if not 0 < len(name) <= MAX_NAME or not name.isprintable() or name.strip() != name or name.casefold() == LOCAL:
            raise UsageError(
                f"{name!r} cannot be the name of a token.",
                next_step=f"Use 1 to {MAX_NAME} characters that can be printed, without outer spaces, but not {LOCAL}.",
            )
        token, now = new_token(), self._clock.utc()
        expires = None if days is None else now + timedelta(days=days)
        stored = StoredToken(name=name, role=role, sha256=_hash(token), created_utc=now, expires_utc=expires)
        with self._changing:
            known = self.stored()
            others = [other for other in known if other.name != name]
            if not replace and len(others) < len(known):
                raise UsageError(
                    f"There is a token {name} already.", next_step="Choose another name, or revoke that token first."
                )
            self._store([*others, stored])
        return token

    def remove(self, name: str) -> bool:
        """Remove a token, and return whether it existed."""
        with self._changing:
            before = self.stored()
            after = [token for token in before if token.name != name]
            if removed := len(after) != len(before):
                self._store(after)
        return removed

    def used_utc(self, token: StoredToken) -> datetime | None:
        """Return when a token was used last; None if this server has not seen it."""
        return self._used.get(token.sha256)

    def stored(self) -> list[StoredToken]:
        """Return the stored tokens. Raises `ConfigError` if their file is damaged."""
        self._read()
        if self._damage is not None:
            raise self._damage
        return self._known

    def valid(self, sha256: str) -> StoredToken | None:
        """Return the token with this hash; None if it is unknown or has expired.

        Raises `ConfigError`: the file is damaged, and the token is not one of the last good ones.
        """
        self._read()
        found = next((stored for stored in self._known if hmac.compare_digest(sha256, stored.sha256)), None)
        if found is None and self._damage is not None:
            raise self._damage
        if found is None or (found.expires_utc is not None and found.expires_utc <= self._clock.utc()):
            return None
        self._used[found.sha256] = self._clock.utc()
        return found

    def _read(self) -> None:
        """Read the file if it has changed."""
        # A command in a terminal replaces the file while the server runs, so each request looks at its state.
        try:
            status = self._file.stat()
            signature = (status.st_ino, status.st_mtime_ns, status.st_size)
            if signature != self._read_at:
                self._known = _STORED.validate_json(read(self._file, max_bytes=MAX_BYTES))
                self._read_at, self._damage = signature, None
        except FileNotFoundError:
            self._known, self._read_at, self._damage = [], None, None
        except (OSError, ValidationError) as error:
            self._read_at = None  # it is read again at the next request: it may have been repaired
            self._damage = ConfigError(
                f"The tokens in {self._file} cannot be read.",
                next_step=("Delete the file.", Do.NEW_TOKEN()),
                evidence={"reason": str(error)},
            )

    def _store(self, tokens: list[StoredToken]) -> None:
        content = _STORED.dump_json(tokens, indent=1)
        step = (Do.FREE_DISK(), "Or set state_dir to a folder that you may write to.")
        with os_errors_as(StateNotStored, f"The tokens cannot be stored in {self._file}.", next_step=step):
            self._file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            write(self._file, content, mode=0o600)


@dataclass(slots=True)
class Sessions:
    """Logins of browsers, in memory: after a restart, all users log in again."""

    tokens: Tokens
    clock: Clock
    local_token: str = field(repr=False)
    """Lets commands of the same user on this computer watch; it ends with the server."""
    _sessions: dict[str, tuple[str, int]] = field(default_factory=dict)
    """By the secret of a session: the hash of its token, and when it began."""
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def login(self, token: str) -> tuple[str, Person]:
        """Return the secret of a new session and its person; errors as `verify`."""
        stored = self.verify(token)
        secret = secrets.token_urlsafe(32)
        with self._lock:
            while len(self._sessions) >= MAX_SESSIONS:
                del self._sessions[next(iter(self._sessions))]
            self._sessions[secret] = stored.sha256, self.clock.now_ns()
        return secret, Person(stored.name, stored.role)

    def verify(self, token: str) -> StoredToken:
        """Return the token that was given.

        Wrong tokens lock no one out: a token cannot be guessed, and its owner may have to stop the table.

        Raises `LoginRequired`: the token is unknown or has expired. `ConfigError`: the file of the tokens is damaged.
        """
        # The comparison takes the same time for each wrong token, so that none can be guessed part by part.
        if hmac.compare_digest(token.encode(errors="replace"), self.local_token.encode()):
            return StoredToken(name=LOCAL, role=Role.WATCH, sha256=_hash(token), created_utc=self.clock.utc())
        stored = self.tokens.valid(_hash(token))
        if stored is None:
            raise LoginRequired("The token is unknown or has expired.", next_step=Do.NEW_TOKEN())
        return stored

    def find(self, secret: str) -> Person | None:
        """Return the person of a session; None if it has ended or its token was removed."""
        with self._lock:
            sha256, since_ns = self._sessions.get(secret, ("", 0))
        stored = None
        if sha256 and seconds_between(since_ns, self.clock.now_ns()) <= SESSION_S:
            with suppress(ConfigError):  # the file is damaged, and the last good one had no such token
                stored = self.tokens.valid(sha256)
        return None if stored is None else Person(stored.name, stored.role)

    def logout(self, secret: str) -> None:
        with self._lock:
            self._sessions.pop(secret, None)


@dataclass(slots=True)
class Lease:
    """The right of one operator to use the bench; all others watch. It ends if it is not renewed."""

    clock: Clock
    changed: Callable[[dict[str, Any]], None]
    _holder: Person | None = None
    _until_ns: int = 0
    _lock: threading.RLock = field(default_factory=threading.RLock)

    @property
    def holder(self) -> Person | None:
        with self._lock:
            if self._holder is not None and self.clock.now_ns() > self._until_ns:
                self._holder = None
            return self._holder

    def is_held_by(self, person: Person) -> bool:
        holder = self.holder
        return holder is not None and holder.key == person.key

    def take(self, person: Person, *, force: bool = False) -> None:
        """Take or renew the lease; with ``force`` also from another operator, who is warned.

        Raises `LeaseHeld`: another operator has it.
        """
        # A page renews the lease every 15 s; all pages hear of a change of the holder only.
        with self._lock:
            before, renewed = self.holder, self.is_held_by(person)
            if before is not None and not renewed and not force:
                raise LeaseHeld(
                    f"{before.name} uses the bench now.",
                    next_step="Wait, or take it over. The other operator is then warned.",
                    evidence={"holder": before.name},
                )
            self._holder = person
            self._until_ns = self.clock.now_ns() + round(LEASE_S * 1e9)
        if not renewed:
            self.changed(self.as_json(taken_from=before))

    def release(self, person: Person) -> None:
        """Give the lease back; nothing happens if another operator has it."""
        with self._lock:
            if self._holder is None or self._holder.key != person.key:
                return
            self._holder = None
        self.changed(self.as_json())

    def as_json(self, taken_from: Person | None = None) -> dict[str, Any]:
        holder = self.holder
        return {
            "holder": holder.name if holder else None,
            "client": holder.client if holder else None,
            "taken_from": None if taken_from is None else taken_from.as_json(),
            "seconds": LEASE_S,
        }


def _hash(token: str) -> str:
    # The token has 256 random bits, so a slow hash would not protect it better.
    return hashlib.sha256(token.encode(errors="replace")).hexdigest()
