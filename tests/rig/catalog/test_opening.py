"""A folder that is not a usable catalog is rejected with a reason, and not changed."""

import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from rig.catalog import Catalog
from rig.catalog.derived import views as searched
from rig.catalog.facts import SCHEMA_VERSION
from rig.catalog.sqlite_database import APPLICATION_ID
from rig.core.errors import CatalogError
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import PROVENANCE, fill, plan

pytestmark = pytest.mark.sqlite

needs_permissions = pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")


def open_catalog(path: Path, *, create: bool = True, read_only: bool = False) -> Catalog:
    return Catalog.open(path, clock=VirtualClock(), create=create, read_only=read_only)


def pragma(path: Path, statement: str) -> object:
    with closing(sqlite3.connect(path / "catalog.sqlite", isolation_level=None)) as connection:
        return connection.execute(f"PRAGMA {statement}").fetchone()


@pytest.fixture(scope="session")
def three_objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("opening") / "catalog"
    with open_catalog(path) as catalog:
        for name in ("mug", "tin", "box"):
            fill(catalog, name, 12)
    return path


@pytest.fixture
def enrolled(tmp_path: Path, three_objects: Path) -> Path:
    return Path(shutil.copytree(three_objects, tmp_path / "catalog #1?"))


def test_new_catalog_has_application_id_and_version(enrolled: Path) -> None:
    assert pragma(enrolled, "application_id") == (APPLICATION_ID,)
    assert pragma(enrolled, "user_version") == (SCHEMA_VERSION,)
    assert {file.name for file in enrolled.iterdir()} == {"catalog.sqlite", "images"}


@pytest.mark.parametrize("read_only", [False, True])
def test_catalog_of_another_version_is_rejected(enrolled: Path, read_only: bool) -> None:
    pragma(enrolled, f"user_version = {SCHEMA_VERSION + 1}")
    with pytest.raises(CatalogError, match="another version of the program") as error:
        open_catalog(enrolled, read_only=read_only)
    assert error.value.evidence == {"found": SCHEMA_VERSION + 1, "known": SCHEMA_VERSION}
    assert "the version of hbr-rig that wrote it" in error.value.next_step


@pytest.mark.parametrize(("create", "read_only"), [(False, False), (True, True)])
def test_missing_catalog_is_not_created_unasked(tmp_path: Path, create: bool, read_only: bool) -> None:
    with pytest.raises(CatalogError, match="no catalog"):
        open_catalog(tmp_path / "nothing", create=create, read_only=read_only)
    assert not (tmp_path / "nothing").exists()


def test_files_of_another_kind_are_rejected_and_not_changed(tmp_path: Path) -> None:
    file = tmp_path / "catalog.sqlite"
    file.write_text("dear diary\n" * 100)
    with pytest.raises(CatalogError, match="is a file"):
        open_catalog(file)
    with pytest.raises(CatalogError, match="not a catalog"):
        open_catalog(tmp_path)
    file.unlink()
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("CREATE TABLE bookmarks (url)")
    before = file.read_bytes()
    with pytest.raises(CatalogError, match="another program"):
        open_catalog(tmp_path)
    assert file.read_bytes() == before


def test_damaged_catalog_is_reported_with_the_fix(enrolled: Path) -> None:
    file = enrolled / "catalog.sqlite"
    content = bytearray(file.read_bytes())
    content[4096 * 2 :] = b"\xa5" * (len(content) - 4096 * 2)
    file.write_bytes(content)
    with pytest.raises(CatalogError, match="damaged") as error, open_catalog(enrolled) as catalog:
        catalog.object("mug")
    assert "backup" in error.value.next_step


def test_read_only_catalog_is_not_changed(enrolled: Path) -> None:
    before = (enrolled / "catalog.sqlite").read_bytes()
    with open_catalog(enrolled, read_only=True) as catalog:
        assert len(searched(catalog)) == 36
        with pytest.raises(CatalogError, match="reading only"):
            catalog.begin("jar", planned_azimuth_deg=plan(1), provenance=PROVENANCE)
    assert (enrolled / "catalog.sqlite").read_bytes() == before


@needs_permissions
def test_catalog_without_write_permission_can_be_read(enrolled: Path) -> None:
    (enrolled / "catalog.sqlite").chmod(0o400)
    enrolled.chmod(0o500)
    with open_catalog(enrolled, read_only=True) as catalog:
        assert len(searched(catalog)) == 36
    with pytest.raises(CatalogError, match="no permission"), open_catalog(enrolled) as catalog:
        fill(catalog, "jar", 1)
    enrolled.chmod(0o700)


@needs_permissions
def test_folder_without_permission_is_reported(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(CatalogError, match="no permission"):
        open_catalog(tmp_path / "catalog")
    tmp_path.chmod(0o700)
