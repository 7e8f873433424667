"""Bundles that are falsified or damaged are rejected and change nothing."""

import json
import stat
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hbr
from rig.catalog import Catalog
from rig.catalog.exchange import (
    read_bundle,
    read_objects,
    write_bundle,
)
from rig.catalog.exchange.bundle import MANIFEST, OBJECTS
from rig.catalog.verify import verify
from rig.core.errors import ImportRejected
from rig.views import image_files as images
from sim.clock import VirtualClock
from tests.fuzzing import examples
from tests.rig.catalog.catalog_samples import (
    finished,
    image,
    true_fill,
)
from tests.rig.catalog.exchange.exchange_samples import (
    NOW,
    OpenCatalog,
    png_of,
    rewritten,
    run_import,
    untouched,
    view_of,
)


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
            (lambda line: view_of(line)["descriptors"][0].update(version=2**31), "version"),
            (lambda line: view_of(line)["descriptors"][0].update(version=2**70), "version"),
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

    def test_bundle_of_another_version_and_other_zip_file_are_rejected(
        self, bundle: Path, tmp_path: Path, open_catalog: OpenCatalog
    ) -> None:
        manifest = json.dumps({"format": "rigcat", "version": 2}).encode()
        said = self.rejection(open_catalog, rewritten(bundle, None, **{MANIFEST: manifest}))
        assert "another version of the program" in said
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
