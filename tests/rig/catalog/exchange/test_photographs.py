"""Folders and tables of photographs are imported; unusable ones are rejected with their reasons."""

import os
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.catalog import Catalog
from rig.catalog.derived import empty_tables, views
from rig.catalog.exchange.photographs import read_folder, read_table
from rig.catalog.incoming import ImportProblem
from rig.catalog.transfer import Conflict
from rig.catalog.verify import verify
from rig.core.errors import ImportRejected, UsageError
from rig.views.description import BENCH_DESCRIPTOR, DESCRIPTORS
from tests.rig.catalog.catalog_samples import NOW, OpenCatalog, finished
from tests.rig.catalog.exchange.exchange_samples import photograph, run_import, untouched


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
        assert (rejected.path, rejected.code) == ("IMG_0001.png", ImportProblem.NAME_PATTERN)
        assert rejected.reason == "does not match the pattern {object}__{angle}"
        found = views(catalog)
        assert found.object_names == ("mug", "obj2", "obj10")
        assert found.azimuth_deg.tolist() == [10.0, 0.0, 355.0, 0.0, 90.5]
        assert {item.label for item in catalog.objects()} == {"coil"}
        (first, _) = catalog.object("obj10").views
        assert (first.encoder_deg, first.captured_ns, first.captured_utc) == (None, None, None)
        assert catalog.image_path(first.image).read_bytes() == (tmp_path / "in" / "obj10__0.png").read_bytes()
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
        source = read_folder(tmp_path, pattern=pattern, now=NOW)
        assert {item.name: item.enrollment.planned_azimuth_deg for item in source.items()} == {
            "mug": (0.0, 90.0),
            "tin": (0.0,),
        }
        assert source.rejected == []

    @pytest.mark.parametrize("pattern", ["", "{object}", "{angle}", "{object}{object}{angle}", "image"])
    def test_invalid_pattern_is_rejected(self, tmp_path: Path, pattern: str) -> None:
        with pytest.raises(UsageError, match="does not contain"):
            read_folder(tmp_path, pattern=pattern, now=NOW)

    def test_table_angles_run_in_the_opposite_direction(self, tmp_path: Path) -> None:
        for angle in (0, 5, 355):
            photograph(tmp_path / f"obj1__{angle}.png", angle)
        (item,) = read_folder(tmp_path, table_angles=True, now=NOW).items()
        shown = {Path(view.image).stem: view.azimuth_deg for view in item.enrollment.views}
        assert shown == {"obj1__0": 0.0, "obj1__5": 355.0, "obj1__355": 5.0}

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
        checked = run_import(catalog, batch, dry_run=True)
        done = run_import(catalog, batch)
        assert {(Path(file.path).name, file.code) for file in done.rejected} == {
            ("mug__90.png", ImportProblem.INVALID_IMAGE),
            ("tin__0.png", ImportProblem.INVALID_IMAGE),
            ("mug__180.png", ImportProblem.SAME_AZIMUTH),
            ("mug__45.png", ImportProblem.LINK_OUTSIDE),
            ("mug__46.png", ImportProblem.NOT_A_FILE),
            ("mug__47.png", ImportProblem.NOT_A_FILE),
        }
        assert (done.objects, done.views) == (checked.objects, checked.views) == (1, 3)
        assert checked.rejected == done.rejected
        assert views(catalog).azimuth_deg.tolist() == [0.0, 180.0, 270.0]
        assert finished(verify(catalog)).findings == ()

    def test_label_with_control_characters_is_rejected(self, tmp_path: Path, open_catalog: OpenCatalog) -> None:
        photograph(tmp_path / "in" / "mug__0.png", 0)
        catalog = open_catalog("catalog")
        with pytest.raises(UsageError, match="control characters"):
            run_import(catalog, read_folder(tmp_path / "in", now=NOW), label="\x1b[2J")
        assert untouched(catalog)


