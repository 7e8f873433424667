"""Exports can be imported without loss. Invalid and damaged files are rejected."""

import csv
import io
import json
import os
import shutil
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hbr
from rig.catalog import Catalog
from rig.catalog.edit import delete, set_texts
from rig.catalog.exchange import (
    Conflict,
    ImportBatch,
    Imported,
    ImportProblem,
    import_objects,
    plan_import,
    preview_import,
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
from rig.catalog.places import LOST
from rig.catalog.verify import verify
from rig.core.errors import CatalogError, ExportFailed, ImportRejected, ObjectExists, UsageError
from rig.views import image_files as images
from sim.clock import VirtualClock
from tests.fuzzing import examples
from tests.rig.catalog.catalog_samples import (
    PROVENANCE,
    described,
    fill,
    finished,
    image,
    plan,
    true_fill,
    without_waiting,
)

BOTH = ("cedd", "cedd-blurred")
NOW = datetime(2026, 3, 1, tzinfo=UTC)
OpenCatalog = Callable[[str], Catalog]


@pytest.fixture(autouse=True)
def _fast(monkeypatch: pytest.MonkeyPatch) -> None:
    without_waiting(monkeypatch)


@pytest.fixture
def open_catalog(tmp_path: Path) -> Iterator[OpenCatalog]:
    opened = []

    def open_one(name: str) -> Catalog:
        opened.append(Catalog.open(tmp_path / name, clock=VirtualClock(NOW)))
        return opened[-1]

    yield open_one
    for catalog in opened:
        catalog.close()


@pytest.fixture(scope="session")
def full_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A catalog with replaced and unfinished enrollments, regions, a segmentation and an empty-table image."""
    folder = tmp_path_factory.mktemp("exchange") / "full"
    with pytest.MonkeyPatch.context() as patch, Catalog.open(folder, clock=VirtualClock(NOW)) as catalog:
        without_waiting(patch)
        fill_full(catalog)
    return folder


def fill_full(catalog: Catalog) -> None:
    true_fill(catalog, "gone", 1, 90)
    true_fill(catalog, "mug-white", 3, 0, (2, 0, 12, 12), label="kitchen", note='a chip,\n"at" the rim')
    true_fill(catalog, "Tässe =2+2", 2, 10)
    true_fill(catalog, "mug-white", 4, 20, (0, 0, 10, 10), replace=True)
    delete(catalog, "gone")
    tin = catalog.begin("tin", planned_azimuth_deg=plan(3), provenance=PROVENANCE)
    tin.store_empty_table(image(99))
    tin.add(
        described(0, 30, None, BOTH, imu_deg=0.1, imu_sigma_deg=0.5, segmentation={"method": "none"}),
        image(30),
    )
    tin = catalog.resume("tin", provenance=PROVENANCE)
    tin.add(described(2, 32, evidence={"sharpness": 12.5, "locks": {"gain": None}}), image(32))


@pytest.fixture
def full(full_folder: Path, open_catalog: OpenCatalog, tmp_path: Path) -> Catalog:
    """A copy of that catalog."""
    shutil.copytree(full_folder, tmp_path / "full")
    return open_catalog("full")


def run_import(catalog: Catalog, batch: ImportBatch, conflict: Conflict = Conflict.REJECT, **options: Any) -> Imported:
    return finished(import_objects(catalog, plan_import(catalog, batch, conflict), jobs=1, **options))


def untouched(catalog: Catalog) -> bool:
    """Return whether nothing was imported."""
    left = [path for path in catalog.path.rglob("*") if path.is_file() and not path.name.startswith("catalog")]
    return catalog.objects() == [] and left == [] and catalog.log() == []


def model(catalog: Catalog) -> tuple[Any, ...]:
    views = catalog.views().views
    return views.object_names, views.descriptors.tolist(), views.azimuth_deg.tolist(), views.object_index.tolist()


def pictures(catalog: Catalog) -> list[bytes]:
    return [
        catalog.image_path(view).read_bytes() for item in catalog.objects() for view in catalog.object(item.name).views
    ]


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

    def test_catalogs_are_merged(self, full: Catalog, open_catalog: OpenCatalog, tmp_path: Path) -> None:
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
        assert "hbr-rig[parquet]" in error.value.next_step

    def test_label_of_an_earlier_program_with_control_characters_is_exported_after_it_is_changed(
        self, open_catalog: OpenCatalog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        catalog = open_catalog("earlier")
        with monkeypatch.context() as patch:
            patch.setattr("rig.catalog.catalog.check_text", lambda *_: None)  # earlier programs stored any text
            fill(catalog, "mug", 2, label="\x1b[2J")
        assert catalog.objects()[0].label == "\x1b[2J"
        with pytest.raises(UsageError, match="control characters") as error:
            write_bundle(tmp_path / "a.zip", read_objects(catalog))
        assert "rig catalog label" in error.value.next_step
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
            with pytest.raises(ExportFailed, match="not the stored one") as error:
                write(tmp_path / name, read_objects(full))
            assert "verify" in error.value.next_step
            assert not [
                path for path in tmp_path.iterdir() if path.name.lstrip(".").startswith(name + ".") or path.name == name
            ]


def photograph(path: Path, seed: int, size: tuple[int, int] = (12, 16)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.random.default_rng(seed).integers(0, 256, (*size, 3), np.uint8))


class TestFolders:
    def test_file_names_give_object_and_angle(self, tmp_path: Path, open_catalog: OpenCatalog) -> None:
        for seed, name in enumerate(
            ["obj10__0.png", "obj10__90.5.png", "obj2__355.jpg", "obj2__360.PNG", "mug__10.png"]
        ):
            photograph(tmp_path / "in" / name, seed)
        (tmp_path / "in" / "MISSING.txt").write_text("no image")
        photograph(tmp_path / "in" / "IMG_0001.png", 9)
        catalog = open_catalog("catalog")
        done = run_import(catalog, read_folder(tmp_path / "in", now=NOW), label="coil")
        (rejected,) = done.rejected
        assert (rejected.path, rejected.reason.code) == ("IMG_0001.png", ImportProblem.NAME_PATTERN)
        assert str(rejected.reason) == "does not match the pattern {object}__{angle}"
        views = catalog.views().views
        assert views.object_names == ("mug", "obj2", "obj10")
        assert views.azimuth_deg.tolist() == [10.0, 0.0, 355.0, 0.0, 90.5]
        assert {item.label for item in catalog.objects()} == {"coil"}
        (first, _) = catalog.object("obj10").views
        assert (first.record.encoder_deg, first.record.captured_ns, first.captured_utc) == (None, None, None)
        assert catalog.image_path(first).read_bytes() == (tmp_path / "in" / "obj10__0.png").read_bytes()
        assert catalog.object("obj2").views[1].image.endswith(".jpg")
        assert finished(verify(catalog)).findings == ()

    @pytest.mark.parametrize(
        ("pattern", "names"),
        [
            ("{object}/{angle}", ["mug/0.png", "mug/90.png", "tin/0.png"]),
            ("{object}/view_{angle}_*.png", ["mug/view_0_a.png", "mug/view_90_b.png", "tin/view_0_.png"]),
            ("{angle}-{object}", ["0-mug.png", "90-mug.png", "0-tin.png"]),
            ("run(1)/{object}.{angle}", ["run(1)/mug.0.png", "run(1)/mug.90.png", "run(1)/tin.0.png"]),
        ],
    )
    def test_pattern_matches_other_names(self, tmp_path: Path, pattern: str, names: list[str]) -> None:
        for seed, name in enumerate(names):
            photograph(tmp_path / name, seed)
        batch = read_folder(tmp_path, pattern=pattern, now=NOW)
        assert {item.name: item.enrollments[0].planned_azimuth_deg for item in batch.objects} == {
            "mug": (0.0, 90.0),
            "tin": (0.0,),
        }
        assert batch.rejected == ()

    @pytest.mark.parametrize("pattern", ["", "{object}", "{angle}", "{object}{object}{angle}", "image"])
    def test_invalid_pattern_is_rejected(self, tmp_path: Path, pattern: str) -> None:
        with pytest.raises(UsageError, match="does not contain"):
            read_folder(tmp_path, pattern=pattern, now=NOW)

    def test_table_angles_run_in_the_opposite_direction(self, tmp_path: Path) -> None:
        for angle in (0, 5, 355):
            photograph(tmp_path / f"obj1__{angle}.png", angle)
        (item,) = read_folder(tmp_path, table_angles=True, now=NOW).objects
        shown = {Path(view.image).stem: view.azimuth_deg for view in item.enrollments[0].views}
        assert shown == {"obj1__0": 0.0, "obj1__5": 355.0, "obj1__355": 5.0}

    def test_gaps_in_the_even_spacing_are_reported(self, tmp_path: Path) -> None:
        for name, lacking in (("a", ()), ("b", (90, 270)), ("c", (0,))):
            for angle in range(0, 360, 30):
                if angle not in lacking:
                    photograph(tmp_path / f"{name}__{angle}.png", angle)
        rng = np.random.default_rng(0)
        for angle in range(0, 360, 30):  # scatter is not a gap
            photograph(tmp_path / f"d__{(angle + rng.uniform(-2, 2)) % 360:.4f}.png", angle)
        gaps = read_folder(tmp_path, now=NOW).gaps
        assert [(gap.object_name, gap.azimuth_deg) for gap in gaps] == [("b", 90.0), ("b", 270.0), ("c", 0.0)]

    def test_each_object_has_its_own_step(self, tmp_path: Path) -> None:
        for name, angles in (
            ("many", range(0, 360, 10)),
            ("few", range(0, 360, 60)),
            ("lacks-one", range(0, 320, 40)),
            ("front-only", range(0, 90, 10)),
        ):
            for angle in angles:
                photograph(tmp_path / f"{name}__{angle}.png", angle)
        gaps = read_folder(tmp_path, now=NOW).gaps
        assert [(gap.object_name, gap.azimuth_deg) for gap in gaps] == [("lacks-one", 320.0)]

    def test_unusable_files_are_rejected_one_by_one(self, tmp_path: Path, open_catalog: OpenCatalog) -> None:
        folder = tmp_path / "in"
        for angle in (0, 90, 180, 270):
            photograph(folder / f"mug__{angle}.png", angle)
        whole = (folder / "mug__90.png").read_bytes()
        (folder / "mug__90.png").write_bytes(whole[: len(whole) // 2])
        (folder / "tin__0.png").write_text("I am no image")
        (folder / "mug__180.0.png").write_bytes(whole)
        photograph(tmp_path / "secret.png", 5)
        (folder / "mug__45.png").symlink_to(tmp_path / "secret.png")
        os.mkfifo(folder / "mug__46.png")
        (folder / "mug__47.png").mkdir()
        batch = read_folder(folder, now=NOW)
        catalog = open_catalog("catalog")
        checked = finished(preview_import(plan_import(None, batch)))
        done = run_import(catalog, batch)
        assert {(Path(file.path).name, file.reason.code) for file in done.rejected} == {
            ("mug__90.png", ImportProblem.INVALID_IMAGE),
            ("tin__0.png", ImportProblem.INVALID_IMAGE),
            ("mug__180.png", ImportProblem.SAME_AZIMUTH),
            ("mug__45.png", ImportProblem.LINK_OUTSIDE),
            ("mug__46.png", ImportProblem.NOT_A_FILE),
            ("mug__47.png", ImportProblem.NOT_A_FILE),
        }
        assert (done.objects, done.views) == (checked.objects, checked.views) == (1, 3)
        assert checked.rejected == done.rejected
        assert catalog.views().views.azimuth_deg.tolist() == [0.0, 180.0, 270.0]
        assert finished(verify(catalog)).findings == ()

    def test_strict_import_rejects_all_for_one_file(self, tmp_path: Path, open_catalog: OpenCatalog) -> None:
        photograph(tmp_path / "in" / "mug__0.png", 0)
        (tmp_path / "in" / "mug__5.png").write_bytes(b"x")
        catalog = open_catalog("catalog")
        with pytest.raises(ImportRejected, match="was not imported") as error:
            run_import(catalog, read_folder(tmp_path / "in", now=NOW), strict=True)
        assert "mug__5.png" in str(error.value.evidence["rejected"])
        assert untouched(catalog)

    def test_folder_without_photographs_is_rejected(self, tmp_path: Path) -> None:
        photograph(tmp_path / "IMG.png", 0)
        with pytest.raises(ImportRejected) as error:
            read_folder(tmp_path, now=NOW)
        assert "--pattern" in error.value.next_step
        with pytest.raises(ImportRejected, match="no folder"):
            read_folder(tmp_path / "nowhere", now=NOW)


class TestTables:
    def write(self, folder: Path, *rows: str) -> Path:
        for seed in range(3):
            photograph(folder / f"{seed}.png", seed)
        path = folder / "views.csv"
        path.write_text("object,azimuth_deg,image,operator\n" + "\n".join(rows) + "\n", encoding="utf-8-sig")
        return path

    def test_unusable_rows_are_rejected_one_by_one(self, tmp_path: Path, open_catalog: OpenCatalog) -> None:
        photograph(tmp_path / "outside.png", 9)
        table = self.write(
            tmp_path / "in",
            "mug,0,0.png,ann",
            "mug,-90,1.png,ann",
            "mug,north,2.png,",
            "mug,,2.png,",
            "mug,20,7.png,",
            "mug,30,../outside.png,",
            "mug,nan,2.png,",
            "mug,360,2.png,",
            f"mug,40,{tmp_path / 'outside.png'},",
        )
        catalog = open_catalog("catalog")
        done = run_import(catalog, read_table(table, now=NOW))
        assert catalog.views().views.azimuth_deg.tolist() == [0.0, 270.0]
        assert [str(file.reason) for file in done.rejected] == [
            "azimuth_deg is 'north', not an angle in degrees",
            "azimuth_deg missing",
            "there is no image 7.png",
            "the image ../outside.png is not in the folder of the table",
            "azimuth_deg is 'nan', not an angle in degrees",
            f"the image {tmp_path / 'outside.png'} is not in the folder of the table",
            "shows 'mug' from the same azimuth as 0.png",
        ]
        assert done.rejected[0].path == "views.csv, line 4"

    @pytest.mark.parametrize(
        ("content", "words"),
        [
            *((b"", None), (b"\xff\xfe\x00", None), (b"object,azimuth_deg,image\n", None)),
            *((b'object,azimuth_deg,image\n"', None), (b"object;angle\nmug;0\n", "no column object or azimuth_deg or")),
        ],
    )
    def test_invalid_table_is_rejected(self, tmp_path: Path, content: bytes, words: str | None) -> None:
        (tmp_path / "a.csv").write_bytes(content)
        with pytest.raises(ImportRejected, match=words):
            read_table(tmp_path / "a.csv", now=NOW)


def png_of(width: int, height: int) -> bytes:
    """A small PNG file whose header gives a large size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b"\0" * 1000))
        + chunk(b"IEND", b"")
    )


