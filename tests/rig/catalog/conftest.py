"""The tests of the catalog run on SQLite, and with RIG_TEST_CATALOG=postgres on PostgreSQL (`make test-servers`)."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from rig.catalog import Catalog
from rig.config.catalog_place import CatalogPlace
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import NOW, OpenCatalog, without_waiting
from tests.servers.postgres import VARIABLE, server, use_postgres


@pytest.fixture(autouse=True, scope="session")
def _back_end() -> Iterator[None]:
    if os.environ.get("RIG_TEST_CATALOG") != "postgres":
        yield
        return
    before = CatalogPlace.__dict__["of"]
    with server() as running, pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, running.url)
        use_postgres()
        yield
        CatalogPlace.of = before  # type: ignore[method-assign]


@pytest.fixture(autouse=True)
def _without_waiting(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.path.stem != "test_durability":
        without_waiting(monkeypatch)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if os.environ.get("RIG_TEST_CATALOG") == "postgres":
        for item in items:
            if item.get_closest_marker("sqlite"):
                item.add_marker(pytest.mark.skip(reason="it is about the SQLite file"))


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def catalog(tmp_path: Path, clock: VirtualClock) -> Iterator[Catalog]:
    with Catalog.open(tmp_path / "catalog", clock=clock) as catalog:
        yield catalog


@pytest.fixture
def open_catalog(tmp_path: Path) -> Iterator[OpenCatalog]:
    opened = []

    def open_one(name: str) -> Catalog:
        opened.append(Catalog.open(tmp_path / name, clock=VirtualClock(NOW)))
        return opened[-1]

    yield open_one
    for catalog in opened:
        catalog.close()