class TestTables:
    def test_unusable_rows_are_rejected_one_by_one(self, tmp_path: Path, open_catalog: OpenCatalog) -> None:
        outside = tmp_path / "outside.png"
        for path in (outside, *(tmp_path / "in" / f"{seed}.png" for seed in range(5))):
            photograph(path, len(path.name))
        rows = {
            "mug,0,0.png,ann,,a chip": None,
            "mug,-90,1.png,ann,1 1 8 8,": None,
            "mug,north,2.png,,,": "azimuth_deg is 'north', not an angle in degrees",
            "mug,,2.png,,,": "azimuth_deg missing",
            "mug,20,7.png,,,": "there is no image 7.png",
            "mug,30,../outside.png,,,": "the image ../outside.png is not in the folder of the table",
            "mug,nan,2.png,,,": "azimuth_deg is 'nan', not an angle in degrees",
            "mug,360,2.png,,,": "shows 'mug' from the same azimuth as 0.png",
            f"mug,40,{outside},,,": f"the image {outside} is not in the folder of the table",
            "mug,50,3.png,,1 2 3,": "the region '1 2 3' is not of the form x y width height, in pixels",
            "mug,60,3.png,,0 0 0 9,": "the region (0, 0, 0, 9) is not x, y, width and height in pixels",
            "tin,70,3.png,,,\x1b[2J": "The note '\\x1b[2J' contains control characters",
            "mug,80,4.png,,0 0 99 99,": "cannot be described: The region [0, 0, 99, 99] does not lie within an image "
            "of 16x12",
        }
        text = "\n".join(["object,azimuth_deg,image,operator,region,note", *rows, ""])
        (tmp_path / "in" / "views.csv").write_text(text, encoding="utf-8-sig")
        catalog = open_catalog("catalog")
        done = run_import(catalog, read_table(tmp_path / "in" / "views.csv", now=NOW))
        assert views(catalog).azimuth_deg.tolist() == [0.0, 270.0]
        assert [file.reason for file in done.rejected] == [why for why in rows.values() if why is not None]
        assert done.rejected[0].path == "views.csv, line 4"
        assert [(item.name, item.note) for item in catalog.objects()] == [("mug", "a chip")]

    def test_same_photographs_are_not_added_again(self, tmp_path: Path, open_catalog: OpenCatalog) -> None:
        photograph(tmp_path / "mug__0.png", 0)
        catalog = open_catalog("catalog")
        run_import(catalog, read_folder(tmp_path, now=NOW))
        done = run_import(catalog, read_folder(tmp_path, now=NOW + timedelta(days=1)), Conflict.REPLACE)
        assert (done.objects, done.skipped) == (0, ("mug",))
        assert len(catalog.object("mug").enrollments) == 1

    def test_photograph_that_cannot_be_described_with_the_others_is_rejected(
        self, tmp_path: Path, open_catalog: OpenCatalog
    ) -> None:
        for angle, size in ((0, (48, 64)), (90, (40, 64)), (180, (48, 64))):
            photograph(tmp_path / f"mug__{angle}.png", angle, size)
        catalog = open_catalog("catalog")
        done = run_import(catalog, read_folder(tmp_path, now=NOW), descriptors=DESCRIPTORS)
        assert [(Path(file.path).name, file.code) for file in done.rejected] == [
            ("mug__90.png", ImportProblem.NOT_DESCRIBED)
        ]
        assert done.views == 2
        catalog.database.images.remove(catalog.database.images.names())  # a search needs only what was computed
        assert views(catalog, BENCH_DESCRIPTOR).azimuth_deg.tolist() == [0.0, 180.0]

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


