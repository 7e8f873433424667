"""The first version of the tables. No catalog is older."""

revision = "1"
down_revision = None


def upgrade() -> None:
    """Do nothing."""
