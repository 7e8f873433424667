"""Catalogs and bundles with arbitrary values are read or rejected: no traceback, and nothing outside their place."""

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from rig.catalog import Catalog
from rig.catalog.exchange.bundle import read_bundle, write_bundle
from rig.catalog.facts import SCHEMA_VERSION, View
from rig.catalog.results import correct, record
from rig.catalog.transfer import CatalogSource
from rig.catalog.verify import verify
from rig.config.catalog_place import DATABASE_NAME
from rig.core.errors import ImportRejected, RigError
from sim.clock import VirtualClock
from tests.fuzz.commands import Commands, cases
from tests.fuzzing import fuzz_settings, limited
from tests.rig.catalog import catalog_samples as samples
from tests.rig.catalog.catalog_samples import PROVENANCE, fill, finished, image, new_result, plan, without_waiting
from tests.rig.catalog.exchange.exchange_samples import changed_bundle, facts, import_bundle
from tests.rig.catalog.test_hostile_catalogs import seal_as_the_sender

pytestmark = pytest.mark.timeout(7200)

HOSTILE = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=20),
    st.sampled_from(
        ["", "../x", "/etc/passwd", "images/../../x", "images/\0", "\x1b[2J", "9999-12-31T23:59:59-14:00", "1" * 5000]
    ),
    st.sampled_from([[], {}, [[]], {"region": "evil"}, {"issues": 5}, {"view": 7}, 2**63, -(2**70), [None]]),
)


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fuzz")
    with pytest.MonkeyPatch.context() as patch, Catalog.open(folder / "catalog", clock=VirtualClock()) as catalog:
        without_waiting(patch)
        fill(catalog, "mug", 2, 0, (2, 0, 20, 20))
        tin = catalog.begin("tin", planned_azimuth_deg=plan(2), provenance=PROVENANCE, empty_table=image(9))
        tin.add(samples.record(0), image(3))
        record(catalog, new_result(), image(4))
        correct(catalog, 1, object_name="tin", reason="read the label")
        write_bundle(folder / "good.zip", CatalogSource(catalog))
    return folder


@pytest.fixture(autouse=True, scope="module")
def _fast() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        without_waiting(patch)
        yield


def in_sql(value: Any) -> Any:
    if isinstance(value, list | dict):
        return json.dumps(value)
    return str(value) if isinstance(value, int) and not -(2**63) <= value < 2**63 else value


def spoil(file: Path, kind: str, data: st.DataObject) -> None:
    """Damage a database."""
    if kind == "bytes":
        content = bytearray(file.read_bytes())
        for _ in range(data.draw(st.integers(1, 4))):
            content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
        file.write_bytes(content)
        return
    with closing(sqlite3.connect(file, isolation_level=None)) as connection:
        connection.execute("PRAGMA ignore_check_constraints = ON")
        connection.execute("PRAGMA foreign_keys = OFF")
        triggers = connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'").fetchall()
        tables = [
            name
            for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
            if not name.startswith("sqlite_")
        ]
        table = data.draw(st.sampled_from(sorted(tables)))
        columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
        try:
            if kind == "value":
                for name, _ in triggers:
                    connection.execute(f"DROP TRIGGER {name}")
                value = in_sql(data.draw(HOSTILE))
                connection.execute(f"UPDATE {table} SET {data.draw(st.sampled_from(columns))} = ?", (value,))
                for _, statement in triggers:
                    connection.execute(statement)
            elif kind == "schema":
                connection.execute(data.draw(st.sampled_from(SCHEMAS)).format(table=table, column=columns[-1]))
            else:
                version = data.draw(st.sampled_from([-5, -1, 0, SCHEMA_VERSION, SCHEMA_VERSION + 1, 2**31 - 1]))
                connection.execute(f"PRAGMA user_version = {version}")
        except (sqlite3.Error, UnicodeEncodeError):
            assume(False)


SCHEMAS = [
    "CREATE TRIGGER evil AFTER UPDATE ON {table} BEGIN DELETE FROM {table}; END",
    "CREATE VIEW evil AS SELECT * FROM {table}",
    "CREATE TABLE new_objects (x)",
    "CREATE INDEX evil ON {table} ({column})",
    "ALTER TABLE {table} ADD COLUMN evil",
    "ALTER TABLE {table} RENAME COLUMN {column} TO evil",
]
READ = ["log", "results list", "results show 1", "export a.zip"]
IN_CATALOG = ["show mug", "show mug-white", "list", "verify", "gc --yes"]


