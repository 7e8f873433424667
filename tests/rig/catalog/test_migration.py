"""Catalogs that earlier versions of the program wrote become catalogs of today. A backup stays."""

import re
import shutil
import sqlite3
import zipfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import hbr
from rig.catalog import Catalog, EnrollmentStatus, migrate
from rig.catalog.exchange import import_objects, plan_import, read_bundle
from rig.catalog.results import find_results
from rig.catalog.results import record as record_result
from rig.catalog.schema import SCHEMA_VERSION
from rig.catalog.upkeep import statistics
from rig.catalog.verify import verify
from rig.core.errors import CatalogBusy, CatalogDamaged, CatalogError, CatalogOutdated
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import PROVENANCE, finished, image, new_result, record

pytestmark = pytest.mark.sqlite

DATA = Path(__file__).parent / "data"
DUMPS = {1: DATA / "catalog-v1" / "catalog.sql", 2: DATA / "catalog-v2.sql", 3: DATA / "catalog-v3.sql"}
BUNDLE = DATA / "bundle-v1.rigcat.zip"
"""A bundle that version 0.1 wrote from the catalog of ``catalog-v2.sql``; its images are those of the catalog."""


def catalog_of_version(version: int, root: Path) -> Path:
    """Restore a sample catalog from its dump and its images."""
    if version == 1:
        shutil.copytree(DATA / "catalog-v1" / "images", root / "images")
    else:
        with zipfile.ZipFile(BUNDLE) as bundle:
            bundle.extractall(root, [name for name in bundle.namelist() if name.startswith("images/")])
        for number in (1, 3):
            (empty_table,) = root.glob(f"images/{number:06d}-*/*/empty-000.png")
            empty_table.rename(empty_table.with_name(f"empty-{number:06d}.png"))
    with closing(sqlite3.connect(root / "catalog.sqlite", isolation_level=None)) as connection:
        connection.executescript(DUMPS[version].read_text(encoding="utf-8"))
    return root


@pytest.fixture(params=DUMPS)
def version(request: pytest.FixtureRequest) -> int:
    found: int = request.param
    return found


@pytest.fixture
def old(version: int, tmp_path: Path) -> Path:
    return catalog_of_version(version, tmp_path / "old")


def tables(root: Path) -> dict[str, str]:
    """The SQL of each table and index, without white space."""
    with closing(sqlite3.connect(root / "catalog.sqlite")) as connection:
        rows = connection.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL").fetchall()
    return {name: re.sub(r"[\s\"]+", "", sql) for name, sql in rows}


@pytest.mark.parametrize(("version", "read_only"), [(1, False), (1, True), (2, False), (2, True), (3, False)])
def test_old_catalog_is_not_migrated_unasked(old: Path, version: int, read_only: bool) -> None:
    before = tables(old)
    with pytest.raises(CatalogOutdated) as error:
        Catalog.open(old, clock=VirtualClock(), read_only=read_only)
    assert error.value.evidence == {"found": version, "known": SCHEMA_VERSION}
    assert "rig catalog migrate" in error.value.next_step
    assert tables(old) == before


def test_migration_of_version_1_keeps_everything(tmp_path: Path) -> None:
    old, clock = catalog_of_version(1, tmp_path / "old"), VirtualClock()
    assert migrate(old, clock=clock).before == 1
    with Catalog.open(old, clock=clock) as catalog:
        assert [(o.name, o.label, o.note, o.views, o.unfinished_views) for o in catalog.objects()] == [
            ("mug-white", "kitchen", "a chip at the rim", 4, None),
            ("Tässe 2", "", "", 4, None),
            ("tin", "", "", 0, 2),
        ]
        mug, cup = catalog.object("mug-white"), catalog.object("Tässe 2")
        assert [e.status for e in mug.enrollments] == [EnrollmentStatus.COMPLETE, EnrollmentStatus.SUPERSEDED]
        assert mug.enrollments[0].sessions[0].provenance.devices["camera"] == {"model": "C920", "serial": "A1"}
        for view in (*mug.views, *cup.views):
            pixels = catalog.read_image(view)
            region = view.record.region or (0, 0, 16, 12)
            assert np.array_equal(view.record.descriptors["cedd"], hbr.describe(pixels[:, : region[2]]))
        assert {view.record.region for view in mug.views} == {(0, 0, 12, 12)}
        assert {view.record.region for view in cup.views} == {None}
        assert mug.views[1].record.encoder_deg == 90.03
        assert mug.views[1].record.evidence == {"sharpness": 13.5, "locks_hold": True}
        assert len(catalog.views().views) == 8
        assert [entry.action for entry in catalog.log()] == ["migrated"]
        tin = catalog.resume("tin", provenance=PROVENANCE)
        assert tin.missing() == (2, 3)
        tin.add(record(2), image(32))


