"""Builds a catalog of 1,000 objects with 72 views, with the records of a real bench and tiny images.

python -m benchmarks.large_catalog FOLDER [OBJECTS] [--images]

All objects but the first are copies of its records, with descriptors of their own and without images. With
``--images`` each view has an image, for `rig catalog verify` and `redescribe`: a frame of 320x240 of one of four
objects of the simulator. Views that show the same are hard links to one file.
"""

import argparse
import json
import os
import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.bench_search import VIEWS_OF_AN_OBJECT, model
from hbr import Views, descriptor
from hbr.core.arrays import LevelArray
from rig.catalog import Catalog, Provenance, ViewRecord
from rig.catalog.describing import pack
from rig.catalog.seal import seal_enrollments, seal_objects
from rig.config import ViewConfig
from rig.core.clock import SystemClock
from rig.views import image_files
from rig.views.description import BENCH_DESCRIPTOR, ViewDescriber
from sim.camera import SimCapture
from sim.objects.shelf import shelf
from sim.world import World

OBJECTS = 1_000
#: The evidence that a bench stores with a view.
_EVIDENCE: dict[str, Any] = {
    "settled_ns": 5916728816,
    "exposed_ns": 5933333000,
    "sharpness": 33.943415745695134,
    "mean_level": 44.277743055555554,
    "dark_share": 0.0012,
    "saturated_share": 0.0,
    "repeated": False,
    "locks": {
        "exposure_us": 10000.0,
        "gain": None,
        "white_balance_k": 5000.0,
        "auto_exposure": False,
        "auto_white_balance": False,
    },
    "locks_hold": True,
    "stillness": {
        "peak_rate_dps": 0.2092875318066163,
        "encoder_change_deg": 0.0,
        "platter_change_deg": -0.00048664122137406784,
        "still": True,
    },
}
_PROVENANCE = Provenance(
    "bench-1",
    {"servo": {"model": "xl430_w250", "firmware": 46}, "camera": {"name": "camera 0", "width": 640}},
    {"view": {"roi": [80, 0, 480, 480]}},
)


_SMALL_REGION = (40, 0, 240, 240)
_SHOWN = ("mug-star", "teapot", "toy-car", "radio")


def build(folder: Path, objects: int = OBJECTS, *, images: bool = False) -> Views:
    """Make the catalog in a new folder, and return the views in it."""
    views = model(objects)
    frames = _frames() if images else [[np.zeros((480, 560, 3), np.uint8)] * VIEWS_OF_AN_OBJECT]
    with Catalog.open(folder, clock=SystemClock()) as catalog:
        _enroll(catalog, views, frames[0])
    with closing(sqlite3.connect(folder / "catalog.sqlite", isolation_level=None)) as connection:
        _copy(connection, views)
        if images:
            _link_images(connection, folder, frames)
    with Catalog.open(folder, clock=SystemClock()) as catalog, catalog.database.write() as writing:
        seal_objects(writing, None)
        seal_enrollments(writing, None)
    return views


def _frames() -> list[list[NDArray[np.uint8]]]:
    """Return frames of each object in `_SHOWN`, uint8 (240, 320, 3), at the azimuths of its views."""
    world = World(seed=1)
    capture = SimCapture(world)
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, 320)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, 240)
    capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1)
    capture.set(cv2.CAP_PROP_AUTO_WB, 0)
    found: list[list[NDArray[np.uint8]]] = []
    for name in _SHOWN:
        found.append([])
        for i in range(VIEWS_OF_AN_OBJECT):
            world.put(shelf()[name], i * 360 / VIEWS_OF_AN_OBJECT)
            taken, frame = capture.read()
            assert taken
            found[-1].append(np.asarray(frame, np.uint8))
    return found


def _link_images(connection: sqlite3.Connection, folder: Path, frames: Sequence[Sequence[NDArray[np.uint8]]]) -> None:
    """Give each view an image with its own name, and the descriptors of that image."""
    describe = ViewDescriber(ViewConfig(roi=_SMALL_REGION))
    kept = folder / "frames"
    kept.mkdir()
    shown = {}
    for j, of_object in enumerate(frames):
        for i, frame in enumerate(of_object):
            png, described = image_files.encode(frame), describe(frame)
            path = kept / f"{j}-{i:03d}.png"
            path.write_bytes(png)
            packed = {one.name: one.packed for one in pack(described.levels, _SMALL_REGION)}
            shown[j, i] = path, image_files.digest(png), len(png), json.dumps(described.segmentation), packed
    rows = connection.execute("SELECT id, enrollment_id, view_index, image FROM views").fetchall()
    connection.execute("BEGIN IMMEDIATE")
    for view, enrollment, i, image in rows:
        path, digest, size, segmentation, packed = shown[(enrollment - 1) % len(frames), i]
        if enrollment > 1:
            image = Path(image_files.IMAGE_FOLDER, f"{enrollment:06d}-large", f"{enrollment:06d}", f"{i:03d}.png")
            (folder / image).parent.mkdir(parents=True, exist_ok=True)
            os.link(path, folder / image)
        connection.execute(
            "UPDATE views SET image = ?, image_sha256 = ?, image_bytes = ?, segmentation = ? WHERE id = ?",
            (str(image), digest, size, segmentation, view),
        )
        connection.executemany(
            "UPDATE descriptors SET packed = ? WHERE view_id = ? AND name = ?",
            [(levels, view, name) for name, levels in packed.items()],
        )
    connection.execute("COMMIT")
    shutil.rmtree(kept)


