"""The log: who did what and when. Lines are only added, in the transaction of the change itself, as a chain of digests.

Decision: docs/decisions/0009.
"""

import os
import pwd
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import datetime
from typing import Any, Final, NamedTuple

from sqlalchemy import func, insert, select, update
from sqlalchemy.orm import Session as Transaction

from rig.catalog.columns import damaged
from rig.catalog.facts import Action, Entry, Property, digest_of
from rig.catalog.records import as_json, this_software
from rig.core.clock import Clock
from rig.core.errors import CatalogDamaged
from rig.core.masking import masked
from rig.core.next_steps import Do

_HEAD: Final = re.compile(r"([0-9]{1,15}) ([0-9a-f]{64}|) ([0-9]{1,15}) ([0-9]{1,15}) ([0-9]{1,15})")
_COUNTED: Final = (Entry.deleted, Entry.status, Entry.result)
"""A line counts for the state of an object, the status of an enrollment, or a result if it has a value here."""
# Every list of objects asks these. To build a statement takes longer than to execute it.
_STORED_HEAD: Final = select(Property.value).where(Property.key == "head")
_ENDS: Final = (
    select(func.max(Entry.id)),
    *(select(func.count()).where(column.is_not(None)) for column in _COUNTED),
)
_OPERATOR: Final[ContextVar[str | None]] = ContextVar("operator", default=None)


@contextmanager
def asked_by(operator: str | None) -> Iterator[None]:
    """Let the log name who asks for the changes of this thread: a person at a page; None is the account itself."""
    before = _OPERATOR.set(operator)
    try:
        yield
    finally:
        _OPERATOR.reset(before)


_COLUMNS: Final = tuple(column.name for column in Entry.__table__.columns)


def append(
    transaction: Transaction, clock: Clock, action: Action, object_name: str | None = None, **columns: Any
) -> Entry:
    """Add a line to the log, with these other columns of `Entry`, and return it."""
    operator = {"operator": name} if (name := _OPERATOR.get()) else {}
    details = as_json({**operator, **columns.pop("details", {})}, "The details of the log entry")
    entry = Entry(
        id=0, time_utc=clock.utc(), **author(), action=action, object_name=object_name, details=details, **columns
    )
    add(transaction, entry)
    return entry


def add(transaction: Transaction, *entries: Entry) -> None:
    """Add lines to the log after its last one; each gets its number and its digest."""
    last, before, counts = _end(transaction)
    rows = []
    for entry in entries:
        last += 1
        counts = tuple(
            count + (getattr(entry, column.key) is not None) for count, column in zip(counts, _COUNTED, strict=True)
        )
        entry.id = last
        entry.digest = before = digest_of(entry, before)
        rows.append({name: getattr(entry, name) for name in _COLUMNS})
    if rows:
        transaction.execute(insert(Entry), rows)
        value = " ".join(map(str, (last, before, *counts)))
        transaction.execute(update(Property).where(Property.key == "head").values(value=value))


def same(entry: Entry, **others: Any) -> Entry:
    """Return a line for the log of another catalog; these columns are other ones."""
    columns = {name: getattr(entry, name) for name in _COLUMNS if name != "digest"}
    return Entry(**columns | others)


class _End(NamedTuple):
    """The last line and its digest, and how many lines have a value in each column of `_COUNTED`."""

    line: int
    digest: str
    counts: tuple[int, ...]


def _end(transaction: Transaction) -> _End:
    found = transaction.scalar(_STORED_HEAD)
    if (parts := _HEAD.fullmatch(str(found))) is None:
        raise damaged("the end of its log", found)
    return _End(int(parts[1]), parts[2], (int(parts[3]), int(parts[4]), int(parts[5])))


def head(transaction: Transaction) -> tuple[int, str]:
    """Return the number and the digest of the last line."""
    return _end(transaction)[:2]


def check_complete(transaction: Transaction) -> None:
    """Raise `CatalogDamaged` if a line that counts for the state or the results is missing, or counts no more.

    The line before would count instead. A line that counts is compared with its digest where it is used.
    """
    end = _end(transaction)
    found = [transaction.scalar(one) or 0 for one in _ENDS]
    if found != [end.line, *end.counts]:
        raise CatalogDamaged(
            "Lines of the catalog's log are missing or were changed.",
            next_step=(Do.VERIFY_CATALOG(), "Then use a backup."),
        )


def shown(entry: Entry) -> dict[str, Any]:
    """Return what readers of the log see of a line, as JSON values but for its time."""
    names = ("id", "time_utc", "user", "host", "software", "action", "object_name", "details")
    return {name: getattr(entry, name) for name in names}


def entries(transaction: Transaction, since: datetime | None = None) -> list[Entry]:
    """Return the log, oldest first, with masked secrets."""
    wanted = select(Entry).order_by(Entry.id)
    if since is not None:
        wanted = wanted.where(Entry.time_utc >= since)
    found = list(transaction.scalars(wanted))
    transaction.expunge_all()
    for entry in found:
        entry.details = masked(entry.details)
    return found


def operator() -> str:
    """Return who acts: the person at a page of a server, or the account."""
    return _OPERATOR.get() or str(author()["user"])


def author() -> dict[str, Any]:
    """Return the columns that say who changes the catalog: account, computer and program."""
    try:
        user = pwd.getpwuid(os.getuid()).pw_name  # the account, not LOGNAME, which any user can change
    except KeyError:
        user = str(os.getuid())
    return {"user": user, "host": socket.gethostname(), "software": this_software()}
