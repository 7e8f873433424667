"""A catalog of the first version, made by the program of its time, becomes one of today; a backup stays."""

import re
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from hbr import describe
from rig.catalog import Catalog, EnrollmentStatus, migrate
from rig.catalog.schema import SCHEMA_VERSION
from rig.core.errors import CatalogBusy, CatalogDamaged, CatalogError, CatalogOutdated
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import PROVENANCE, image, record

SAMPLE = Path(__file__).parent / "data" / "catalog-v1"


@pytest.fixture
def old(tmp_path: Path) -> Path:
    root = tmp_path / "old"
    shutil.copytree(SAMPLE / "images", root / "images")
    with closing(sqlite3.connect(root / "catalog.sqlite", isolation_level=None)) as connection:
        connection.executescript((SAMPLE / "catalog.sql").read_text(encoding="utf-8"))
    return root


def tables(root: Path) -> dict[str, str]:
    """What the database is made of, however its statements are laid out."""
    with closing(sqlite3.connect(root / "catalog.sqlite")) as connection:
        rows = connection.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL").fetchall()
    return {name: re.sub(r"[\s\"]+", "", sql) for name, sql in rows}


@pytest.mark.parametrize("read_only", [False, True])
def test_an_old_catalog_is_not_touched_unasked(old: Path, read_only: bool) -> None:
    with pytest.raises(CatalogOutdated, match="version 1") as refused:
        Catalog.open(old, clock=VirtualClock(), read_only=read_only)
    assert "rig catalog migrate" in refused.value.next_step
    assert "deleted_utc" not in tables(old)["objects"]


def test_everything_is_there_after_a_migration_and_the_backup_is_what_was(old: Path) -> None:
    clock = VirtualClock()
    done = migrate(old, clock=clock)
    assert (done.before, done.after) == (1, SCHEMA_VERSION)
    with Catalog.open(old, clock=clock) as catalog:
        assert [(o.name, o.label, o.note, o.views, o.unfinished_views) for o in catalog.objects()] == [
            ("mug-white", "kitchen", "a chip at the rim", 4, None),
            ("Tässe 2", "", "", 4, None),
            ("tin", "", "", 0, 2),
        ]
        mug, cup = catalog.object("mug-white"), catalog.object("Tässe 2")
        assert [e.status for e in mug.enrollments] == [EnrollmentStatus.COMPLETE, EnrollmentStatus.SUPERSEDED]
        assert mug.enrollments[0].sittings[0].provenance.devices["camera"] == {"model": "C920", "serial": "A1"}
        for view in (*mug.views, *cup.views):
            pixels = catalog.read_image(view)
            region = view.record.region or (0, 0, 16, 12)
            assert np.array_equal(view.record.descriptor, describe(pixels[:, : region[2]]))
        assert {view.record.region for view in mug.views} == {(0, 0, 12, 12)}
        assert {view.record.region for view in cup.views} == {None}
        assert mug.views[1].record.encoder_deg == 90.03
        assert mug.views[1].record.evidence == {"sharpness": 13.5, "locks_hold": True}
        assert len(catalog.views().views) == 8
        assert [entry.action for entry in catalog.log()] == ["migrated"]
        tin = catalog.resume("tin", provenance=PROVENANCE)
        assert tin.missing() == (2, 3)
        tin.add(record(2), image(32))
    assert done.backup is not None
    with closing(sqlite3.connect(done.backup)) as backup, closing(sqlite3.connect(":memory:")) as source:
        source.executescript((SAMPLE / "catalog.sql").read_text(encoding="utf-8").split("\n", 1)[1])
        assert list(backup.iterdump()) == list(source.iterdump())


def test_a_migrated_catalog_is_made_like_a_new_one(old: Path, tmp_path: Path) -> None:
    migrate(old, clock=VirtualClock())
    with Catalog.open(tmp_path / "new", clock=VirtualClock()):
        pass
    migrated, new = tables(old), tables(tmp_path / "new")
    assert migrated.keys() == new.keys()
    for name, made in new.items():
        if name == "sittings":  # its columns were added in place, behind the constraints
            assert sorted(migrated[name]) == sorted(made)
        else:
            assert migrated[name] == made, name


def test_no_id_is_given_twice_over_a_migration(old: Path) -> None:
    with closing(sqlite3.connect(old / "catalog.sqlite", isolation_level=None)) as connection:
        connection.execute("UPDATE sqlite_sequence SET seq = 41 WHERE name = 'views'")
    migrate(old, clock=VirtualClock())
    with Catalog.open(old, clock=VirtualClock()) as catalog:
        assert catalog.resume("tin", provenance=PROVENANCE).add(record(2), image(32)).id == 42


def test_a_second_migration_does_nothing(old: Path) -> None:
    migrate(old, clock=VirtualClock())
    assert migrate(old, clock=VirtualClock()).backup is None


def test_a_migration_that_fails_changes_nothing(old: Path) -> None:
    with closing(sqlite3.connect(old / "catalog.sqlite", isolation_level=None)) as connection:
        connection.execute("UPDATE views SET sitting_id = 99 WHERE id = 1")
    before = tables(old)
    with pytest.raises(CatalogDamaged, match="refer to others") as refused:
        migrate(old, clock=VirtualClock())
    assert refused.value.evidence == {"tables": ["views"]}
    assert tables(old) == before


def test_a_migration_waits_for_a_writer_and_says_so(old: Path) -> None:
    with closing(sqlite3.connect(old / "catalog.sqlite", isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(CatalogBusy):
            migrate(old, clock=VirtualClock(), busy_timeout_s=0.02)


def test_there_is_nothing_to_migrate(tmp_path: Path) -> None:
    with pytest.raises(CatalogError, match="no catalog"):
        migrate(tmp_path, clock=VirtualClock())
    assert list(tmp_path.iterdir()) == []
