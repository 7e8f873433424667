"""The tables of a catalog."""

from datetime import UTC, datetime
from typing import Final

from sqlalchemy import (
    DDL,
    JSON,
    BigInteger,
    CheckConstraint,
    Column,
    DateTime,
    Dialect,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    TypeDecorator,
    UniqueConstraint,
    event,
)

from rig.catalog.records import MAX_NAME_LENGTH, EnrollmentStatus

APPLICATION_ID: Final = 0x48425247
"""``HBRG``: marks the SQLite file as a catalog (`PRAGMA application_id`)."""

SCHEMA_VERSION: Final = 3
"""Version of the tables below (`PRAGMA user_version`). `rig.catalog.migrations` has a step for each version."""


class Utc(TypeDecorator[datetime]):
    """Time with a time zone, stored as UTC. SQLite itself would drop the zone."""

    impl = DateTime
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        return value if value is None else value.astimezone(UTC).replace(tzinfo=None)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        return value if value is None else value.replace(tzinfo=UTC)


METADATA: Final = MetaData(
    naming_convention={  # migrations address constraints by name
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
    Column("name", String(MAX_NAME_LENGTH), nullable=False),
    Column("label", Text, nullable=False),
    Column("note", Text, nullable=False),
    Column("created_utc", Utc, nullable=False),
    Column("deleted_utc", Utc),  # a deleted object stays until `rig catalog gc`
    sqlite_autoincrement=True,
)

Index("uq_objects_name", objects.c.name, unique=True, sqlite_where=objects.c.deleted_utc.is_(None))

_STATUSES = ", ".join(f"'{status}'" for status in EnrollmentStatus)

enrollments = Table(
    "enrollments",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("object_id", ForeignKey("objects.id"), nullable=False, index=True),
    Column("status", Text, CheckConstraint(f"status IN ({_STATUSES})", name="status"), nullable=False),
    Column("started_utc", Utc, nullable=False),
    Column("finished_utc", Utc),
    Column("planned_azimuth_deg", JSON, nullable=False),
    sqlite_autoincrement=True,
)

for _status in (EnrollmentStatus.COMPLETE, EnrollmentStatus.IN_PROGRESS):
    Index(
        f"uq_enrollments_one_{_status.name.lower()}",
        enrollments.c.object_id,
        unique=True,
        sqlite_where=enrollments.c.status == _status.value,
    )

# A resumed enrollment may use another bench, program or calibration, and the bench clock starts again.
sessions = Table(
    "sessions",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("enrollment_id", ForeignKey("enrollments.id"), nullable=False, index=True),
    Column("started_utc", Utc, nullable=False),
    Column("bench", Text, nullable=False),
    Column("software", Text, nullable=False),
    Column("devices", JSON, nullable=False),
    Column("conditions", JSON, nullable=False),
    Column("empty_table_image", Text),
    Column("empty_table_image_sha256", String(64)),
    Column("empty_table_image_bytes", Integer),
)

views = Table(
    "views",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("enrollment_id", ForeignKey("enrollments.id"), nullable=False),
    Column("view_index", Integer, CheckConstraint("view_index >= 0", name="view_index"), nullable=False),
    Column("session_id", ForeignKey("sessions.id"), nullable=False, index=True),
    Column("commanded_deg", Float),  # NULL: the view was not taken by a bench
    Column("encoder_deg", Float),
    Column("imu_deg", Float),
    Column("imu_sigma_deg", Float),
    Column(
        "azimuth_deg",
        Float,
        CheckConstraint("azimuth_deg >= 0 AND azimuth_deg < 360", name="azimuth_deg"),
        nullable=False,
    ),
    Column("captured_utc", Utc),
    Column("captured_ns", BigInteger),
    Column("image", Text, nullable=False),
    Column("image_sha256", String(64), nullable=False),
    Column("image_bytes", Integer, nullable=False),
    Column("evidence", JSON, nullable=False),
    Column("segmentation", JSON(none_as_null=True)),
    UniqueConstraint("enrollment_id", "view_index"),
    sqlite_autoincrement=True,
)

# Levels of different versions must not be compared. `settings` name the region of the image that is described.
descriptors = Table(
    "descriptors",
    METADATA,
    Column("view_id", ForeignKey("views.id"), primary_key=True),
    Column("name", Text, primary_key=True),
    Column("version", Integer, primary_key=True),
    Column("settings", JSON, nullable=False),
    Column("packed", LargeBinary, nullable=False),
    sqlite_with_rowid=False,
)

audit = Table(
    "audit",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("time_utc", Utc, nullable=False),
    Column("user", Text, nullable=False),
    Column("host", Text, nullable=False),
    Column("software", Text, nullable=False),
    Column("action", Text, nullable=False),
    Column("object_name", Text),
    Column("details", JSON, nullable=False),
    sqlite_autoincrement=True,
)

APPEND_ONLY: Final = tuple(
    f"CREATE TRIGGER audit_no_{change.lower()} BEFORE {change} ON audit "
    "BEGIN SELECT RAISE(ABORT, 'the audit log is only appended to'); END"
    for change in ("UPDATE", "DELETE")
)

for _trigger in APPEND_ONLY:
    event.listen(audit, "after_create", DDL(_trigger))  # type: ignore[no-untyped-call]
