"""Deletion that can be undone, several descriptors per view, views that were not taken by a bench, and the audit log.

The tables are rebuilt as in SQLite's manual ("Making Other Kinds Of Table Schema Changes"): created under another name,
filled, and renamed after the old one is dropped.
"""

from typing import Final

from alembic import op

revision = "2"
down_revision = "1"

_OBJECTS: Final = """
CREATE TABLE new_objects (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
	name VARCHAR(100) NOT NULL,
	label TEXT NOT NULL,
	note TEXT NOT NULL,
	created_utc DATETIME NOT NULL,
	deleted_utc DATETIME
)
"""

_VIEWS: Final = """
CREATE TABLE new_views (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
	enrollment_id INTEGER NOT NULL,
	view_index INTEGER NOT NULL CONSTRAINT ck_views_view_index CHECK (view_index >= 0),
	sitting_id INTEGER NOT NULL,
	commanded_deg FLOAT,
	encoder_deg FLOAT,
	imu_deg FLOAT,
	imu_sigma_deg FLOAT,
	azimuth_deg FLOAT NOT NULL CONSTRAINT ck_views_azimuth_deg CHECK (azimuth_deg >= 0 AND azimuth_deg < 360),
	captured_utc DATETIME,
	captured_ns BIGINT,
	image TEXT NOT NULL,
	image_sha256 VARCHAR(64) NOT NULL,
	image_bytes INTEGER NOT NULL,
	evidence JSON NOT NULL,
	front_end JSON,
	CONSTRAINT uq_views_enrollment_id_view_index UNIQUE (enrollment_id, view_index),
	CONSTRAINT fk_views_enrollment_id FOREIGN KEY(enrollment_id) REFERENCES enrollments (id),
	CONSTRAINT fk_views_sitting_id FOREIGN KEY(sitting_id) REFERENCES sittings (id)
)
"""

_DESCRIPTORS: Final = """
CREATE TABLE descriptors (
	view_id INTEGER NOT NULL,
	name TEXT NOT NULL,
	version INTEGER NOT NULL,
	settings JSON NOT NULL,
	packed BLOB NOT NULL,
	CONSTRAINT pk_descriptors PRIMARY KEY (view_id, name, version),
	CONSTRAINT fk_descriptors_view_id FOREIGN KEY(view_id) REFERENCES views (id)
) WITHOUT ROWID
"""

_AUDIT: Final = """
CREATE TABLE audit (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
	time_utc DATETIME NOT NULL,
	user TEXT NOT NULL,
	host TEXT NOT NULL,
	software TEXT NOT NULL,
	action TEXT NOT NULL,
	object_name TEXT,
	details JSON NOT NULL
)
"""

_KEPT: Final = (
    "id, enrollment_id, view_index, sitting_id, commanded_deg, encoder_deg, imu_deg, imu_sigma_deg, azimuth_deg, "
    "captured_utc, captured_ns, image, image_sha256, image_bytes, evidence"
)


def upgrade() -> None:
    """Rebuild objects and views; move descriptors into a table of their own."""
    for statement in (
        _DESCRIPTORS,
        # images were described within the region in the configuration of their sitting
        """
        INSERT INTO descriptors
        SELECT views.id, descriptor_kind, descriptor_version,
               CASE WHEN json_extract(conditions, '$.view.roi') IS NULL THEN '{}'
                    ELSE json_object('region', json(json_extract(conditions, '$.view.roi'))) END,
               descriptor
        FROM views JOIN sittings ON sittings.id = views.sitting_id
        """,
        _OBJECTS,
        "INSERT INTO new_objects SELECT id, name, label, note, created_utc, NULL FROM objects",
        _VIEWS,
        f"INSERT INTO new_views SELECT {_KEPT}, NULL FROM views",
    ):
        op.execute(statement)
    for table in ("objects", "views"):
        # an id that was given once must not be given again
        op.execute(
            f"UPDATE sqlite_sequence SET seq = max(seq, (SELECT seq FROM sqlite_sequence WHERE name = '{table}')) "
            f"WHERE name = 'new_{table}'"
        )
        op.execute(f"DROP TABLE {table}")
        op.execute(f"ALTER TABLE new_{table} RENAME TO {table}")
    op.execute("CREATE UNIQUE INDEX uq_objects_name ON objects (name) WHERE deleted_utc IS NULL")
    op.execute("CREATE INDEX ix_views_sitting_id ON views (sitting_id)")
    for column in ("reference_image TEXT", "reference_image_sha256 VARCHAR(64)", "reference_image_bytes INTEGER"):
        op.execute(f"ALTER TABLE sittings ADD COLUMN {column}")
    op.execute(_AUDIT)
    for change in ("UPDATE", "DELETE"):
        op.execute(
            f"CREATE TRIGGER audit_no_{change.lower()} BEFORE {change} ON audit "
            "BEGIN SELECT RAISE(ABORT, 'the audit log is only appended to'); END"
        )
