"""Steps from one version of the tables to the next, one module each, in alembic's form; the revision is the version.

A catalog tells its version by itself (`PRAGMA user_version`), so alembic's own version table is not used.
"""
