"""Prepared views: a large catalog is read once, later starts map a file, and an invalid file is never used."""

import json
import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import hbr
from rig.catalog import Catalog, prepared
from rig.catalog.edit import delete, rename
from rig.catalog.jobs import JobProgress, finished
from rig.catalog.prepared import load_views, searched_views
from rig.core.errors import CatalogDamaged, DescriptorOutdated
from rig.search.model import load_model
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import PROVENANCE, fill, image, plan, record, without_waiting

KIND = "edges+colours"
OBJECTS = 6


def opened(path: Path, *, read_only: bool = False) -> Catalog:
    return Catalog.open(path, clock=VirtualClock(), read_only=read_only)


def enroll(catalog: Catalog, name: str, seed: int, views: int = 4, **begin: bool) -> None:
    rng = np.random.default_rng(seed)
    enrollment = catalog.begin(name, planned_azimuth_deg=plan(views), provenance=PROVENANCE, **begin)
    for index in range(views):
        levels = {"cedd": rng.integers(0, 8, 144, np.uint8), KIND: rng.integers(0, 4, 544, np.uint8)}
        enrollment.add(record(index, descriptors=levels), image(index))
    enrollment.finish()


@pytest.fixture(scope="module")
def enrolled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("prepared") / "catalog"
    with pytest.MonkeyPatch.context() as patch, opened(path) as catalog:
        without_waiting(patch)
        for number in range(OBJECTS):
            enroll(catalog, f"object {number}", number)
    return path


