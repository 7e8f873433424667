"""Tables for results and their corrections. Nothing else changes."""

from alembic import op

from rig.catalog.schema import append_only_triggers

revision = "4"
down_revision = "3"

_TABLES = (
    """
    CREATE TABLE results (
        id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
        time_utc DATETIME NOT NULL,
        operator TEXT NOT NULL,
        user TEXT NOT NULL,
        host TEXT NOT NULL,
        software TEXT NOT NULL,
        sample TEXT,
        outcome TEXT NOT NULL,
        object_name TEXT,
        answer JSON NOT NULL,
        azimuths_deg JSON NOT NULL,
        bench TEXT NOT NULL,
        devices JSON NOT NULL,
        conditions JSON NOT NULL,
        catalog_version VARCHAR(64) NOT NULL,
        image TEXT,
        image_sha256 VARCHAR(64),
        image_bytes INTEGER,
        digest VARCHAR(64)
    )
    """,
    """
    CREATE TABLE corrections (
        id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
        result_id INTEGER NOT NULL,
        time_utc DATETIME NOT NULL,
        operator TEXT NOT NULL,
        user TEXT NOT NULL,
        host TEXT NOT NULL,
        software TEXT NOT NULL,
        sample TEXT,
        outcome TEXT NOT NULL,
        object_name TEXT,
        reason TEXT NOT NULL,
        digest VARCHAR(64)
    )
    """,
)


def upgrade() -> None:
    """Create the tables and their triggers."""
    for statement in (*_TABLES, *append_only_triggers("results"), *append_only_triggers("corrections")):
        op.execute(statement)
