"""The first tables: where the chain begins. No catalog is older."""

revision = "1"
down_revision = None


def upgrade() -> None:
    """Do nothing."""