class TestImages:
    @pytest.mark.parametrize(
        ("content", "reason"),
        [
            (png_of(50_000, 50_000), "50000 x 50000 pixels"),
            (png_of(30_000, 2), "30000 x 2 pixels"),
            (png_of(0, 5), "0 x 5 pixels"),
            (png_of(2**31, 2**31), "pixels"),
            (b"GIF89a" + bytes(100), "neither a PNG nor a JPEG"),
            (b"", "neither a PNG nor a JPEG"),
            (b"\x89PNG\r\n\x1a\n", "truncated"),
            (b"\xff\xd8\xff\xe0\x00\x00" * 9 + b"\xff\xd9", "truncated"),
        ],
    )
    def test_invalid_images_are_rejected(self, content: bytes, reason: str) -> None:
        with pytest.raises(images.BadImage, match=reason):
            images.decode(content)

    @examples(105)
    @given(st.binary(max_size=64), st.sampled_from([b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"]))
    def test_arbitrary_bytes_are_rejected(self, content: bytes, head: bytes) -> None:
        with pytest.raises(images.BadImage):
            images.decode(head + content)

    @examples(52)
    @given(st.data())
    def test_damaged_image_is_decoded_or_rejected(self, data: st.DataObject) -> None:
        suffix = data.draw(st.sampled_from([".png", ".jpg"]))
        content = bytearray(cv2.imencode(suffix, image(1))[1].tobytes())
        for _ in range(data.draw(st.integers(1, 4))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
        try:
            found = images.decode(bytes(content))
        except images.BadImage:
            return
        assert found.dtype == np.uint8
        assert found.ndim == 3

    def test_size_of_jpeg_is_read(self) -> None:
        for progressive in (0, 1):
            content = cv2.imencode(".jpg", image(1), [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])[1].tobytes()
            assert images.decode(content).shape == (12, 16, 3)


@pytest.fixture(scope="session")
def good_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bundle")
    with Catalog.open(folder / "source", clock=VirtualClock(NOW)) as catalog:
        true_fill(catalog, "mug", 2, 0)
        write_bundle(folder / "mug.rigcat.zip", read_objects(catalog))
    return folder / "mug.rigcat.zip"


@pytest.fixture
def bundle(good_bundle: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(good_bundle, tmp_path))


def rewritten(bundle: Path, change: Callable[[dict[str, Any]], None] | None = None, **more: bytes) -> Path:
    """A consistent bundle with a changed line of the object, and with ``more`` members."""
    with zipfile.ZipFile(bundle) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    line = json.loads(members[OBJECTS])
    if change:
        change(line)
    members[OBJECTS] = (json.dumps(line) + "\n").encode()
    manifest = json.loads(members[MANIFEST])
    manifest["objects_sha256"] = images.hashlib.sha256(members[OBJECTS]).hexdigest()
    members[MANIFEST] = json.dumps(manifest).encode()
    target = bundle.with_name("changed.rigcat.zip")
    with zipfile.ZipFile(target, "w") as archive:
        for name, content in (members | more).items():
            archive.writestr(name, content)
    return target


def view_of(line: dict[str, Any], place: int = 0) -> dict[str, Any]:
    view: dict[str, Any] = line["enrollments"][0]["views"][place]
    return view


class TestHostileBundles:
    def rejection(self, open_catalog: OpenCatalog, path: Path) -> str:
        catalog = open_catalog("victim")
        with pytest.raises(ImportRejected) as error:
            run_import(catalog, read_bundle(path))
        assert untouched(catalog)
        return f"{error.value.what} {error.value.evidence}"

    @pytest.mark.parametrize(
        "name",
        [
            *("../evil.png", "/etc/evil.png", "images/../../evil.png"),
            *("images\\..\\evil.png", "C:/evil.png", "images/a\0b.png"),
        ],
    )
    def test_paths_outside_the_catalog_are_rejected(
        self, bundle: Path, open_catalog: OpenCatalog, name: str, tmp_path: Path
    ) -> None:
        def move(line: dict[str, Any]) -> None:
            view_of(line)["image"] = name

        info = zipfile.ZipInfo(name)
        info.filename = name  # ZipInfo itself would correct the name
        path = rewritten(bundle, move)
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(info, b"x")
        assert "was not imported" in self.rejection(open_catalog, path)
        assert not list(tmp_path.rglob("evil.png"))

    @pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFIFO, stat.S_IFCHR])
    def test_links_and_devices_are_rejected(self, bundle: Path, open_catalog: OpenCatalog, kind: int) -> None:
        info = zipfile.ZipInfo("images/link.png")
        info.external_attr = (kind | 0o777) << 16
        with zipfile.ZipFile(bundle, "a") as archive:
            archive.writestr(info, "/etc/passwd")
        assert "link or a device" in self.rejection(open_catalog, bundle)

    def test_decompression_bomb_of_any_size_is_rejected(self, bundle: Path, open_catalog: OpenCatalog) -> None:
        with zipfile.ZipFile(bundle, "a", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("images/bomb.png", bytes(20_000_000))
        assert "to 20000000 bytes" in self.rejection(open_catalog, bundle)
        content = bundle.read_bytes().replace(struct.pack("<I", 20_000_000), struct.pack("<I", 900))
        bundle.write_bytes(content)
        assert "was not imported" in self.rejection(open_catalog, bundle)

    def test_huge_image_is_rejected(self, bundle: Path, open_catalog: OpenCatalog) -> None:
        bomb = png_of(60_000, 60_000)

        def enlarge(line: dict[str, Any]) -> None:
            view_of(line).update(image_bytes=len(bomb), image_sha256=images.digest(bomb))

        with zipfile.ZipFile(bundle) as archive:
            replaced = json.loads(archive.read(OBJECTS))["enrollments"][0]["views"][0]["image"]
        assert "60000 x 60000 pixels" in self.rejection(open_catalog, rewritten(bundle, enlarge, **{replaced: bomb}))

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (lambda line: line.update(name="a\nb"), "cannot be printed"),
            (lambda line: line.update(name=" mug"), "outer spaces"),
            (lambda line: line.update(label="\x1b[2Jmug"), "control characters"),
            (lambda line: line.update(note="a\u202eb"), "control characters"),
            (lambda line: line.update(colour="red"), "colour"),
            (lambda line: view_of(line).update(azimuth_deg=360.0), "azimuth_deg"),
            (lambda line: view_of(line).update(azimuth_deg="north"), "azimuth_deg"),
            (lambda line: view_of(line).update(azimuth_deg=float("nan")), "azimuth_deg"),
            (lambda line: view_of(line).update(index=1), "twice"),
            (lambda line: view_of(line).update(index=7), "planned"),
            (lambda line: view_of(line).update(session=1), "session"),
            (lambda line: view_of(line).update(imu_deg=1.0), "imu_sigma_deg"),
            (lambda line: view_of(line).update(image=view_of(line, 1)["image"]), "two views|size"),
            (lambda line: view_of(line).update(image="objects.jsonl"), "is missing"),
            (lambda line: view_of(line).update(image_sha256="0" * 64), "not the stored image"),
            (lambda line: view_of(line).update(image_bytes=1), "size"),
            (lambda line: view_of(line)["descriptors"][0].update(packed="ff"), "descriptors"),
            (lambda line: view_of(line)["descriptors"][0].update(packed="00" * 54), "not that of the image"),
            (lambda line: view_of(line)["descriptors"][0].update(settings={"region": "evil"}), "settings"),
            (lambda line: view_of(line)["descriptors"][0].update(settings={"region": [0, 0, 99, 99]}), "region"),
            (lambda line: view_of(line)["descriptors"][0].update(version=True), "version"),
            (lambda line: view_of(line).update(captured_utc="9999-12-31T23:59:59-14:00"), "calendar"),
            (lambda line: line.update(created_utc="0001-01-01T00:00:00+14:00"), "calendar"),
            (lambda line: view_of(line).update(segmentation={"issues": 5}), "segmentation"),
            (lambda line: view_of(line).update(captured_ns=2**70), "captured_ns"),
            (lambda line: view_of(line).update(captured_utc="2026-01-01T00:00:00"), "captured_utc"),
            (lambda line: line["enrollments"][0]["views"].pop(), "complete"),
            (lambda line: line["enrollments"][0].update(status="in progress"), "finished_utc"),
            (lambda line: line["enrollments"].append(line["enrollments"][0]), "two enrollments|two views"),
            (lambda line: line["enrollments"][0].update(planned_azimuth_deg=[0.0] * 20_000), "planned_azimuth_deg"),
        ],
    )
    def test_invalid_lines_are_rejected(
        self, bundle: Path, open_catalog: OpenCatalog, change: Callable[[dict[str, Any]], None], words: str
    ) -> None:
        said = self.rejection(open_catalog, rewritten(bundle, change))
        assert any(word in said for word in words.split("|")), said

    @pytest.mark.parametrize("version", [0, -1, True, "2", 2.0, None])
    def test_impossible_version_is_rejected(self, bundle: Path, open_catalog: OpenCatalog, version: object) -> None:
        manifest = json.dumps({"format": "rigcat", "version": version}).encode()
        assert "has version" in self.rejection(open_catalog, rewritten(bundle, None, **{MANIFEST: manifest}))

    def test_newer_bundle_and_other_zip_file_are_rejected(
        self, bundle: Path, tmp_path: Path, open_catalog: OpenCatalog
    ) -> None:
        manifest = json.dumps({"format": "rigcat", "version": 3}).encode()
        assert "newer program" in self.rejection(open_catalog, rewritten(bundle, None, **{MANIFEST: manifest}))
        with zipfile.ZipFile(tmp_path / "holiday.zip", "w") as archive:
            archive.writestr("images/beach.png", b"x")
        assert "does not contain rigcat.json" in self.rejection(open_catalog, tmp_path / "holiday.zip")

    def test_damaged_bundle_is_rejected_or_unchanged(self, tmp_path_factory: pytest.TempPathFactory) -> None:
        folder = tmp_path_factory.mktemp("spoiled")
        with Catalog.open(folder / "source", clock=VirtualClock(NOW)) as source:
            true_fill(source, "mug", 1, 0)
            write_bundle(folder / "good.zip", read_objects(source))
        good = (folder / "good.zip").read_bytes()
        victims = [Catalog.open(folder / "victim", clock=VirtualClock(NOW))]

        @examples(88)
        @given(data=st.data())
        def spoil(data: st.DataObject) -> None:
            content = bytearray(good)
            match data.draw(st.sampled_from(["bytes", "cut", "slice"])):
                case "bytes":
                    for _ in range(data.draw(st.integers(1, 3))):
                        content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
                case "cut":
                    del content[data.draw(st.integers(0, len(content) - 1)) :]
                case _:
                    start = data.draw(st.integers(0, len(content) - 1))
                    del content[start : start + data.draw(st.integers(1, 50))]
            path = folder / "spoiled.zip"
            path.write_bytes(content)
            victim = victims[-1]
            try:
                run_import(victim, read_bundle(path))
            except ImportRejected:
                assert untouched(victim)
                return
            assert finished(verify(victim, jobs=1)).findings == ()
            (view,) = victim.object("mug").views
            assert np.array_equal(victim.read_image(view), image(0))
            assert np.array_equal(view.record.descriptors["cedd"], hbr.describe(image(0)))
            victim.close()
            victims.append(Catalog.open(folder / f"victim-{len(victims)}", clock=VirtualClock(NOW)))

        spoil()
        victims[-1].close()


class TestAllOrNothing:
    @pytest.fixture
    def batch(self, tmp_path: Path) -> ImportBatch:
        for angle in range(0, 360, 60):
            photograph(tmp_path / "in" / f"mug__{angle}.png", angle)
        return read_folder(tmp_path / "in", now=NOW)

    @pytest.mark.parametrize("after", [0, 1, 2])
    def test_interrupted_import_leaves_nothing(
        self, batch: ImportBatch, open_catalog: OpenCatalog, monkeypatch: pytest.MonkeyPatch, after: int
    ) -> None:
        monkeypatch.setattr("rig.catalog.jobs.PORTION", 2)
        catalog = open_catalog("catalog")
        job = import_objects(catalog, plan_import(catalog, batch), jobs=1)
        for _ in range(after + 1):
            next(job)
        job.close()
        assert untouched(catalog)
        assert run_import(catalog, batch).views == 6

    @pytest.mark.parametrize("step", ["rig.catalog.exchange.insert.sync_folder", "rig.catalog.audit.append"])
    @pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
    def test_import_that_fails_in_its_transaction_leaves_nothing(
        self,
        batch: ImportBatch,
        open_catalog: OpenCatalog,
        monkeypatch: pytest.MonkeyPatch,
        step: str,
        error: BaseException,
    ) -> None:
        def fail(*_: object, **__: object) -> None:
            raise error

        catalog = open_catalog("catalog")
        with monkeypatch.context() as patch:
            patch.setattr(step, fail)
            with pytest.raises((KeyboardInterrupt, CatalogError)):
                run_import(catalog, batch)
        assert untouched(catalog)
        assert run_import(catalog, batch).views == 6
        assert finished(verify(catalog)).findings == ()

    def test_files_of_a_killed_import_are_moved_away(self, batch: ImportBatch, open_catalog: OpenCatalog) -> None:
        catalog = open_catalog("catalog")
        left = catalog.path / "images" / "000001-mug" / "000001" / "old.png"
        left.parent.mkdir(parents=True)
        left.write_bytes(b"left behind")
        run_import(catalog, batch)
        assert finished(verify(catalog)).findings == ()
        assert (catalog.path / LOST / left.relative_to(catalog.path)).read_bytes() == b"left behind"

    def test_import_notices_an_object_of_another_process_and_keeps_replaced_enrollments(
        self, batch: ImportBatch, open_catalog: OpenCatalog
    ) -> None:
        catalog = open_catalog("catalog")
        job = import_objects(catalog, plan_import(catalog, batch), jobs=1)
        next(job)
        true_fill(catalog, "mug", 1, 0)
        with pytest.raises(ObjectExists):
            finished(job)
        assert catalog.object("mug").summary.views == 1
        assert finished(verify(catalog)).findings == ()
        done = run_import(catalog, batch, Conflict.REPLACE)
        assert done.replaced == ("mug",)
        assert [e.status for e in catalog.object("mug").enrollments] == ["complete", "superseded"]
        assert catalog.object("mug").summary.views == 6

    def test_several_processes_import_the_same(
        self, batch: ImportBatch, open_catalog: OpenCatalog, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("rig.catalog.exchange.importing.processes", lambda wanted, _: wanted)
        monkeypatch.setattr("rig.catalog.jobs.PORTION", 2)
        alone, together = open_catalog("alone"), open_catalog("together")
        run_import(alone, batch)
        finished(import_objects(together, plan_import(together, batch), jobs=2))
        assert model(alone) == model(together)
        assert np.array_equal(
            together.views().views.descriptors[0], hbr.describe(together.read_image(together.object("mug").views[0]))
        )

    def test_read_only_catalog_rejects_an_import(self, batch: ImportBatch, open_catalog: OpenCatalog) -> None:
        path = open_catalog("catalog").path
        with Catalog.open(path, clock=VirtualClock(), read_only=True) as catalog:
            with pytest.raises(CatalogError, match="reading only"):
                run_import(catalog, batch)
            assert untouched(catalog)
