"""The tables of a catalog, and the check that a database has these tables and nothing else."""

import hashlib
import re
import sqlite3
from contextlib import closing
from functools import cache
from typing import Final

from sqlalchemy import (
    DDL,
    CheckConstraint,
    Column,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    StaticPool,
    Table,
    UniqueConstraint,
    create_engine,
    event,
)

from rig.catalog.columns import (
    Azimuths,
    Bytes,
    Count,
    ImagePath,
    JsonMapping,
    Name,
    Nanoseconds,
    Number,
    ResultOutcome,
    SegmentationEvidence,
    Status,
    Utc,
    Words,
)
from rig.catalog.records import MAX_NAME_LENGTH, EnrollmentStatus

APPLICATION_ID: Final = 0x48425247
"""``HBRG``: marks the SQLite file as a catalog (`PRAGMA application_id`)."""

SCHEMA_VERSION: Final = 1
"""Version of the tables below (`PRAGMA user_version`)."""


METADATA: Final = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "ck": "ck_%(table_name)s_%(constraint_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s",
        "pk": "pk_%(table_name)s",
    }
)

# Image folders and saved runs refer to ids. Autoincrement gives no id twice, even after a deletion.
objects = Table(
    "objects",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("name", Name(MAX_NAME_LENGTH), nullable=False),
    Column("label", Words, nullable=False),
    Column("note", Words, nullable=False),
    Column("created_utc", Utc, nullable=False),
    Column("deleted_utc", Utc),  # a deleted object stays until `rig catalog gc`
    Column("digest", Name(64)),  # `rig.catalog.seal`
    sqlite_autoincrement=True,
)

_IN_USE = objects.c.deleted_utc.is_(None)
Index("uq_objects_name", objects.c.name, unique=True, sqlite_where=_IN_USE, postgresql_where=_IN_USE)

_STATUSES = ", ".join(f"'{status}'" for status in EnrollmentStatus)

enrollments = Table(
    "enrollments",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("object_id", ForeignKey("objects.id"), nullable=False, index=True),
    Column("status", Status, CheckConstraint(f"status IN ({_STATUSES})", name="status"), nullable=False),
    Column("started_utc", Utc, nullable=False),
    Column("finished_utc", Utc),
    Column("planned_azimuth_deg", Azimuths, nullable=False),
    Column("digest", Name(64)),  # of this row and of all sessions, views and descriptors of the enrollment
    sqlite_autoincrement=True,
)

for _status in (EnrollmentStatus.COMPLETE, EnrollmentStatus.IN_PROGRESS):
    Index(
        f"uq_enrollments_one_{_status.name.lower()}",
        enrollments.c.object_id,
        unique=True,
        sqlite_where=enrollments.c.status == _status.value,
        postgresql_where=enrollments.c.status == _status.value,
    )

# A resumed enrollment may use another bench, program or calibration, and the bench clock starts again.
sessions = Table(
    "sessions",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("enrollment_id", ForeignKey("enrollments.id"), nullable=False, index=True),
    Column("started_utc", Utc, nullable=False),
    Column("bench", Words, nullable=False),
    Column("software", Words, nullable=False),
    Column("devices", JsonMapping, nullable=False),
    Column("conditions", JsonMapping, nullable=False),
    Column("empty_table_image", ImagePath),
    Column("empty_table_image_sha256", Name(64)),
    Column("empty_table_image_bytes", Count),
)

views = Table(
    "views",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("enrollment_id", ForeignKey("enrollments.id"), nullable=False),
    Column("view_index", Count, CheckConstraint("view_index >= 0", name="view_index"), nullable=False),
    Column("session_id", ForeignKey("sessions.id"), nullable=False, index=True),
    Column("commanded_deg", Number),  # NULL: the view was not taken by a bench
    Column("encoder_deg", Number),
    Column("imu_deg", Number),
    Column("imu_sigma_deg", Number),
    Column(
        "azimuth_deg",
        Number,
        CheckConstraint("azimuth_deg >= 0 AND azimuth_deg < 360", name="azimuth_deg"),
        nullable=False,
    ),
    Column("captured_utc", Utc),
    Column("captured_ns", Nanoseconds),
    Column("image", ImagePath, nullable=False),
    Column("image_sha256", Name(64), nullable=False),
    Column("image_bytes", Count, nullable=False),
    Column("evidence", JsonMapping, nullable=False),
    Column("segmentation", SegmentationEvidence(none_as_null=True)),
    UniqueConstraint("enrollment_id", "view_index"),
    sqlite_autoincrement=True,
)

# Levels of different versions must not be compared. `settings` name the region of the image that is described.
descriptors = Table(
    "descriptors",
    METADATA,
    Column("view_id", ForeignKey("views.id"), primary_key=True),
    Column("name", Words, primary_key=True),
    Column("version", Count, primary_key=True),
    Column("settings", JsonMapping, nullable=False),
    Column("packed", Bytes, nullable=False),
    sqlite_with_rowid=False,
)

