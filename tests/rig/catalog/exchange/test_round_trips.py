"""Exports can be imported without loss."""

import csv
import io
import json
import zipfile
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.catalog import Catalog
from rig.catalog.edit import set_texts
from rig.catalog.exchange import (
    Conflict,
    read_bundle,
    read_catalog,
    read_folder,
    read_objects,
    read_table,
    write_bundle,
    write_folder,
    write_parquet,
    write_table,
)
from rig.catalog.exchange.bundle import MANIFEST, OBJECTS
from rig.catalog.verify import verify
from rig.core.errors import ExportFailed, ObjectExists, UsageError
from rig.core.next_steps import Do
from tests.rig.catalog.catalog_samples import (
    PROVENANCE,
    fill,
    finished,
    image,
    true_fill,
)
from tests.rig.catalog.exchange.exchange_samples import (
    NOW,
    OpenCatalog,
    model,
    pictures,
    run_import,
)


class TestRoundTrips:
    def test_bundle_round_trip_gives_the_same_bytes(
        self, full: Catalog, open_catalog: OpenCatalog, tmp_path: Path
    ) -> None:
        first, second = tmp_path / "a.rigcat.zip", tmp_path / "b.rigcat.zip"
        assert write_bundle(first, read_objects(full)) == 3
        copy = open_catalog("copy")
        done = run_import(copy, read_bundle(first))
        assert (done.objects, done.views) == (3, 11)
        assert finished(verify(copy)).findings == ()
        write_bundle(second, read_objects(copy))
        assert first.read_bytes() == second.read_bytes()
        assert model(copy) == model(full)
        assert pictures(copy) == pictures(full)
        statuses = [[[e.status for e in c.object(o.name).enrollments] for o in full.objects()] for c in (copy, full)]
        assert statuses[0] == statuses[1]
        tin = copy.resume("tin", provenance=PROVENANCE)  # an unfinished enrollment continues in the copy
        assert tin.missing() == (1,)

    def test_bundle_is_readable_without_this_program(self, full: Catalog, tmp_path: Path) -> None:
        write_bundle(tmp_path / "a.rigcat.zip", read_objects(full))
        with zipfile.ZipFile(tmp_path / "a.rigcat.zip") as archive:
            assert json.loads(archive.read(MANIFEST))["views"] == 11
            lines = [json.loads(line) for line in archive.read(OBJECTS).splitlines()]
            assert [line["name"] for line in lines] == ["mug-white", "Tässe =2+2", "tin"]
            (view, *_) = lines[0]["enrollments"][1]["views"]
            stored = cv2.imdecode(np.frombuffer(archive.read(view["image"]), np.uint8), cv2.IMREAD_COLOR)
            assert np.array_equal(stored, image(20))

    def test_catalogs_are_merged(self, full: Catalog, open_catalog: OpenCatalog) -> None:
        copy = open_catalog("copy")
        true_fill(copy, "tin", 2, 50)
        with pytest.raises(ObjectExists) as error:
            run_import(copy, read_catalog(full))
        assert error.value.evidence == {"objects": ["tin"]}
        done = run_import(copy, read_catalog(full), Conflict.SKIP)
        assert (done.objects, done.skipped) == (2, ("tin",))
        assert [item.name for item in copy.objects()] == ["tin", "mug-white", "Tässe =2+2"]
        assert finished(verify(copy)).findings == ()

    def test_coil_folder_round_trip_keeps_views_and_images(
        self, full: Catalog, open_catalog: OpenCatalog, tmp_path: Path
    ) -> None:
        assert write_folder(tmp_path / "coil", read_objects(full)) == 2
        copy = open_catalog("copy")
        run_import(copy, read_folder(tmp_path / "coil", now=NOW))
        assert model(copy) == model(full)
        assert pictures(copy) == pictures(full)
        assert copy.object("mug-white").summary.note == 'a chip,\n"at" the rim'
        assert finished(verify(copy)).findings == ()
        write_folder(tmp_path / "again", read_objects(copy))
        for path in (tmp_path / "coil").iterdir():
            assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()

    def test_table_round_trip_keeps_views_images_and_angles(
        self, full: Catalog, open_catalog: OpenCatalog, tmp_path: Path
    ) -> None:
        write_table(tmp_path / "table", read_objects(full, ["mug-white", "Tässe =2+2"]))
        copy = open_catalog("copy")
        run_import(copy, read_table(tmp_path / "table" / "views.csv", now=NOW))
        assert model(copy) == model(full)
        assert pictures(copy) == pictures(full)
        for name in ("mug-white", "Tässe =2+2"):
            for ours, theirs in zip(copy.object(name).views, full.object(name).views, strict=True):
                assert ours.record.encoder_deg == theirs.record.encoder_deg
                assert ours.captured_utc == theirs.captured_utc
                assert ours.session.provenance.bench == "bench-1"
        assert finished(verify(copy)).findings == ()
        write_table(tmp_path / "again", read_objects(copy))
        before, after = ((tmp_path / name / "views.csv").read_text() for name in ("table", "again"))
        as_rows = [list(csv.DictReader(io.StringIO(text))) for text in (before, after)]
        for row in (*as_rows[0], *as_rows[1]):
            del row["image"]  # enrollments get new numbers
        assert as_rows[0] == as_rows[1]

    def test_parquet_contains_the_levels(self, full: Catalog, tmp_path: Path) -> None:
        parquet = pytest.importorskip("pyarrow.parquet")
        assert write_parquet(tmp_path / "a.parquet", read_objects(full)) == 3
        rows = parquet.read_table(tmp_path / "a.parquet").to_pylist()
        views = full.views().views
        assert [row["object"] for row in rows] == [views.object_names[i] for i in views.object_index]
        assert [row["levels"] for row in rows] == views.descriptors.tolist()
        assert [row["azimuth_deg"] for row in rows] == views.azimuth_deg.tolist()
        assert rows[0]["captured_utc"].tzinfo is not None

    def test_parquet_without_pyarrow_names_the_extra(
        self, full: Catalog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
        with pytest.raises(ExportFailed) as error:
            write_parquet(tmp_path / "a.parquet", read_objects(full))
        assert error.value.steps == (Do.INSTALL_EXTRA(extra="parquet"),)

    def test_label_of_an_earlier_program_with_control_characters_is_exported_after_it_is_changed(
        self, open_catalog: OpenCatalog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        catalog = open_catalog("earlier")
        with monkeypatch.context() as patch:
            patch.setattr("rig.catalog.records.check_text", lambda *_: None)  # earlier programs stored any text
            fill(catalog, "mug", 2, label="\x1b[2J")
        assert catalog.objects()[0].label == "\x1b[2J"
        with pytest.raises(UsageError, match="control characters") as error:
            write_bundle(tmp_path / "a.zip", read_objects(catalog))
        assert Do.LABEL() in error.value.steps
        set_texts(catalog, "mug", label="mug")
        assert write_bundle(tmp_path / "a.zip", read_objects(catalog)) == 1

    def test_export_overwrites_nothing_and_leaves_no_partial_files(self, full: Catalog, tmp_path: Path) -> None:
        (tmp_path / "a.rigcat.zip").write_bytes(b"mine")
        (tmp_path / "coil").mkdir()
        (tmp_path / "coil" / "mine").touch()
        with pytest.raises(ExportFailed, match="exists already"):
            write_bundle(tmp_path / "a.rigcat.zip", read_objects(full))
        with pytest.raises(ExportFailed, match="exists already"):
            write_folder(tmp_path / "coil", read_objects(full))
        full.image_path(full.object("mug-white").views[3]).write_bytes(b"x")
        for write, name in ((write_bundle, "b.rigcat.zip"), (write_folder, "f"), (write_table, "t")):
            with (
                pytest.raises(ExportFailed, match="not the stored one") as error,
                closing(read_objects(full)) as objects,
            ):
                write(tmp_path / name, objects)
            assert "verify" in error.value.next_step
            assert not [
                path for path in tmp_path.iterdir() if path.name.lstrip(".").startswith(name + ".") or path.name == name
            ]
