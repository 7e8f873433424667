"""Folders of photographs and tables contain the views that searches use, and can be imported without loss."""

import csv
import io
import json
from pathlib import Path

import pytest

from rig.catalog import Catalog
from rig.catalog.derived import views
from rig.catalog.exchange.photographs import read_folder, read_table
from rig.catalog.exchange.tables import TableFormat, plain_row, write_folder, write_views
from rig.catalog.transfer import CatalogSource
from rig.catalog.verify import verify
from rig.core.errors import CatalogError, ExportFailed
from rig.core.next_steps import Do
from tests.rig.catalog.catalog_samples import NOW, OpenCatalog, finished
from tests.rig.catalog.exchange.exchange_samples import model, pictures, run_import


def test_folder_round_trip_keeps_views_and_images(full: Catalog, open_catalog: OpenCatalog, tmp_path: Path) -> None:
    assert write_folder(tmp_path / "old", CatalogSource(full)) == 3
    copy = open_catalog("copy")
    run_import(copy, read_table(tmp_path / "old" / "views.csv", now=NOW))
    assert model(copy) == model(full)
    assert pictures(copy) == pictures(full)
    assert copy.object("mug-white").summary.note == 'a chip,\n"at" the rim'
    assert copy.object("mug-white").views[0].region == (0, 0, 18, 18)
    assert finished(verify(copy)).findings == ()


def test_images_of_a_folder_are_named_as_in_coil_100(full: Catalog, open_catalog: OpenCatalog, tmp_path: Path) -> None:
    write_folder(tmp_path / "coil", CatalogSource(full))
    copy = open_catalog("copy")
    run_import(copy, read_folder(tmp_path / "coil", now=NOW))
    assert {one.name: one.views for one in copy.objects()} == {"obj1": 4, "obj2": 2, "obj3": 3}
    assert pictures(copy) == pictures(full)


def test_parquet_without_pyarrow_names_the_extra(
    full: Catalog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(ExportFailed) as error:
        write_views(tmp_path / "a.parquet", CatalogSource(full), TableFormat.PARQUET)
    assert error.value.steps == (Do.INSTALL_EXTRA(extra="parquet"),)


def test_export_overwrites_nothing_and_leaves_no_partial_files(full: Catalog, tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "mine").touch()
    with pytest.raises(ExportFailed, match="exists already"):
        write_folder(tmp_path / "old", CatalogSource(full))
    (tmp_path / "new").mkdir()
    full.image_path(full.object("mug-white").views[3].image).write_bytes(b"x")
    with pytest.raises(CatalogError, match="not the one that was stored") as error:
        write_folder(tmp_path / "new" / "folder", CatalogSource(full))
    assert "verify" in error.value.next_step
    assert [path.name for one in ("old", "new") for path in (tmp_path / one).iterdir()] == ["mine"]


def test_tables_of_all_formats_have_the_same_values(full: Catalog, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    for form in TableFormat:
        assert write_views(tmp_path / f"a.{form}", CatalogSource(full), form) == 3
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