def check_objects_of_version_2(catalog: Catalog) -> None:
    assert [(o.name, o.label, o.note, o.views, o.unfinished_views) for o in catalog.objects()] == [
        ("mug-white", "lab", "a chip at the rim", 4, None),
        ("Tässe 2", "", "", 4, None),
        ("tin", "", "", 0, 3),
    ]
    for name in ("cedd", "edges+colours"):
        assert catalog.views(name).views.object_names == ("mug-white", "Tässe 2")
    mug, cup = catalog.object("mug-white"), catalog.object("Tässe 2")
    assert set(mug.views[0].record.descriptors) == {"cedd", "edges+colours"}
    assert mug.views[0].record.region == (4, 0, 40, 40)
    assert mug.views[2].record.imu_sigma_deg == 0.5
    found = [view.record.segmentation for view in (*mug.views[:1], *cup.views[2:3])]
    assert [(one["method"], one["box_px"], [issue["code"] for issue in one["issues"]]) for one in found] == [
        ("empty-table", [9, 11, 18, 22], ["backdrop-several-colours"]),
        ("none", None, ["no-difference"]),
    ]
    assert mug.views[0].session.empty_table_image is not None
    assert mug.views[0].session.provenance.conditions["view"] == {"roi": [4, 0, 40, 40]}
    assert finished(verify(catalog, jobs=1)).findings == ()
    tin = catalog.resume("tin", provenance=PROVENANCE)
    assert len(catalog.object("tin").enrollments[0].sessions) == 3
    assert tin.missing() == (3,)
    tin.add(record(3), image(33)[:, :, :])


@pytest.mark.parametrize("version", [2, 3])
def test_migration_keeps_everything(old: Path, version: int) -> None:
    clock = VirtualClock()
    assert migrate(old, clock=clock).before == version
    with Catalog.open(old, clock=clock) as catalog:
        assert catalog.log()[0].action == "began to enroll"
        check_objects_of_version_2(catalog)
        assert record_result(catalog, new_result(), image(1)) == 1


def test_catalog_of_version_3_is_read_without_a_migration(tmp_path: Path) -> None:
    old = catalog_of_version(3, tmp_path / "old")
    before = (old / "catalog.sqlite").read_bytes()
    with Catalog.open(old, clock=VirtualClock(), read_only=True) as catalog:
        assert catalog.views("edges+colours").views.object_names == ("mug-white", "Tässe 2")
        assert finished(verify(catalog, jobs=1)).findings == ()
        assert (statistics(catalog).schema_version, statistics(catalog).results) == (3, 0)
        with pytest.raises(CatalogOutdated, match="earlier program") as error:
            find_results(catalog)
    assert "rig catalog migrate" in error.value.next_step
    assert (old / "catalog.sqlite").read_bytes() == before


def test_bundle_of_version_1_is_imported(tmp_path: Path) -> None:
    with Catalog.open(tmp_path / "new", clock=VirtualClock()) as catalog:
        finished(import_objects(catalog, plan_import(catalog, read_bundle(BUNDLE)), jobs=1))
        check_objects_of_version_2(catalog)


def test_backup_is_the_old_database(old: Path, version: int) -> None:
    done = migrate(old, clock=VirtualClock())
    assert (done.before, done.after) == (version, SCHEMA_VERSION)
    assert done.backup is not None
    with closing(sqlite3.connect(done.backup)) as backup, closing(sqlite3.connect(":memory:")) as source:
        source.executescript(DUMPS[version].read_text(encoding="utf-8").split("\n", 1)[1])
        assert list(backup.iterdump()) == list(source.iterdump())


def test_migrated_catalog_has_the_tables_of_a_new_one(old: Path, tmp_path: Path) -> None:
    migrate(old, clock=VirtualClock())
    with Catalog.open(tmp_path / "new", clock=VirtualClock()):
        pass
    assert tables(old) == tables(tmp_path / "new")


def test_migration_gives_no_id_twice(old: Path) -> None:
    with closing(sqlite3.connect(old / "catalog.sqlite", isolation_level=None)) as connection:
        connection.execute("UPDATE sqlite_sequence SET seq = 41 WHERE name = 'views'")
    migrate(old, clock=VirtualClock())
    with Catalog.open(old, clock=VirtualClock()) as catalog:
        assert catalog.resume("tin", provenance=PROVENANCE).add(record(3), image(32)).id == 42


def test_second_migration_does_nothing(old: Path) -> None:
    migrate(old, clock=VirtualClock())
    assert migrate(old, clock=VirtualClock()).backup is None


def test_failed_migration_changes_nothing(old: Path, version: int) -> None:
    with closing(sqlite3.connect(old / "catalog.sqlite", isolation_level=None)) as connection:
        connection.execute(f"UPDATE views SET {'sitting' if version < 3 else 'session'}_id = 99 WHERE id = 1")
    before = tables(old)
    with pytest.raises(CatalogDamaged) as error:
        migrate(old, clock=VirtualClock())
    assert error.value.evidence == {"tables": ["views"]}
    assert tables(old) == before


@pytest.mark.parametrize(
    ("prepare", "error"),
    [(lambda _: None, CatalogError), (lambda root: catalog_of_version(2, root), CatalogBusy)],
    ids=["no-catalog", "busy"],
)
def test_migration_reports_why_it_cannot_start(
    tmp_path: Path, prepare: Callable[[Path], object], error: type[CatalogError]
) -> None:
    prepare(tmp_path)
    before = sorted(tmp_path.iterdir())
    lock = tmp_path / "catalog.sqlite" if before else ":memory:"
    with closing(sqlite3.connect(lock, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(error):
            migrate(tmp_path, clock=VirtualClock(), busy_timeout_s=0.02)
    assert {path.name for path in tmp_path.iterdir()} <= {path.name for path in before} | {
        "catalog.sqlite-wal",
        "catalog.sqlite-shm",
    }
