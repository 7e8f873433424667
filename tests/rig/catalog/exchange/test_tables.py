"""Folders of photographs and tables contain the views that searches use, and can be imported without loss."""

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rig.catalog import Catalog, View
from rig.catalog.derived import views
from rig.catalog.exchange.photographs import read_folder, read_table
from rig.catalog.exchange.tables import TableFormat, plain_row, write_folder, write_views
from rig.catalog.transfer import CatalogSource
from rig.catalog.verify import verify
from rig.core.errors import CatalogError, ExportFailed
from rig.core.next_steps import Do
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import NOW, PROVENANCE, OpenCatalog, finished, plan, without_waiting
from tests.rig.catalog.exchange.exchange_samples import model, pictures, run_import

REGION = (2, 0, 60, 44)
NOTE = 'a chip,\n"at" the rim'


def noise(seed: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (48, 64, 3), np.uint8)


def enroll(catalog: Catalog, name: str, count: int, seed: int, region: object = None, **begin: object) -> None:
    enrollment = catalog.begin(name, planned_azimuth_deg=plan(count), provenance=PROVENANCE, **begin)  # type: ignore[arg-type]
    for index, azimuth_deg in enumerate(plan(count)):
        angles = {"commanded_deg": -azimuth_deg, "encoder_deg": 0.03 - azimuth_deg, "captured_ns": 0}
        view = View(index=index, azimuth_deg=azimuth_deg, region=region, **angles)  # type: ignore[arg-type]
        enrollment.add(view, noise(seed + index))
    enrollment.finish()


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A catalog with a replaced, a deleted and an unfinished enrollment, and a region."""
    folder = tmp_path_factory.mktemp("tables") / "full"
    with pytest.MonkeyPatch.context() as patch, Catalog.open(folder, clock=VirtualClock(NOW)) as catalog:
        without_waiting(patch)
        enroll(catalog, "gone", 1, 90)
        enroll(catalog, "mug-white", 3, 0, label="kitchen", note=NOTE)
        enroll(catalog, "Tässe =2+2", 2, 10)
        enroll(catalog, "mug-white", 4, 20, REGION, replace=True)
        catalog.delete("gone")
        catalog.begin("tin", planned_azimuth_deg=plan(3), provenance=PROVENANCE)
    return folder


@pytest.fixture
def full(sample: Path) -> Iterator[Catalog]:
    with Catalog.open(sample, clock=VirtualClock(NOW), read_only=True) as catalog:
        yield catalog


def test_folder_round_trip_keeps_views_and_images(full: Catalog, open_catalog: OpenCatalog, tmp_path: Path) -> None:
    assert write_folder(tmp_path / "old", CatalogSource(full)) == 2
    copy = open_catalog("copy")
    run_import(copy, read_table(tmp_path / "old" / "views.csv", now=NOW))
    assert model(copy) == model(full)
    assert pictures(copy) == pictures(full)
    assert copy.object("mug-white").summary.note == NOTE
    assert copy.object("mug-white").views[0].region == REGION
    assert finished(verify(copy)).findings == ()


def test_images_of_a_folder_are_named_as_in_coil_100(full: Catalog, open_catalog: OpenCatalog, tmp_path: Path) -> None:
    write_folder(tmp_path / "coil", CatalogSource(full))
    copy = open_catalog("copy")
    run_import(copy, read_folder(tmp_path / "coil", now=NOW))
    assert {one.name: one.views for one in copy.objects()} == {"obj1": 4, "obj2": 2}
    assert pictures(copy) == pictures(full)


def test_parquet_without_pyarrow_names_the_extra(
    full: Catalog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(ExportFailed) as error:
        write_views(tmp_path / "a.parquet", CatalogSource(full), TableFormat.PARQUET)
    assert error.value.steps == (Do.INSTALL_EXTRA(extra="parquet"),)


def test_export_overwrites_nothing_and_leaves_no_partial_files(sample: Path, tmp_path: Path) -> None:
    with Catalog.open(sample, clock=VirtualClock(NOW), read_only=True) as catalog:
        (tmp_path / "old" / "folder").mkdir(parents=True)
        (tmp_path / "old" / "folder" / "mine").touch()
        with pytest.raises(ExportFailed, match="exists already"):
            write_folder(tmp_path / "old" / "folder", CatalogSource(catalog))
        assert [path.name for path in (tmp_path / "old").rglob("*")] == ["folder", "mine"]
        (tmp_path / "new").mkdir()
        image = catalog.image_path(catalog.object("mug-white").views[3].image)
        stored = image.read_bytes()
        try:
            image.write_bytes(b"x")
            with pytest.raises(CatalogError, match="not the one that was stored") as error:
                write_folder(tmp_path / "new" / "folder", CatalogSource(catalog))
        finally:
            image.write_bytes(stored)
        assert "verify" in error.value.next_step
        assert list((tmp_path / "new").iterdir()) == []


def test_tables_of_all_formats_have_the_same_values(full: Catalog, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    for form in TableFormat:
        assert write_views(tmp_path / f"a.{form}", CatalogSource(full), form) == 2
    listed = json.loads((tmp_path / "a.json").read_text())
    table = list(csv.DictReader(io.StringIO((tmp_path / "a.csv").read_text())))
    stored = parquet.read_table(tmp_path / "a.parquet").to_pylist()
    for one, row, other in zip(listed, table, stored, strict=True):
        assert plain_row(other) == one
        cells = {key: " ".join(map(str, value)) if key == "levels" else value for key, value in one.items()}
        assert row == {key: "" if value is None else str(value) for key, value in cells.items()}
    expected = views(full)
    assert [row["object"] for row in stored] == [expected.object_names[i] for i in expected.object_index]
    assert [row["levels"] for row in stored] == expected.descriptors.tolist()
    assert [row["azimuth_deg"] for row in stored] == expected.azimuth_deg.tolist()
    assert stored[0]["captured_utc"].tzinfo is not None
    assert full.image_path(f"{stored[0]['image_sha256']}.png") == full.path / stored[0]["image"]
