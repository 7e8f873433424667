"""Bundles that are falsified or damaged are rejected and change nothing."""

import stat
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hbr
from rig.catalog import Catalog
from rig.catalog.derived import views
from rig.catalog.exchange.bundle import write_bundle
from rig.catalog.facts import json_text
from rig.catalog.images import name_of, path_of
from rig.catalog.transfer import CatalogSource
from rig.catalog.verify import verify
from rig.core.errors import ImportRejected
from rig.views.description import DESCRIPTORS
from rig.views.image_files import encode
from sim.clock import VirtualClock
from tests.fuzzing import examples
from tests.rig.catalog.catalog_samples import NOW, OpenCatalog, fill, finished, image
from tests.rig.catalog.exchange.exchange_samples import import_bundle, png_of, rewritten, untouched

FIRST = path_of(name_of(encode(image(0))))
"""Member with the image of the first view."""


class TestHostileBundles:
    def rejection(self, open_catalog: OpenCatalog, path: Path) -> str:
        catalog = open_catalog("victim")
        with pytest.raises(ImportRejected) as error:
            import_bundle(catalog, path)
        assert untouched(catalog)
        return f"{error.value.what} {error.value.evidence}"

    @pytest.mark.parametrize(
        "name",
        [
            *("../evil.png", "/etc/evil.png", "images/../../evil.png", "catalog.sqlite-wal"),
            *("images\\..\\evil.png", "C:/evil.png", "images/a\0b.png", "images/evil.png"),
        ],
    )
    def test_other_paths_are_rejected(self, bundle: Path, open_catalog: OpenCatalog, name: str, tmp_path: Path) -> None:
        info = zipfile.ZipInfo(name)
        info.filename = name  # ZipInfo itself would correct the name
        with zipfile.ZipFile(bundle, "a") as archive:
            archive.writestr(info, b"x")
        assert "was not imported" in self.rejection(open_catalog, bundle)
        assert not list(tmp_path.rglob("evil.png"))

    @pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFIFO, stat.S_IFCHR])
    def test_links_and_devices_are_rejected(self, bundle: Path, open_catalog: OpenCatalog, kind: int) -> None:
        info = zipfile.ZipInfo(FIRST.replace("images", "images/0"))
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
        changed = rewritten(
            bundle,
            f"UPDATE views SET image = '{name_of(bomb)}', image_bytes = {len(bomb)} WHERE view_index = 0",
            members={FIRST: None, path_of(name_of(bomb)): bomb},
        )
        assert "60000 x 60000 pixels" in self.rejection(open_catalog, changed)

    @pytest.mark.parametrize(
        ("statement", "words"),
        [
            ("UPDATE log SET object_name = 'a' || char(10) || 'b'", "cannot be printed"),
            ("UPDATE log SET object_name = ' mug'", "name of an object"),
            ("UPDATE log SET label = char(27) || '[2Jmug' WHERE id = 1", "control characters"),
            ("UPDATE log SET note = 'a' || char(8238) || 'b' WHERE id = 1", "control characters"),
            ("UPDATE sessions SET bench = char(27) || '[2J'", "control characters"),
            ("ALTER TABLE views ADD COLUMN colour TEXT", "other tables"),
            ("CREATE VIEW others AS SELECT 1", "other tables"),
            ("UPDATE views SET azimuth_deg = 360.0", "changed after"),
            ("UPDATE views SET azimuth_deg = 'north'", "finite number"),
            ("UPDATE views SET azimuth_deg = 9e999", "finite number"),
            ("UPDATE views SET view_index = 7 WHERE view_index = 0", "changed after"),
            ("UPDATE sessions SET number = 1", "changed after|missing row"),
            ("UPDATE views SET imu_deg = 1.0", "changed after"),
            ("UPDATE views SET image = '../../etc/passwd'", "not one of an image"),
            (f"UPDATE views SET image = '{'0' * 64}.png'", "is missing"),
            ("UPDATE views SET image_bytes = 1", "another size"),
            ("UPDATE views SET evidence = '[]'", "type dict"),
            ("UPDATE views SET evidence = '{\"a\": NaN}'", "NaN"),
            ("UPDATE views SET region = '[0, 0, -1, 5]'", "region"),
            ("UPDATE views SET captured_ns = 'x'", "type int"),
            ("UPDATE views SET captured_utc = 'yesterday'", "yesterday|datetime"),
            ("DELETE FROM views WHERE view_index = 1", "belongs to no view|changed after"),
            ("UPDATE log SET finished_utc = NULL", "changed after"),
            ("UPDATE log SET status = 'in progress'", "not complete"),
            ("UPDATE log SET status = 'finished'", "not a valid EnrollmentStatus"),
            ("UPDATE log SET object_id = 9", "owner of an enrollment"),
            ("UPDATE properties SET value = '2' WHERE key = 'version'", "another version"),
            ("UPDATE properties SET value = 'x' WHERE key = 'head'", "end of its log"),
            ("PRAGMA user_version = 2", "another version of the program"),
            ("PRAGMA application_id = 2", "another program"),
        ],
    )
    @pytest.mark.parametrize("sealed", [True, pytest.param(False, marks=pytest.mark.nightly)])
    def test_impossible_rows_are_rejected(
        self, bundle: Path, open_catalog: OpenCatalog, statement: str, words: str, sealed: bool
    ) -> None:
        sealed = sealed and "properties" not in statement
        said = self.rejection(open_catalog, rewritten(bundle, statement, sealed=sealed))
        assert not sealed or any(word in said for word in words.split("|")), said

    @pytest.mark.parametrize("views", [20_000, 0])
    def test_impossible_plans_are_rejected(self, bundle: Path, open_catalog: OpenCatalog, views: int) -> None:
        plan = f"UPDATE enrollments SET planned_azimuth_deg = '{json_text([0.0] * views)}'"
        assert "changed after" in self.rejection(open_catalog, rewritten(bundle, plan))

    def test_image_that_is_another_one_is_rejected(self, bundle: Path, open_catalog: OpenCatalog) -> None:
        other = bytearray(encode(image(0)))
        other[-20] ^= 1
        assert "is not the stored image" in self.rejection(
            open_catalog, rewritten(bundle, members={FIRST: bytes(other)})
        )

    def test_image_that_is_no_image_is_rejected(self, bundle: Path, open_catalog: OpenCatalog) -> None:
        name = name_of(b"I am no image")
        changed = rewritten(
            bundle,
            f"UPDATE views SET image = '{name}', image_bytes = 13 WHERE view_index = 0",
            members={FIRST: None, path_of(name): b"I am no image"},
        )
        assert "neither a PNG nor a JPEG" in self.rejection(open_catalog, changed)

    def test_what_is_computed_is_not_taken_from_a_bundle(self, bundle: Path, open_catalog: OpenCatalog) -> None:
        forged = "INSERT INTO derived VALUES ((SELECT seal FROM log WHERE seal IS NOT NULL), '{}', 'x', x'00', 'x')"
        catalog = open_catalog("catalog")
        import_bundle(catalog, rewritten(bundle, *(forged.format(name) for name in DESCRIPTORS)))
        assert np.array_equal(views(catalog).descriptors[0], hbr.describe(image(0)))
        assert finished(verify(catalog, jobs=1)).findings == ()

    def test_other_zip_file_is_rejected(self, tmp_path: Path, open_catalog: OpenCatalog) -> None:
        with zipfile.ZipFile(tmp_path / "holiday.zip", "w") as archive:
            archive.writestr(FIRST, b"x")
        assert "does not contain catalog.sqlite" in self.rejection(open_catalog, tmp_path / "holiday.zip")

    def test_damaged_bundle_is_rejected_or_unchanged(self, tmp_path_factory: pytest.TempPathFactory) -> None:
        folder = tmp_path_factory.mktemp("spoiled")
        with Catalog.open(folder / "source", clock=VirtualClock(NOW)) as source:
            fill(source, "mug", 1)
            write_bundle(folder / "good.zip", CatalogSource(source))
        good = (folder / "good.zip").read_bytes()
        victims = [Catalog.open(folder / "victim", clock=VirtualClock(NOW))]

        @examples(44)
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
                import_bundle(victim, path)
            except ImportRejected:
                assert untouched(victim)
                return
            assert finished(verify(victim, jobs=1)).findings == ()
            (view,) = victim.object("mug").views
            assert np.array_equal(victim.read_image(view.image), image(0))
            assert np.array_equal(views(victim).descriptors[0], hbr.describe(image(0)))
            victim.close()
            victims.append(Catalog.open(folder / f"victim-{len(victims)}", clock=VirtualClock(NOW)))

        spoil()
        victims[-1].close()