@pytest.fixture
def path(enrolled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    without_waiting(monkeypatch)
    monkeypatch.setattr(prepared, "FEWEST_OBJECTS", 3)
    monkeypatch.setattr(prepared, "_AT_ONCE", 2)
    return Path(shutil.copytree(enrolled, tmp_path / "catalog"))


def load(catalog: Catalog, kind: str = KIND) -> tuple[hbr.Views, int]:
    """Return the views, checked against those of the database, and how many objects were read from the database."""
    steps: list[JobProgress] = []
    views = finished(load_views(catalog, kind), steps.append)
    expected = catalog.views(kind).views
    assert views.object_names == expected.object_names
    for name in ("descriptors", "azimuth_deg", "object_index"):
        np.testing.assert_array_equal(getattr(views, name), getattr(expected, name))
    return views, steps[-1].total - steps[0].done if steps else 0


def files(path: Path) -> Iterator[Path]:
    return (path / "prepared").iterdir()


@pytest.mark.parametrize("kind", [KIND, "cedd"])
def test_later_starts_read_no_object_from_the_database(path: Path, kind: str) -> None:
    with opened(path, read_only=True) as catalog:
        assert load(catalog, kind)[1] == OBJECTS
    with opened(path) as catalog:
        views, read = load(catalog, kind)
        assert read == 0
        assert isinstance(views, hbr.PackedViews)


def test_searches_answer_like_those_of_the_database(path: Path) -> None:
    with opened(path) as catalog:
        model = load_model(catalog)
        assert isinstance(model.index, hbr.DenseIndex)
        assert isinstance(model.views, hbr.PackedViews)
        expected = hbr.DenseIndex(catalog.views(KIND).views)
        query = expected.views.descriptors[9]
        found, wanted = (hbr.update_belief(query, 0.0, index) for index in (model.index, expected))
        np.testing.assert_array_equal(found.support, wanted.support)
        np.testing.assert_array_equal(found.ranking().pose_deg, wanted.ranking().pose_deg)


def test_only_new_and_changed_objects_are_read_from_the_database(path: Path) -> None:
    with opened(path) as catalog:
        load(catalog)
        enroll(catalog, "new", 20)
        assert load(catalog)[1] == 1
        rename(catalog, "object 2", "another name")
        assert load(catalog)[1] == 0
        enroll(catalog, "object 3", 30, replace=True)
        assert load(catalog)[1] == 1
        delete(catalog, "object 0")
        assert load(catalog)[1] == 0
        (rows,) = (file for file in files(path) if file.suffix == ".rows")
        for number in (1, 4):  # half of the file is unused now
            delete(catalog, f"object {number}")
        assert load(catalog)[1] == OBJECTS - 2
        assert not rows.exists()


@pytest.mark.parametrize(
    "damage", ["a byte of a row", "too short", "missing", "entries", "version", "a link", "a folder"]
)
def test_a_damaged_file_is_made_again(path: Path, damage: str) -> None:
    with opened(path) as catalog:
        load(catalog)
        (rows,) = (file for file in files(path) if file.suffix == ".rows")
        (entries,) = (file for file in files(path) if file.suffix == ".json")
        content, header = rows.read_bytes(), json.loads(entries.read_text())
        match damage:
            case "a byte of a row":
                rows.write_bytes(content[:700] + bytes([content[700] ^ 1]) + content[701:])
            case "too short":
                rows.write_bytes(content[:-1])
            case "missing":
                rows.unlink()
            case "entries":
                entries.write_text('{"format"')
            case "version":
                entries.write_text(json.dumps(header | {"version": 0}))
            case "a link":
                rows.rename(path / "elsewhere")
                rows.symlink_to(path / "elsewhere")
            case "a folder":
                entries.write_text(json.dumps(header | {"rows": "../images"}))
        assert load(catalog)[1] == OBJECTS
        assert load(catalog)[1] == 0


def test_an_interrupted_preparation_continues(path: Path) -> None:
    with opened(path) as catalog:
        loading = load_views(catalog, KIND)
        assert [next(loading).done for _ in range(3)] == [0, 2, 4]
        loading.close()
        (rows,) = (file for file in files(path) if file.suffix == ".rows")
        with rows.open("ab") as file:  # killed after it had written rows, before the entries
            file.write(bytes(1000))
        assert load(catalog)[1] == OBJECTS - 4
        assert load(catalog)[1] == 0


def test_two_programs_prepare_at_once(path: Path) -> None:
    with opened(path) as one, opened(path) as other:
        load(one)
        enroll(one, "new", 20)
        enroll(one, "newer", 21)
        first = load_views(one, KIND)
        next(first)  # has opened the file
        assert load(other)[1] == 2
        with pytest.raises(StopIteration) as end:
            while True:
                next(first)
        np.testing.assert_array_equal(end.value.value.descriptors, one.views(KIND).views.descriptors)
        assert load(one)[1] == 0  # what the other one wrote is intact


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_read_each_time(path: Path) -> None:
    path.chmod(0o500)
    with opened(path, read_only=True) as catalog:
        assert [load(catalog)[1] for _ in range(2)] == [OBJECTS, OBJECTS]


def test_a_file_in_the_place_of_the_folder_is_left_alone(path: Path) -> None:
    (path / "prepared").write_text("mine")
    with opened(path) as catalog:
        assert [load(catalog)[1] for _ in range(2)] == [OBJECTS, OBJECTS]
    assert (path / "prepared").read_text() == "mine"


@pytest.mark.sqlite
def test_damage_of_the_database_is_found_before_its_rows_are_prepared(path: Path) -> None:
    with closing(sqlite3.connect(path / "catalog.sqlite")) as connection, connection:
        connection.execute("UPDATE views SET azimuth_deg = 1.5 WHERE id = 9")
    with opened(path) as catalog, pytest.raises(CatalogDamaged, match="object 2"):
        load(catalog)


@pytest.mark.sqlite
def test_a_damaged_name_is_found_at_every_start(path: Path) -> None:
    with opened(path) as catalog:
        load(catalog)
        with closing(sqlite3.connect(path / "catalog.sqlite")) as connection, connection:
            connection.execute("UPDATE objects SET name = 'objecu 2' WHERE name = 'object 2'")
        with pytest.raises(CatalogDamaged, match="objecu 2"):
            load(catalog)


def test_views_without_the_descriptor_are_reported_for_the_whole_catalog(path: Path) -> None:
    with opened(path) as catalog:
        enrollment = catalog.begin("plain", planned_azimuth_deg=plan(1), provenance=PROVENANCE)
        enrollment.add(record(0), image(0))
        enrollment.finish()
        with pytest.raises(DescriptorOutdated, match=f"{4 * OBJECTS} of {4 * OBJECTS + 1} views") as error:
            load(catalog)
        assert error.value.evidence["objects"] == 1


def test_views_are_compared_by_the_descriptor_that_all_objects_have(path: Path, tmp_path: Path) -> None:
    with opened(path) as catalog, opened(tmp_path / "plain") as plain:
        fill(plain, "photographed", 4)
        assert [views.descriptor for views in searched_views(catalog)] == [KIND]
        both = searched_views(catalog, plain)
        assert [views.descriptor for views in both] == ["cedd", "cedd"]
        assert [len(views.object_names) for views in both] == [OBJECTS, 1]
