"""What 100 objects of 72 views take on disk: their descriptors and angles alone, and in a catalog's database."""

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.bench_search import VIEWS_OF_AN_OBJECT, model
from hbr import Views, pack
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
        print(f"{'100 x 72 views on disk':<60} {'MB':>6} {'bytes a view':>13}")
        row("packed descriptors, angles and objects (the paper: 1.5)", path.stat().st_size / len(views))
        before, after = (
            database_bytes(Path(folder) / f"catalog-{count}", views, count) for count in (0, STORED_OBJECTS)
        )
        row("catalog.sqlite with all records, by proportion", (after - before) / (STORED_OBJECTS * VIEWS_OF_AN_OBJECT))


def row(name: str, bytes_a_view: float) -> None:
    print(f"{name:<60} {bytes_a_view * 100 * VIEWS_OF_AN_OBJECT / 1e6:6.2f} {bytes_a_view:13.1f}")


def database_bytes(folder: Path, views: Views, objects: int) -> int:
    """Size of the database of a catalog with the first objects, closed."""
    with Catalog.open(folder, clock=SystemClock()) as catalog:
        for j in range(objects):
            planned = views.azimuth_deg[views.of(j)].tolist()
            enrollment = catalog.begin(
                views.object_names[j], planned_azimuth_deg=planned, provenance=Provenance("bench", {}, {})
            )
            for i, azimuth_deg in enumerate(planned):
                descriptor = views.descriptors[views.of(j)[i]]
                enrollment.add(
                    ViewRecord(i, -azimuth_deg, -azimuth_deg, azimuth_deg, descriptor, 0), np.zeros((8, 8, 3), np.uint8)
                )
            enrollment.finish()
    return sum(path.stat().st_size for path in folder.glob("catalog.sqlite*"))


if __name__ == "__main__":
    main()