@given(
    st.sampled_from(["value", "value", "value", "bytes", "bytes", "schema", "version"]),
    st.sampled_from([*READ, *(f"catalog {words}" for words in IN_CATALOG)]),
    st.data(),
)
@cases(9)
def test_any_catalog_ends_with_a_documented_exit_code(
    commands: Commands, sample: Path, kind: str, command: str, data: st.DataObject
) -> None:
    root = Path(shutil.copytree(sample / "catalog", commands.fresh() / "catalog"))
    spoil(root / DATABASE_NAME, kind, data)
    commands.run(*command.split(), "--bench", "sim")


@given(kind=st.sampled_from(["value", "value", "value", "bytes", "schema", "version"]), data=st.data())
@fuzz_settings(0.06)
def test_bundle_with_any_value_is_imported_or_rejected(
    sample: Path, tmp_path_factory: pytest.TempPathFactory, kind: str, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("victim")

    def change(database: Path) -> None:
        spoil(database, kind, data)
        if kind == "value" and data.draw(st.booleans()):
            try:
                seal_as_the_sender(database.parent)
            except (ValueError, KeyError, TypeError, sqlite3.Error):
                assume(False)

    bundle = changed_bundle(sample / "good.zip", folder / "a.zip", change)
    with limited(), Catalog.open(folder / "catalog", clock=VirtualClock()) as catalog:
        try:
            import_bundle(catalog, bundle)
        except ImportRejected:
            assert catalog.objects() == []
        else:
            assert finished(verify(catalog, jobs=1)).findings == ()
            write_bundle(folder / "b.zip", CatalogSource(catalog))
            with read_bundle(folder / "b.zip", VirtualClock()) as source:
                assert [facts(item) for item in source.items()] == [
                    facts(item) for item in CatalogSource(catalog).items()
                ]
    shutil.rmtree(folder)


@given(
    name=st.text(min_size=1, max_size=30),
    texts=st.tuples(st.text(max_size=50), st.one_of(st.text(max_size=50), st.just("a" * 3_000_000))),
    azimuth_deg=st.floats(0, 360, exclude_max=True),
    evidence=st.dictionaries(
        st.text(max_size=5), st.one_of(st.floats(), st.integers(), st.text(max_size=9)), max_size=3
    ),
    region=st.sampled_from([None, (2, 0, 12, 12), (-1, 0, 5, 5), (0, 0, 0, 5), (0, 0, 16, 12)]),
    captured_ns=st.one_of(st.none(), st.integers(-(10**20), 10**20)),
)
@fuzz_settings(0.03)
def test_everything_that_the_catalog_accepts_survives_export_and_import(
    tmp_path_factory: pytest.TempPathFactory,
    name: str,
    texts: tuple[str, str],
    azimuth_deg: float,
    evidence: dict[str, Any],
    region: tuple[int, int, int, int] | None,
    captured_ns: int | None,
) -> None:
    folder = tmp_path_factory.mktemp("round")
    clock = VirtualClock()
    with (
        limited(),
        Catalog.open(folder / "catalog", clock=clock) as catalog,
        Catalog.open(folder / "copy", clock=clock) as copy,
    ):
        try:
            begun = catalog.begin(name, planned_azimuth_deg=[azimuth_deg], provenance=PROVENANCE)
            view = View(index=0, azimuth_deg=azimuth_deg, evidence=evidence, captured_ns=captured_ns, region=region)
            begun.add(view, image(1))
            begun.finish()
            catalog.set_texts(begun.object_name, label=texts[0], note=texts[1])
        except (RigError, TypeError, OverflowError):
            pass
        if not catalog.objects() or not catalog.objects()[0].views:
            return
        assert write_bundle(folder / "a.zip", CatalogSource(catalog)) == 1
        import_bundle(copy, folder / "a.zip")
        assert [facts(item) for item in CatalogSource(copy).items()] == [
            facts(item) for item in CatalogSource(catalog).items()
        ]
        assert finished(verify(copy, jobs=1)).findings == ()
    shutil.rmtree(folder)
