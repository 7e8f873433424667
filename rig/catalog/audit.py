"""The audit log: who did what and when. Entries are only added, in the transaction of the change itself.

Decision: docs/decisions/0016.
"""

import os
import pwd
import socket
from dataclasses import dataclass, replace
from datetime import datetime
from enum import StrEnum
from typing import Any

from sqlalchemy import Connection, insert, select

from rig.catalog.database import given_id
from rig.catalog.records import JsonObject, as_json, this_software
from rig.catalog.schema import audit
from rig.catalog.seal import seal_appended
from rig.core.clock import Clock
from rig.core.masking import masked


class Action(StrEnum):
    """The actions in the log. The values are stored."""

    ENROLLMENT_STARTED = "enrollment started"
    ENROLLMENT_RESUMED = "enrollment resumed"
    ENROLLMENT_ABANDONED = "enrollment abandoned"
    ENROLLMENT_DISCARDED = "enrollment discarded"
    ENROLLED = "enrolled"
    IDENTIFIED = "identified"
    RESULT_CORRECTED = "result corrected"
    RENAMED = "renamed"
    LABELLED = "labelled"
    DELETED = "deleted"
    UNDELETED = "undeleted"
    IMPORTED = "imported"
    ROW_REMOVED = "orphaned row removed"
    REPAIRED = "verified and repaired"
    GARBAGE_COLLECTED = "collected garbage"
    DESCRIBED_AGAIN = "described again"
    COPIED = "copied"
    MOVED = "moved"
    TABLE_PHOTOGRAPHED = "photographed the empty table"


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """One action: when, by which user of which computer, with which program, on which object."""

    id: int
    time_utc: datetime
    user: str
    host: str
    software: str
    action: str
    """An `Action`, or an action of another program version."""
    object_name: str | None
    details: JsonObject


def append(
    connection: Connection, clock: Clock, action: Action, object_name: str | None = None, **details: Any
) -> None:
    """Add an action to the log, in the transaction of the action itself."""
    connection.execute(
        insert(audit).values(
            **given_id(connection, audit),
            time_utc=clock.utc(),
            **author(),
            action=action,
            object_name=object_name,
            details=as_json(details, "The details of the log entry"),
        )
    )
    seal_appended(connection, audit)


def entries(connection: Connection, since: datetime | None = None, object_name: str | None = None) -> list[AuditEntry]:
    """Return the log, oldest first."""
    wanted = select(*(column for column in audit.c if column.name != "digest")).order_by(audit.c.id)
    if since is not None:
        wanted = wanted.where(audit.c.time_utc >= since)
    if object_name is not None:
        wanted = wanted.where(audit.c.object_name == object_name)
    return [replace(AuditEntry(*row), details=masked(row.details)) for row in connection.execute(wanted)]


def author() -> dict[str, str]:
    """Return the columns that say who changes the catalog: account, computer and program."""
    try:
        user = pwd.getpwuid(os.getuid()).pw_name  # the account, not LOGNAME, which any user can change
    except KeyError:
        user = str(os.getuid())
    return {"user": user, "host": socket.gethostname(), "software": this_software()}