class TestEmptyTables:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        for seed, name in enumerate(["mug__0", "mug__90", "tin__0", "tin__90"]):
            photograph(tmp_path / "in" / f"{name}.png", seed, (32, 32))
        return tmp_path / "in"

    def test_photographs_are_enrolled_with_one_image(
        self, tmp_path: Path, folder: Path, open_catalog: OpenCatalog
    ) -> None:
        photograph(tmp_path / "empty.png", 9, (32, 32))
        batch = read_folder(folder, now=NOW)
        batch.use_empty_tables(tmp_path / "empty.png")
        catalog = open_catalog("catalog")
        done = run_import(catalog, batch)
        assert empty_tables(catalog).with_image == ("mug", "tin")
        stored = self.stored(catalog, "mug")
        assert stored == {0.0: (tmp_path / "empty.png").read_bytes(), 90.0: (tmp_path / "empty.png").read_bytes()}
        files = [*folder.iterdir(), tmp_path / "empty.png"]
        assert done.bytes == sum(path.stat().st_size for path in files)
        assert finished(verify(catalog)).findings == ()

    @pytest.mark.parametrize(
        ("names", "table_angles"),
        [(("mug", "tin"), False), (("0", "90.0"), False), (("mug", "0", "90"), False), (("0", "90"), True)],
    )
    def test_images_of_a_folder_are_named_by_object_or_by_angle(
        self, tmp_path: Path, folder: Path, open_catalog: OpenCatalog, names: tuple[str, ...], table_angles: bool
    ) -> None:
        for seed, name in enumerate(names, 10):
            photograph(tmp_path / "tables" / f"{name}.png", seed, (32, 32))
        content = {name: (tmp_path / "tables" / f"{name}.png").read_bytes() for name in names}
        batch = read_folder(folder, table_angles=table_angles, now=NOW)
        batch.use_empty_tables(tmp_path / "tables", table_angles=table_angles)
        catalog = open_catalog("catalog")
        run_import(catalog, batch)
        for name in ("mug", "tin"):
            at_0, at_90 = content.get("0", b""), content.get("90", content.get("90.0", b""))
            expected = {0.0: content.get(name, at_0), 270.0 if table_angles else 90.0: content.get(name, at_90)}
            assert self.stored(catalog, name) == expected

    def test_image_makes_the_same_photographs_another_enrollment(
        self, tmp_path: Path, folder: Path, open_catalog: OpenCatalog
    ) -> None:
        catalog = open_catalog("catalog")
        run_import(catalog, read_folder(folder, now=NOW))
        photograph(tmp_path / "empty.png", 9, (32, 32))
        batch = read_folder(folder, now=NOW)
        batch.use_empty_tables(tmp_path / "empty.png")
        assert run_import(catalog, batch, Conflict.REPLACE).replaced == ("mug", "tin")
        assert empty_tables(catalog).without_image == ()
        assert run_import(catalog, batch, Conflict.REPLACE).replaced == ()

    @pytest.mark.parametrize(
        ("make", "words"),
        [
            (lambda path: photograph(path, 9, (32, 30)), "has 30 x 32 pixels, but .*mug__0.png has 32 x 32"),
            (
                lambda path: cv2.imwrite(str(path), np.zeros((32, 32), np.uint8)),
                "is grey, but .*mug__0.png has colours",
            ),
            (lambda path: path.write_text("no image"), "cannot be used: neither a PNG nor a JPEG file"),
            (lambda _: None, "cannot be used: .*No such file"),
            (os.mkfifo, "cannot be used: .*not a regular file"),
            (Path.mkdir, "no empty-table image for 4 photographs"),
        ],
    )
    def test_unusable_image_is_rejected_before_anything_is_stored(
        self, tmp_path: Path, folder: Path, make: Callable[[Path], object], words: str
    ) -> None:
        make(tmp_path / "empty.png")
        with pytest.raises(ImportRejected, match=words) as error:
            read_folder(folder, now=NOW).use_empty_tables(tmp_path / "empty.png")
        assert "nothing was imported" in error.value.what
        assert error.value.steps

    @pytest.mark.parametrize("suffix", [".png", ".jpg"])
    def test_grey_image_is_used_with_grey_photographs(self, tmp_path: Path, suffix: str) -> None:
        for name in ("mug__0", "empty"):
            cv2.imwrite(str(tmp_path / f"{name}{suffix}"), np.zeros((32, 32), np.uint8))
        batch = read_folder(tmp_path, now=NOW)
        batch.use_empty_tables(tmp_path / f"empty{suffix}")
        assert {session.empty_table for session in next(batch.items()).enrollment.sessions} == {
            str(tmp_path / f"empty{suffix}")
        }

    def test_image_that_disappears_after_its_check_ends_the_import(
        self, tmp_path: Path, folder: Path, open_catalog: OpenCatalog
    ) -> None:
        photograph(tmp_path / "empty.png", 9, (32, 32))
        batch = read_folder(folder, now=NOW)
        batch.use_empty_tables(tmp_path / "empty.png")
        (tmp_path / "empty.png").unlink()
        catalog = open_catalog("catalog")
        with pytest.raises(ImportRejected):
            run_import(catalog, batch)
        assert untouched(catalog, images=True)

    def test_small_photographs_are_described_as_a_whole(self, folder: Path, open_catalog: OpenCatalog) -> None:
        batch = read_folder(folder, now=NOW)
        assert batch.are_whole
        catalog = open_catalog("catalog")
        run_import(catalog, batch)
        for name in DESCRIPTORS:
            assert len(views(catalog, name)) == 4

    @staticmethod
    def stored(catalog: Catalog, name: str) -> dict[float, bytes]:
        """The empty-table image of each view by its azimuth."""
        enrollment = catalog.object(name).complete
        assert enrollment is not None
        tables = [session.empty_table or "" for session in enrollment.sessions]
        return {view.azimuth_deg: catalog.image_path(tables[view.session]).read_bytes() for view in enrollment.views}
