"""Catalogs and bundles to import and export. No test waits for the disk."""

import shutil
from pathlib import Path

import pytest

from rig.catalog import Catalog
from rig.catalog.exchange.bundle import write_bundle
from rig.catalog.transfer import CatalogSource
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import NOW, OpenCatalog, fill, without_waiting
from tests.rig.catalog.exchange.exchange_samples import fill_full


@pytest.fixture(scope="session")
def full_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A catalog with replaced and unfinished enrollments, regions and an empty-table image."""
    folder = tmp_path_factory.mktemp("exchange") / "full"
    with pytest.MonkeyPatch.context() as patch, Catalog.open(folder, clock=VirtualClock(NOW)) as catalog:
        without_waiting(patch)
        fill_full(catalog)
    return folder


@pytest.fixture
def full(full_folder: Path, open_catalog: OpenCatalog, tmp_path: Path) -> Catalog:
    """A copy of that catalog."""
    shutil.copytree(full_folder, tmp_path / "full")
    return open_catalog("full")


@pytest.fixture(scope="session")
def good_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bundle")
    with Catalog.open(folder / "source", clock=VirtualClock(NOW)) as catalog:
        fill(catalog, "mug", 2)
        write_bundle(folder / "mug.rigcat.zip", CatalogSource(catalog))
    return folder / "mug.rigcat.zip"


@pytest.fixture
def bundle(good_bundle: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(good_bundle, tmp_path))
