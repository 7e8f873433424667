"""Catalogs on a server are migrated by the same steps, completely or not at all, while other benches use them."""

import shutil
import uuid
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest
from sqlalchemy import Connection, inspect, text

from rig.catalog import Catalog, database, migrate, migrations
from rig.catalog import postgres as postgres_module
from rig.catalog.copying import copy_catalog
from rig.catalog.local_copy import open_copy, update_copy
from rig.catalog.postgres import migrate_server
from rig.catalog.schema import METADATA, SCHEMA_VERSION
from rig.catalog.verify import verify
from rig.config.catalog_place import CatalogPlace
from rig.core.errors import CatalogBusy, CatalogDamaged, CatalogError, CatalogOutdated
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import finished, true_fill
from tests.rig.catalog.test_migration import DUMPS, catalog_of_version
from tests.servers.postgres import PostgresServer, place_in

NEXT = SCHEMA_VERSION + 1
STEP = f"""
import sqlalchemy
from alembic import op

revision, down_revision = "{NEXT}", "{SCHEMA_VERSION}"


def upgrade():
    op.create_table("shelves", sqlalchemy.Column("id", sqlalchemy.Integer, primary_key=True))
    with op.batch_alter_table("objects") as objects:
        objects.add_column(sqlalchemy.Column("shelf", sqlalchemy.Integer))
    op.create_index("objects_of_shelves", "objects", ["shelf"])
"""


@pytest.fixture
def place(postgres: PostgresServer, tmp_path: Path) -> CatalogPlace:
    return place_in(postgres.url, tmp_path / uuid.uuid4().hex)


@pytest.fixture
def newer_program(tmp_path: Path) -> Iterator[None]:
    """Work as a program with one more step of migration."""
    folder = tmp_path / "steps"
    shutil.copytree(Path(migrations.__file__).parent, folder)
    (folder / f"v{NEXT}.py").write_text(STEP)
    with pytest.MonkeyPatch.context() as patch:
        migrating = import_module("rig.catalog.migrate")  # the package has a function of this name
        patch.setattr(migrating, "migrations", SimpleNamespace(__file__=str(folder / "__init__.py")))
        for module in (migrating, postgres_module, database):
            patch.setattr(module, "SCHEMA_VERSION", NEXT)
        yield


def columns(catalog: Catalog) -> set[str]:
    with catalog.database.read() as connection:
        found = inspect(connection)
        return {f"{table}.{one['name']}" for table in found.get_table_names() for one in found.get_columns(table)}


@pytest.fixture
def bench(place: CatalogPlace) -> Iterator[Catalog]:
    """A bench with this version of the program."""
    with Catalog.open(place, clock=VirtualClock()) as catalog:
        true_fill(catalog, "mug", 2, 0)
        yield catalog


@pytest.mark.usefixtures("bench", "newer_program")  # in this order
def test_step_runs_while_other_benches_use_the_catalog(bench: Catalog, place: CatalogPlace) -> None:
    before = columns(bench)
    with bench.database.read() as reading:
        assert reading.scalar(text("SELECT count(*) FROM objects")) == 1
        with pytest.raises(CatalogOutdated, match=f"version {SCHEMA_VERSION}"):
            Catalog.open(place, clock=VirtualClock())
        # A search that has a table open must not make the migration wait for ever.
        with pytest.raises(CatalogBusy, match="Another process"):
            migrate(place, clock=VirtualClock(), busy_timeout_s=0.1)
        reading.rollback()
        done = migrate(place, clock=VirtualClock())
        assert (done.before, done.after, done.backup) == (SCHEMA_VERSION, NEXT, None)
        assert migrate(place, clock=VirtualClock()).before == NEXT
        for attempt in (bench.objects, lambda: true_fill(bench, "tin", 1, 9)):
            with pytest.raises(CatalogError, match="was migrated to version"):
                attempt()
    with Catalog.open(place, clock=VirtualClock()) as catalog:
        assert columns(catalog) - before == {"shelves.id", "objects.shelf"}
        assert [one.name for one in catalog.objects()] == ["mug"]
        assert catalog.damage() is None
        assert [entry.action for entry in catalog.log()][-1] == "migrated"


def test_failed_step_changes_nothing(place: CatalogPlace, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(connection: Connection, _: int) -> None:
        connection.execute(text("CREATE TABLE shelves (id integer)"))
        raise KeyboardInterrupt

    with Catalog.open(place, clock=VirtualClock()) as catalog:
        true_fill(catalog, "mug", 2, 0)
        before = columns(catalog)
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(postgres_module, "SCHEMA_VERSION", NEXT)
            migrate_server(place, VirtualClock(), broken, 1.0)
        assert columns(catalog) == before
        assert catalog.damage() is None


@pytest.mark.parametrize("version", DUMPS)
def test_catalog_of_each_earlier_version_moves_to_a_server(place: CatalogPlace, version: int, tmp_path: Path) -> None:
    clock = VirtualClock()
    old = catalog_of_version(version, tmp_path / "old")
    with Catalog.open(place, clock=clock) as shared:
        with (
            pytest.raises(CatalogOutdated, match="earlier program"),
            Catalog.open(old, clock=clock, read_only=True) as source,
        ):
            finished(copy_catalog(source, shared))
        migrate(old, clock=clock)
        with Catalog.open(old, clock=clock, read_only=True) as source:
            finished(copy_catalog(source, shared))
            assert shared.version() == source.version()
            assert shared.objects() == source.objects()
        update_copy(shared)
        with open_copy(place, clock) as copy:
            assert copy.damage() is None
            assert copy.version() == shared.version()
        assert finished(verify(shared, jobs=1)).findings == finished(verify(source, jobs=1)).findings
        assert {one.name for one in METADATA.sorted_tables} <= {one.partition(".")[0] for one in columns(shared)}


def test_version_that_no_server_could_have_is_damage(place: CatalogPlace) -> None:
    with Catalog.open(place, clock=VirtualClock()) as catalog, catalog.database.write() as connection:
        connection.execute(text("UPDATE catalog_properties SET value = '3' WHERE key = 'version'"))
    for attempt in (lambda: Catalog.open(place, clock=VirtualClock()), lambda: migrate(place, clock=VirtualClock())):
        with pytest.raises(CatalogDamaged, match="version"):
            attempt()
