"""Sessions in place of sittings, empty-table images in place of reference images, segmentation issues as codes.

The two tables are rebuilt as in step 2.
"""

import json
from typing import Final

from alembic import op

from rig.views.segmentation_evidence import upgrade_evidence

revision = "3"
down_revision = "2"

_SESSIONS: Final = """
CREATE TABLE sessions (
	id INTEGER NOT NULL,
	enrollment_id INTEGER NOT NULL,
	started_utc DATETIME NOT NULL,
	bench TEXT NOT NULL,
	software TEXT NOT NULL,
	devices JSON NOT NULL,
	conditions JSON NOT NULL,
	empty_table_image TEXT,
	empty_table_image_sha256 VARCHAR(64),
	empty_table_image_bytes INTEGER,
	CONSTRAINT pk_sessions PRIMARY KEY (id),
	CONSTRAINT fk_sessions_enrollment_id FOREIGN KEY(enrollment_id) REFERENCES enrollments (id)
)
"""

_VIEWS: Final = """
CREATE TABLE new_views (
	id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
	enrollment_id INTEGER NOT NULL,
	view_index INTEGER NOT NULL CONSTRAINT ck_views_view_index CHECK (view_index >= 0),
	session_id INTEGER NOT NULL,
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
	segmentation JSON,
	CONSTRAINT uq_views_enrollment_id_view_index UNIQUE (enrollment_id, view_index),
	CONSTRAINT fk_views_enrollment_id FOREIGN KEY(enrollment_id) REFERENCES enrollments (id),
	CONSTRAINT fk_views_session_id FOREIGN KEY(session_id) REFERENCES sessions (id)
)
"""

_OLD_VIEW: Final = (
    "id, enrollment_id, view_index, sitting_id, commanded_deg, encoder_deg, imu_deg, imu_sigma_deg, azimuth_deg, "
    "captured_utc, captured_ns, image, image_sha256, image_bytes, evidence, front_end"
)
_OLD_SITTING: Final = (
    "id, enrollment_id, started_utc, bench, software, devices, conditions, "
    "reference_image, reference_image_sha256, reference_image_bytes"
)


def upgrade() -> None:
    """Rebuild sittings as sessions and views with the new names, then convert the stored segmentations."""
    op.execute(_SESSIONS)
    op.execute(f"INSERT INTO sessions SELECT {_OLD_SITTING} FROM sittings")
    op.execute(_VIEWS)
    op.execute(f"INSERT INTO new_views SELECT {_OLD_VIEW} FROM views")
    # An id that was given once must not be given again.
    op.execute("DELETE FROM sqlite_sequence WHERE name = 'new_views'")
    op.execute(
        "INSERT INTO sqlite_sequence (name, seq) SELECT 'new_views', seq FROM sqlite_sequence WHERE name = 'views'"
    )
    op.execute("DROP TABLE views")
    op.execute("DROP TABLE sittings")
    op.execute("ALTER TABLE new_views RENAME TO views")
    op.execute("CREATE INDEX ix_sessions_enrollment_id ON sessions (enrollment_id)")
    op.execute("CREATE INDEX ix_views_session_id ON views (session_id)")
    connection = op.get_bind()
    stored = connection.exec_driver_sql("SELECT id, segmentation FROM views WHERE segmentation IS NOT NULL").all()
    for view_id, segmentation in stored:
        converted = json.dumps(upgrade_evidence(json.loads(segmentation)))
        connection.exec_driver_sql("UPDATE views SET segmentation = ? WHERE id = ?", (converted, view_id))
