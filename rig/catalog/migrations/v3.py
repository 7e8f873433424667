"""Rename sittings to sessions, reference images to empty-table images, and front_end to segmentation.

The tables are rebuilt as in step 2, so that the names of their constraints change, too. The sentences of a segmentation
become codes. Objects, enrollments and the audit log get digests.
"""

import json
import re
from typing import Final

from alembic import op

from rig.catalog.schema import append_only_triggers, audit
from rig.catalog.seal import seal_appended, seal_enrollments, seal_objects
from rig.views.segmentation_evidence import upgrade_evidence

revision = "3"
down_revision = "2"

_RENAMED: Final = {"sitting": "session", "reference_image": "empty_table_image", "front_end": "segmentation"}


def upgrade() -> None:
    """Rebuild both tables with the new names, then convert the stored segmentations."""
    connection = op.get_bind()
    for table in ("views", "sittings"):
        statements = connection.exec_driver_sql(
            "SELECT sql FROM sqlite_master WHERE tbl_name = ? AND sql IS NOT NULL ORDER BY type DESC", (table,)
        ).scalars()
        create_table, *create_indexes = [
            re.sub("|".join(_RENAMED), lambda old: _RENAMED[old[0]], s) for s in statements
        ]
        new = table.replace("sitting", "session")
        connection.exec_driver_sql(re.sub(r"CREATE TABLE \"?\w+\"?", "CREATE TABLE rebuilt", create_table))
        connection.exec_driver_sql(f"INSERT INTO rebuilt SELECT * FROM {table}")
        # An id that was given once must not be given again.
        connection.exec_driver_sql("DELETE FROM sqlite_sequence WHERE name = 'rebuilt'")
        connection.exec_driver_sql(
            "INSERT INTO sqlite_sequence SELECT 'rebuilt', seq FROM sqlite_sequence WHERE name = ?", (table,)
        )
        connection.exec_driver_sql(f"DROP TABLE {table}")
        connection.exec_driver_sql(f"ALTER TABLE rebuilt RENAME TO {new}")
        for statement in create_indexes:
            connection.exec_driver_sql(statement)
    stored = connection.exec_driver_sql("SELECT id, segmentation FROM views WHERE segmentation IS NOT NULL").all()
    for view_id, segmentation in stored:
        converted = json.dumps(upgrade_evidence(json.loads(segmentation)))
        connection.exec_driver_sql("UPDATE views SET segmentation = ? WHERE id = ?", (converted, view_id))
    for trigger in ("audit_no_update", "audit_no_delete"):
        connection.exec_driver_sql(f"DROP TRIGGER {trigger}")
    for table in ("objects", "enrollments", "audit"):
        connection.exec_driver_sql(f"ALTER TABLE {table} ADD COLUMN digest VARCHAR(64)")
    for trigger in append_only_triggers("audit"):
        connection.exec_driver_sql(trigger)
    seal_objects(connection, None)
    seal_enrollments(connection, None)
    seal_appended(connection, audit)