audit = Table(
    "audit",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("time_utc", Utc, nullable=False),
    Column("user", Words, nullable=False),
    Column("host", Words, nullable=False),
    Column("software", Words, nullable=False),
    Column("action", Words, nullable=False),
    Column("object_name", Words),
    Column("details", JsonMapping, nullable=False),
    Column("digest", Name(64)),  # of this row and of the digest before
    sqlite_autoincrement=True,
)

# Answers of identifications. Names stay as they were answered, so no row refers to an object.
results = Table(
    "results",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("time_utc", Utc, nullable=False),
    Column("operator", Words, nullable=False),
    Column("user", Words, nullable=False),
    Column("host", Words, nullable=False),
    Column("software", Words, nullable=False),
    Column("sample", Words),
    Column("outcome", ResultOutcome, nullable=False),
    Column("object_name", Words),
    Column("answer", JsonMapping, nullable=False),  # the event `identified` (docs/events.md)
    Column("azimuths_deg", Azimuths, nullable=False),  # of the views, from any zero
    Column("bench", Words, nullable=False),
    Column("devices", JsonMapping, nullable=False),
    Column("conditions", JsonMapping, nullable=False),
    Column("catalog_version", Name(64), nullable=False),  # `Catalog.version`
    Column("image", ImagePath),  # the first view
    Column("image_sha256", Name(64)),
    Column("image_bytes", Count),
    Column("digest", Name(64)),  # of this row and of the digest before
    sqlite_autoincrement=True,
)

# The last correction of a result counts; the result itself does not change. With a foreign key, a repair could delete
# rows.
corrections = Table(
    "corrections",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("result_id", Count, nullable=False),
    Column("time_utc", Utc, nullable=False),
    Column("operator", Words, nullable=False),
    Column("user", Words, nullable=False),
    Column("host", Words, nullable=False),
    Column("software", Words, nullable=False),
    Column("sample", Words),
    Column("outcome", ResultOutcome, nullable=False),
    Column("object_name", Words),
    Column("reason", Words, nullable=False),
    Column("digest", Name(64)),
    sqlite_autoincrement=True,
)

APPEND_ONLY: Final = (audit, results, corrections)
"""Tables whose rows are never changed or deleted."""


def append_only_triggers(table: str) -> tuple[str, str]:
    """Return the statements that create the triggers of an append-only table."""
    what = "audit log" if table == audit.name else f"table of {table}"
    return (
        f"CREATE TRIGGER {table}_no_update BEFORE UPDATE ON {table} WHEN old.digest IS NOT NULL "
        f"BEGIN SELECT RAISE(ABORT, 'the {what} is only appended to'); END",
        f"CREATE TRIGGER {table}_no_delete BEFORE DELETE ON {table} "
        f"BEGIN SELECT RAISE(ABORT, 'the {what} is only appended to'); END",
    )


def append_only_rules(table: str) -> tuple[str, ...]:
    """Return the statements that do the same in PostgreSQL."""
    what = "audit log" if table == audit.name else f"table of {table}"
    return (
        f"CREATE FUNCTION {table}_no_change() RETURNS trigger LANGUAGE plpgsql AS "
        f"$$ BEGIN RAISE EXCEPTION 'the {what} is only appended to'; END $$",
        f"CREATE TRIGGER {table}_no_update BEFORE UPDATE ON {table} FOR EACH ROW WHEN (old.digest IS NOT NULL) "
        f"EXECUTE FUNCTION {table}_no_change()",
        f"CREATE TRIGGER {table}_no_delete BEFORE DELETE ON {table} FOR EACH ROW EXECUTE FUNCTION {table}_no_change()",
        f"CREATE TRIGGER {table}_no_truncate BEFORE TRUNCATE ON {table} EXECUTE FUNCTION {table}_no_change()",
    )


for _table in APPEND_ONLY:
    for _dialect, _statements in (
        ("sqlite", append_only_triggers(_table.name)),
        ("postgresql", append_only_rules(_table.name)),
    ):
        for _statement in _statements:
            event.listen(_table, "after_create", DDL(_statement).execute_if(dialect=_dialect))  # type: ignore[no-untyped-call]

KNOWN_NAMES: Final = frozenset(
    {"sqlite_sequence", *(f"{table.name}_no_{change}" for table in APPEND_ONLY for change in ("update", "delete"))}
    | {name for table in METADATA.tables.values() for name in (table.name, *(str(one.name) for one in table.indexes))}
)
"""Names in a database of this version."""


def schema_digest(connection: sqlite3.Connection) -> str:
    """Return the SHA-256 of the definitions of all tables, indexes, triggers and views, without their white space."""
    rows = connection.execute("SELECT type, name, tbl_name, sql FROM sqlite_master").fetchall()
    definitions = sorted(ascii((*row[:3], re.sub(r'[\s"]+', "", str(row[3])))) for row in rows)
    return hashlib.sha256("\n".join(definitions).encode()).hexdigest()


@cache
def expected_schema() -> str:
    """Return the `schema_digest` of a new catalog."""
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        METADATA.create_all(create_engine("sqlite://", creator=lambda: connection, poolclass=StaticPool))
        return schema_digest(connection)