def _enroll(catalog: Catalog, views: Views, frames: Sequence[NDArray[np.uint8]]) -> None:
    """Enroll the first object."""
    region = _SMALL_REGION if frames[0].shape[0] == 240 else (80, 0, 480, 480)
    own = descriptor(BENCH_DESCRIPTOR)
    levels = own.unpack_rows(_rotating(own.size_bytes, VIEWS_OF_AN_OBJECT, 0).tobytes())
    azimuths_deg = views.azimuth_deg[:VIEWS_OF_AN_OBJECT].tolist()
    enrollment = catalog.begin(
        views.object_names[0], planned_azimuth_deg=azimuths_deg, provenance=_PROVENANCE, label="shelf 0"
    )
    for i, azimuth_deg in enumerate(azimuths_deg):
        view = ViewRecord(
            index=i,
            commanded_deg=-5.0 * i,
            encoder_deg=-5.0 * i + 0.03,
            imu_deg=-5.0 * i + 0.1,
            imu_sigma_deg=0.5,
            azimuth_deg=azimuth_deg,
            captured_ns=i,
            evidence=_EVIDENCE,
            descriptors={"cedd": views.descriptors[i], own.name: levels[i]},
            region=region,
        )
        enrollment.add(view, frames[i])
    enrollment.finish()


def _copy(connection: sqlite3.Connection, views: Views) -> None:
    """Insert the other objects as copies of the first one's rows."""
    kinds = descriptor("cedd"), descriptor(BENCH_DESCRIPTOR)
    tables = ("objects", "enrollments", "sessions", "views")
    columns = {table: [row[1] for row in connection.execute(f"PRAGMA table_info({table})")] for table in tables}
    settings = connection.execute("SELECT settings FROM descriptors LIMIT 1").fetchone()[0]

    def copied(table: str, **changes: object) -> int | None:
        named = [name for name in columns[table] if name not in ("id", "digest")]
        values = ", ".join("?" if name in changes else name for name in named)
        where = "enrollment_id" if table == "views" else "id"
        statement = f"INSERT INTO {table} ({', '.join(named)}) SELECT {values} FROM {table} WHERE {where} = 1"
        return connection.execute(statement, [changes[name] for name in named if name in changes]).lastrowid

    connection.execute("BEGIN IMMEDIATE")
    for j, name in list(enumerate(views.object_names))[1:]:
        number = copied("objects", name=name, label=f"shelf {j % 20}")
        enrollment = copied("enrollments", object_id=number)
        copied("views", enrollment_id=enrollment, session_id=copied("sessions", enrollment_id=enrollment))
        ids = connection.execute("SELECT id FROM views WHERE enrollment_id = ? ORDER BY view_index", (enrollment,))
        packed = (
            kinds[0].pack_rows(views.descriptors[views.of(j)]),
            _rotating(kinds[1].size_bytes, VIEWS_OF_AN_OBJECT, j),
        )
        connection.executemany(
            "INSERT INTO descriptors (view_id, name, version, settings, packed) VALUES (?, ?, ?, ?, ?)",
            [
                (view_id, kind.name, kind.version, settings, row.tobytes())
                for view_id, *rows in zip((row[0] for row in ids.fetchall()), *packed, strict=True)
                for kind, row in zip(kinds, rows, strict=True)
            ],
        )
    connection.execute("COMMIT")


def _rotating(size: int, views: int, seed: int) -> LevelArray:
    """Return packed levels of an object's views: a third of them changes slowly with the azimuth."""
    rng = np.random.default_rng(seed)
    base, other = rng.integers(0, 256, (2, size), np.uint8)
    begins = np.where(rng.random(size) < 1 / 3, rng.random(size), 2.0)
    share = np.arange(views)[:, None] / views
    return np.where((share - begins) % 1.0 < 0.5 * (begins <= 1), other, base)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("objects", type=int, nargs="?", default=OBJECTS)
    parser.add_argument("--images", action="store_true")
    arguments = parser.parse_args()
    build(arguments.folder, arguments.objects, images=arguments.images)
    print(f"{arguments.folder}: {VIEWS_OF_AN_OBJECT} views an object")
