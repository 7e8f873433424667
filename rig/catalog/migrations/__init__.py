"""Steps from one version of the tables to the next: alembic modules whose revision is the version.

The version of a catalog is its `PRAGMA user_version`. Alembic's own version table is not used.
"""
