"""The tables of a catalog."""

from datetime import UTC, datetime
from typing import Final

from sqlalchemy import (
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
)

from rig.catalog.records import MAX_NAME_LENGTH, EnrollmentStatus

APPLICATION_ID: Final = 0x48425247
"""``HBRG``: marks the SQLite file as a catalog (`PRAGMA application_id`)."""

SCHEMA_VERSION: Final = 1
"""Version of the tables below (`PRAGMA user_version`)."""

DESCRIPTOR_KIND: Final = "cedd"
DESCRIPTOR_VERSION: Final = 1
"""Raised when `hbr.describe` changes its answer for an image."""


class Utc(TypeDecorator[datetime]):
    """Aware civil time, stored as UTC; SQLite itself would drop the zone."""

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

# Ids are named elsewhere (image folders, saved runs), so none is given twice, even after a deletion: autoincrement.
objects = Table(
    "objects",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("name", String(MAX_NAME_LENGTH), nullable=False, unique=True),
    Column("label", Text, nullable=False),
    Column("note", Text, nullable=False),
    Column("created_utc", Utc, nullable=False),
    sqlite_autoincrement=True,
)

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

# A resumed enrollment may go on with another bench, program or calibration, and the bench's clock starts anew.
sittings = Table(
    "sittings",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("enrollment_id", ForeignKey("enrollments.id"), nullable=False, index=True),
    Column("started_utc", Utc, nullable=False),
    Column("bench", Text, nullable=False),
    Column("software", Text, nullable=False),
    Column("devices", JSON, nullable=False),
    Column("conditions", JSON, nullable=False),
)

views = Table(
    "views",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("enrollment_id", ForeignKey("enrollments.id"), nullable=False),
    Column("view_index", Integer, CheckConstraint("view_index >= 0", name="view_index"), nullable=False),
    Column("sitting_id", ForeignKey("sittings.id"), nullable=False, index=True),
    Column("commanded_deg", Float, nullable=False),
    Column("encoder_deg", Float, nullable=False),
    Column("imu_deg", Float),
    Column("imu_sigma_deg", Float),
    Column(
        "azimuth_deg",
        Float,
        CheckConstraint("azimuth_deg >= 0 AND azimuth_deg < 360", name="azimuth_deg"),
        nullable=False,
    ),
    Column("descriptor_kind", Text, nullable=False),
    Column("descriptor_version", Integer, nullable=False),
    Column("descriptor", LargeBinary, CheckConstraint("length(descriptor) = 54", name="descriptor"), nullable=False),
    Column("captured_utc", Utc, nullable=False),
    Column("captured_ns", BigInteger, nullable=False),
    Column("image", Text, nullable=False),
    Column("image_sha256", String(64), nullable=False),
    Column("image_bytes", Integer, nullable=False),
    Column("evidence", JSON, nullable=False),
    UniqueConstraint("enrollment_id", "view_index"),
    sqlite_autoincrement=True,
)
