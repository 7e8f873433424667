"""The facts of a catalog: what was observed and done. A row is written once and never changed.

What is true now follows from the rows (`rig.catalog.state`). Each row has a digest of its values, and each line of the
log also covers the digest of the line before it, so a change that this program did not make is found.

Decision: docs/decisions/0009.
"""

import hashlib
import json
from collections.abc import Sequence
from datetime import UTC, datetime
from enum import StrEnum
from functools import cache
from math import isfinite
from typing import Any, Final

from sqlalchemy import (
    JSON,
    CheckConstraint,
    ColumnElement,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
    UniqueConstraint,
    event,
    inspect,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, MappedAsDataclass, composite, mapped_column, relationship

from rig.catalog.columns import (
    AZIMUTHS,
    BYTES,
    COUNT,
    IMAGE_NAME,
    JSON_OBJECT,
    NANOSECONDS,
    NUMBER,
    REGION,
    STATUS,
    TEXT,
    TRUTH,
    UTC_TIME,
    damaged,
    limited,
    stored_type,
)
from rig.catalog.records import MAX_NAME_LENGTH, EnrollmentStatus, JsonObject, Provenance, Region, is_region

SCHEMA_VERSION: Final = 1
"""Version of the tables below."""


class Action(StrEnum):
    """What a line of the log tells. The values are stored."""

    ENROLLMENT_STARTED = "enrollment started"
    ENROLLMENT_RESUMED = "enrollment resumed"
    ENROLLMENT_ABANDONED = "enrollment abandoned"
    ENROLLMENT_DISCARDED = "enrollment discarded"
    ENROLLMENT_SUPERSEDED = "enrollment superseded"
    ENROLLED = "enrolled"
    IDENTIFIED = "identified"
    RESULT_CORRECTED = "result corrected"
    RENAMED = "renamed"
    LABELLED = "labelled"
    DELETED = "deleted"
    UNDELETED = "undeleted"
    IMPORTED = "imported"
    GARBAGE_COLLECTED = "collected garbage"
    DELIVERED = "delivered"
    MOVED = "moved"
    TABLE_PHOTOGRAPHED = "photographed the empty table"


class Row(MappedAsDataclass, DeclarativeBase, kw_only=True, eq=False):
    """A row of a catalog."""


class Property(Row):
    """A property of the whole catalog: its kind, its version, its id, and the last line of its log."""

    __tablename__ = "properties"
    key: Mapped[str] = mapped_column(TEXT, primary_key=True)
    value: Mapped[str] = mapped_column(TEXT)


class Entry(Row):
    """A line of the log: who did what and when.

    A line that changes an object has its state after the change: ``object_name``, ``label``, ``note``, ``deleted`` and
    ``created_utc``. A line that changes an enrollment has its new ``status``; if that is complete, also its ``seal``.
    """

    __tablename__ = "log"
    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    """Numbers the lines from 1, without a gap."""
    time_utc: Mapped[datetime] = mapped_column(UTC_TIME)
    user: Mapped[str] = mapped_column(TEXT)
    host: Mapped[str] = mapped_column(TEXT)
    software: Mapped[str] = mapped_column(TEXT)
    action: Mapped[str] = mapped_column(TEXT)
    object_name: Mapped[str | None] = mapped_column(limited(MAX_NAME_LENGTH), default=None)
    object_id: Mapped[int | None] = mapped_column(COUNT, default=None)
    label: Mapped[str | None] = mapped_column(TEXT, default=None)
    note: Mapped[str | None] = mapped_column(TEXT, default=None)
    deleted: Mapped[bool | None] = mapped_column(TRUTH, default=None)
    created_utc: Mapped[datetime | None] = mapped_column(UTC_TIME, default=None)
    enrollment_id: Mapped[int | None] = mapped_column(COUNT, default=None)
    status: Mapped[EnrollmentStatus | None] = mapped_column(STATUS, default=None)
    finished_utc: Mapped[datetime | None] = mapped_column(UTC_TIME, default=None)
    """When the enrollment ended. It is earlier than the line if another catalog had it first."""
    seal: Mapped[str | None] = mapped_column(limited(64), default=None)
    """`seal_of` the enrollment: its sessions and its views."""
    result: Mapped[int | None] = mapped_column(COUNT, default=None, index=True)
    """The number of the answer that the line tells or corrects (`rig.catalog.results`)."""
    details: Mapped[JsonObject] = mapped_column(JSON_OBJECT, default_factory=dict)
    """For readers of the log."""
    record: Mapped[JsonObject | None] = mapped_column(JSON_OBJECT, default=None)
    """The whole fact, if it is longer than the details."""
    digest: Mapped[str] = mapped_column(limited(64), init=False, default="")


class Enrollment(Row):
    """An enrollment: the planned azimuth of view 0, 1, .... With its last view it is complete and never changes.

    ``key`` is the same in every catalog that has the enrollment.
    """

    __tablename__ = "enrollments"
    id: Mapped[int] = mapped_column(primary_key=True, init=False)
    key: Mapped[str] = mapped_column(limited(64), unique=True)
    object_id: Mapped[int] = mapped_column(COUNT, index=True)
    started_utc: Mapped[datetime] = mapped_column(UTC_TIME)
    planned_azimuth_deg: Mapped[tuple[float, ...]] = mapped_column(AZIMUTHS)
    digest: Mapped[str] = mapped_column(limited(64), init=False, default="")
    sessions: Mapped[list["Session"]] = relationship(order_by="Session.number", init=False, repr=False)
    views: Mapped[list["View"]] = relationship(order_by="View.index", init=False, repr=False)
    __table_args__ = ({"sqlite_autoincrement": True},)  # no id is given twice, even after a removal

    @property
    def present(self) -> tuple[int, ...]:
        """Indices of the stored views, ascending."""
        return tuple(view.index for view in self.views)

    @property
    def missing(self) -> tuple[int, ...]:
        """Indices of the planned views that are not stored yet, ascending."""
        return tuple(sorted(set(range(len(self.planned_azimuth_deg))) - set(self.present)))


class Session(Row):
    """An uninterrupted part of an enrollment, numbered from 0. Its views share one origin of the bench clock.

    A resumed enrollment may use another bench, program or calibration. ``empty_table`` is the sheet of the bench's
    empty-table images in this session (`rig.views.table_sheet`), if there is one.
    """

    __tablename__ = "sessions"
    enrollment_id: Mapped[int] = mapped_column(ForeignKey(Enrollment.id), primary_key=True, init=False, repr=False)
    number: Mapped[int] = mapped_column(COUNT, primary_key=True)
    started_utc: Mapped[datetime] = mapped_column(UTC_TIME)
    provenance: Mapped[Provenance] = composite(
        mapped_column("bench", TEXT),
        mapped_column("devices", JSON_OBJECT),
        mapped_column("conditions", JSON_OBJECT),
        mapped_column("software", TEXT),
    )
    empty_table: Mapped[str | None] = mapped_column(IMAGE_NAME, default=None)
    empty_table_bytes: Mapped[int | None] = mapped_column(COUNT, default=None, repr=False)
    digest: Mapped[str] = mapped_column(limited(64), init=False, default="", repr=False)


class View(Row):
    """A view of an object, and the evidence on which it was accepted."""

    __tablename__ = "views"
    id: Mapped[int] = mapped_column(primary_key=True, init=False)
    enrollment_id: Mapped[int] = mapped_column(init=False, default=None)
    index: Mapped[int] = mapped_column("view_index", COUNT, CheckConstraint("view_index >= 0", name="view_index"))
    """Position in the plan of the enrollment, from 0."""
    session: Mapped[int] = mapped_column(COUNT, init=False, default=0)
    azimuth_deg: Mapped[float] = mapped_column(
        NUMBER, CheckConstraint("azimuth_deg >= 0 AND azimuth_deg < 360", name="azimuth_deg")
    )
    """Orientation of the camera around the object, in [0, 360)."""
    commanded_deg: Mapped[float | None] = mapped_column(NUMBER, default=None)
    encoder_deg: Mapped[float | None] = mapped_column(NUMBER, default=None)
    """Commanded and measured table angle, unwrapped; None for a view that was not taken by a bench."""
    imu_deg: Mapped[float | None] = mapped_column(NUMBER, default=None)
    imu_sigma_deg: Mapped[float | None] = mapped_column(NUMBER, default=None)
    """Table angle measured by the IMU, unwrapped, and its standard uncertainty; both None without an IMU."""
    captured_ns: Mapped[int | None] = mapped_column(NANOSECONDS, default=None)
    captured_utc: Mapped[datetime | None] = mapped_column(UTC_TIME, default=None)
    """Start of the exposure on the bench's clock, and in civil time; None for a view that was not taken by a bench."""
    evidence: Mapped[JsonObject] = mapped_column(JSON_OBJECT, default_factory=dict)
    """The numbers for which the view was accepted (sharpness, exposure, settling, locks) as JSON values. The keys
    contain the units."""
    region: Mapped[Region | None] = mapped_column(REGION, default=None)
    """The part of the image that shows the object: x, y, width, height in pixels; None for the whole image."""
    image: Mapped[str] = mapped_column(IMAGE_NAME, default="")
    """Name of the image (`rig.catalog.images`): its SHA-256, and the suffix of its format."""
    image_bytes: Mapped[int] = mapped_column(COUNT, default=0)
    digest: Mapped[str] = mapped_column(limited(64), init=False, default="", repr=False)
    __table_args__ = (
        UniqueConstraint("enrollment_id", "view_index"),
        ForeignKeyConstraint(["enrollment_id"], [Enrollment.id]),
        ForeignKeyConstraint(["enrollment_id", "session"], [Session.enrollment_id, Session.number]),
        {"sqlite_autoincrement": True},
    )

    @property
    def problem(self) -> str:
        """What is wrong with a value that this program does not store; empty if nothing is."""
        numbers = (self.azimuth_deg, self.commanded_deg, self.encoder_deg, self.imu_deg, self.imu_sigma_deg)
        if not all(isfinite(number) for number in numbers if number is not None):
            return "an angle is not a finite number"
        if self.index < 0 or not 0 <= self.azimuth_deg < 360:
            return f"the index {self.index} is negative, or the azimuth {self.azimuth_deg}° is not in [0°, 360°)"
        if (self.imu_deg is None) != (self.imu_sigma_deg is None):
            return "imu_deg and imu_sigma_deg: give both or none"
        if (self.imu_sigma_deg or 0.0) < 0:
            return f"imu_sigma_deg is {self.imu_sigma_deg}, a negative uncertainty"
        if self.region is not None and not is_region(self.region):
            return f"the region {self.region} is not x, y, width and height in pixels"
        return ""


class Derived(Row):
    """Something that was computed from the facts of an enrollment (`rig.catalog.derived`). It can be deleted."""

    __tablename__ = "derived"
    seal: Mapped[str] = mapped_column(limited(64), primary_key=True)
    """`Entry.seal` of the enrollment."""
    what: Mapped[str] = mapped_column(limited(100), primary_key=True)
    """Its kind, such as the name of a descriptor."""
    made_by: Mapped[str] = mapped_column(TEXT)
    """The versions and settings of the computation."""
    content: Mapped[bytes] = mapped_column(BYTES)
    sha256: Mapped[str] = mapped_column(limited(64))
    """Of the content."""


FACTS: Final[tuple[type[Row], ...]] = (Entry, Enrollment, Session, View)
"""Rows that are never changed. Lines of the log are never removed, either."""

_STATES, _ENDS = Entry.deleted.is_not(None), Entry.status.is_not(None)
Index("ix_log_states", Entry.object_id, Entry.id, sqlite_where=_STATES, postgresql_where=_STATES)
Index("ix_log_names", Entry.object_name, sqlite_where=_STATES, postgresql_where=_STATES)
Index("ix_log_statuses", Entry.enrollment_id, Entry.id, sqlite_where=_ENDS, postgresql_where=_ENDS)
Index("ix_log_ends", Entry.object_id, sqlite_where=_ENDS, postgresql_where=_ENDS)
Index("ix_log_actions", Entry.action, Entry.id)


@event.listens_for(Row, "load", propagate=True)
def _check_required(row: Row, _context: object) -> None:
    """Raise `CatalogDamaged` for a value that is missing: a sender can make a table that allows it."""
    for name in _required(type(row)):
        if getattr(row, name) is None:
            raise damaged(f"{name} of a row", None)


@cache
def _required(table: type[Row]) -> tuple[str, ...]:
    mapper = inspect(table)
    return tuple(mapper.get_property_by_column(column).key for column in mapper.columns if not column.nullable)


_LOCAL: Final = {"id", "enrollment_id", "object_id", "digest"}
"""Columns of an enrollment and its parts that differ from catalog to catalog, and the digest itself."""


def json_text(value: Any) -> str:
    """Return JSON as a catalog stores it: equal values have equal texts, and so equal digests."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def digested(table: type[Row]) -> list[tuple[str, ColumnElement[Any]]]:
    """Return the columns that a digest covers, with the names of their attributes."""
    left_out = {"digest"} if table is Entry else _LOCAL
    return [
        ("index" if column.name == "view_index" else column.name, column)
        for column in table.__table__.columns
        if column.name not in left_out
    ]


def digest_of(row: Row, key: str) -> str:
    """Return the digest of a row of the enrollment ``key``, or of a line of the log after the line with this digest."""
    source = row.provenance if isinstance(row, Session) else row
    values = (
        _as_stored(column, getattr(row if hasattr(row, name) else source, name)) for name, column in digested(type(row))
    )
    return sha256_of((key, *values))


def seal_of(enrollment: Enrollment) -> str:
    """Return the digest of an enrollment with its sessions and views, by their own digests."""
    parts: Sequence[Session | View] = (*enrollment.sessions, *enrollment.views)
    return sha256_of((enrollment.digest, *(part.digest for part in parts)))


def _as_stored(column: ColumnElement[Any], value: Any) -> Any:
    """Return a value as both databases give it without its type (`rig.catalog.digests`)."""
    if value is None:
        return None
    if isinstance(stored_type(column), JSON):
        return json_text(value)
    if isinstance(value, datetime):
        return value.astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S.%f")
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float):
        return value + 0.0  # a database stores −0.0 as 0.0
    return str(value) if isinstance(value, StrEnum) else value


def sha256_of(values: Sequence[Any]) -> str:
    """Return the digest of some values."""
    return hashlib.sha256(ascii(values).encode()).hexdigest()
