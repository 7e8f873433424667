"""What 100 objects of 72 views take on disk: their descriptors and angles alone, and in a catalog's database."""

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.bench_search import VIEWS_OF_AN_OBJECT, model
from hbr import pack
from rig.catalog import Catalog, Provenance, ViewRecord
from rig.clock import SystemClock

#: Objects that are really stored, each image synced to the disk; the database grows in proportion.
STORED_OBJECTS = 3


def main() -> None:
    views = model(100)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "models.npz"
        np.savez(
            path,
            packed=np.frombuffer(b"".join(map(pack, views.descriptors)), np.uint8).reshape(-1, 54),
            azimuth_deg=views.azimuth_deg.astype(np.float32),
            object_index=views.object_index.astype(np.uint16),
        )
        size = path.stat().st_size
        print(f"{'100 x 72 views on disk':<58} {'MB':>6} {'bytes a view':>13}")
        print(
            f"{'packed descriptors, angles and objects (bar 0.7, paper 1.5)':<58} {size / 1e6:6.2f} {size / len(views):13.1f}"
        )
        with Catalog.open(Path(folder) / "catalog", clock=SystemClock()) as catalog:
            empty = database_bytes(catalog.path)
            for name in views.object_names[:STORED_OBJECTS]:
                planned = np.arange(VIEWS_OF_AN_OBJECT) * 360 / VIEWS_OF_AN_OBJECT
                enrollment = catalog.begin(
                    name, planned_azimuth_deg=planned.tolist(), provenance=Provenance("bench", {}, {})
                )
                for i, azimuth_deg in enumerate(planned.tolist()):
                    record = ViewRecord(i, -azimuth_deg, -azimuth_deg, azimuth_deg, views.descriptors[i], 0)
                    enrollment.add(record, np.zeros((8, 8, 3), np.uint8))
                enrollment.finish()
        a_view = (database_bytes(Path(folder) / "catalog") - empty) / (STORED_OBJECTS * VIEWS_OF_AN_OBJECT)
        print(
            f"{'catalog.sqlite with the record of every view, by proportion':<58} {a_view * 7200 / 1e6:6.2f} {a_view:13.1f}"
        )


def database_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob("catalog.sqlite*"))


if __name__ == "__main__":
    main()
