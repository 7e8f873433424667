"""Catalogs, photographs and bundles for the tests of imports and exports."""

import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rig.catalog import Catalog
from rig.catalog.edit import delete
from rig.catalog.exchange import (
    Conflict,
    ImportBatch,
    Imported,
    import_objects,
    plan_import,
)
from rig.catalog.exchange.bundle import MANIFEST, OBJECTS
from rig.views import image_files as images
from tests.rig.catalog.catalog_samples import (
    PROVENANCE,
    described,
    finished,
    image,
    plan,
    true_fill,
)

BOTH = ("cedd", "cedd-blurred")
NOW = datetime(2026, 3, 1, tzinfo=UTC)
OpenCatalog = Callable[[str], Catalog]


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


def photograph(path: Path, seed: int, size: tuple[int, int] = (12, 16)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.random.default_rng(seed).integers(0, 256, (*size, 3), np.uint8))


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
