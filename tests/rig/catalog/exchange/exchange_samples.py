"""Catalogs, photographs and bundles for the tests of imports and exports."""

import sqlite3
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from rig.catalog import Catalog
from rig.catalog.derived import views
from rig.catalog.exchange.bundle import read_bundle
from rig.catalog.facts import seal_of
from rig.catalog.transfer import Conflict, TransferItem, Transferred, TransferSource, transfer
from rig.config.catalog_place import DATABASE_NAME
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import NOW, PROVENANCE, fill, finished, image, plan, record, sql
from tests.rig.catalog.catalog_samples import OpenCatalog as OpenCatalog
from tests.rig.catalog.test_hostile_catalogs import seal_as_the_sender

Members = Mapping[str, bytes | None]
"""Members of a bundle by their names; None removes one."""
NO_OTHERS: Members = {}


def fill_full(catalog: Catalog) -> None:
    fill(catalog, "gone", 1, 90)
    fill(catalog, "mug-white", 3, 0, (2, 0, 20, 20), label="kitchen", note='a chip,\n"at" the rim')
    fill(catalog, "Tässe =2+2", 2, 10)
    fill(catalog, "mug-white", 4, 20, (0, 0, 18, 18), replace=True)
    catalog.delete("gone")
    tin = catalog.begin("tin", planned_azimuth_deg=plan(3), provenance=PROVENANCE, empty_table=image(99))
    tin.add(record(0, imu_deg=0.1, imu_sigma_deg=0.5), image(30))
    tin = catalog.resume("tin", provenance=PROVENANCE)
    tin.add(record(1), image(31))
    tin.add(record(2, evidence={"sharpness": 12.5, "locks": {"gain": None}}), image(32))
    tin.finish()
    catalog.begin("cup", planned_azimuth_deg=plan(2), provenance=PROVENANCE).add(record(0), image(70))


def run_import(
    catalog: Catalog, source: TransferSource, conflict: Conflict = Conflict.REJECT, **options: Any
) -> Transferred:
    return finished(transfer(source, catalog, conflict=conflict, **{"jobs": 1, **options}))


def import_bundle(catalog: Catalog, path: Path, **options: Any) -> Transferred:
    with read_bundle(path, VirtualClock(NOW)) as source:
        return run_import(catalog, source, **options)


def untouched(catalog: Catalog, *, images: bool = False) -> bool:
    """Return whether nothing was imported; but there may be ``images`` that no row names."""
    left = [path for path in catalog.path.rglob("*") if path.is_file() and not path.name.startswith("catalog")]
    return catalog.objects() == [] and catalog.log() == [] and (images or left == [])


def model(catalog: Catalog) -> tuple[Any, ...]:
    found = views(catalog)
    return found.object_names, found.descriptors.tolist(), found.azimuth_deg.tolist(), found.object_index.tolist()


def pictures(catalog: Catalog) -> list[bytes]:
    return [
        catalog.image_path(view.image).read_bytes()
        for item in catalog.objects()
        for view in catalog.object(item.name).views
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


def rewritten(bundle: Path, *statements: str, sealed: bool = True, members: Members = NO_OTHERS) -> Path:
    """A bundle with a changed database, with right digests if it is ``sealed``, and with other ``members``."""

    def change(database: Path) -> None:
        sql(database.parent, "PRAGMA ignore_check_constraints = ON", *statements)
        if sealed:
            seal_as_the_sender(database.parent)

    return changed_bundle(bundle, bundle.with_name("changed.rigcat.zip"), change, members)


def changed_bundle(bundle: Path, target: Path, change: Callable[[Path], None], members: Members = NO_OTHERS) -> Path:
    """A bundle after a ``change`` of its database, and with other ``members``."""
    with zipfile.ZipFile(bundle) as archive:
        found: dict[str, bytes | None] = {info.filename: archive.read(info) for info in archive.infolist()}
    with TemporaryDirectory() as folder:
        database = Path(folder, DATABASE_NAME)
        database.write_bytes(found[DATABASE_NAME] or b"")
        change(database)
        with suppress(sqlite3.Error, ValueError), closing(sqlite3.connect(database)) as connection:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        found |= {DATABASE_NAME: database.read_bytes(), **members}
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in found.items():
            if content is not None:
                archive.writestr(name, content)
    return target


def facts(item: TransferItem) -> tuple[object, ...]:
    """Everything that a transfer keeps of an object."""
    enrollment = item.enrollment.key, seal_of(item.enrollment), item.finished_utc
    return item.name, item.label, item.note, item.created_utc, enrollment
