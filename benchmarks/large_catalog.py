"""Builds a catalog of 1,000 objects with 72 views, with the records of a real bench and tiny images.

python -m benchmarks.large_catalog FOLDER [OBJECTS]
"""

import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.bench_search import VIEWS_OF_AN_OBJECT, model
from hbr import Views, descriptor, pack
from rig.catalog import Catalog, EnrollmentStatus
from rig.catalog.exchange import ImportBatch, import_objects, plan_import
from rig.catalog.exchange.batch import BundledDescriptor, Enrollment, ImageSource, Object, Session, View
from rig.core.clock import SystemClock
from rig.views import image_files as images
from rig.views.description import BENCH_DESCRIPTOR

OBJECTS = 1_000
_NOW = datetime(2026, 1, 1, tzinfo=UTC)
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
        "exposure_us": 8000.0,
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
_SESSION = Session(
    started_utc=_NOW,
    bench="bench-1",
    software="hbr-rig",
    devices={"servo": {"model": "xl430_w250", "firmware": 46}, "camera": {"name": "camera 0", "width": 640}},
    conditions={"view": {"roi": [80, 0, 480, 480]}},
)


def build(folder: Path, objects: int = OBJECTS) -> Views:
    """Make the catalog in a new folder, and return the views in it."""
    views = model(objects)
    with TemporaryDirectory() as aside, Catalog.open(folder, clock=SystemClock()) as catalog:
        tiny = Path(aside, "tiny.png")
        tiny.write_bytes(images.encode(np.zeros((8, 8, 3), np.uint8)))
        made = tuple(_objects(views))
        sources = {
            view.image: ImageSource(str(tiny)) for item in made for one in item.enrollments for view in one.views
        }
        for _ in import_objects(catalog, plan_import(catalog, ImportBatch("benchmark", made, sources)), jobs=1):
            pass
    return views


def _objects(views: Views) -> Iterator[Object]:
    settings = {"region": [80, 0, 480, 480]}
    own = descriptor(BENCH_DESCRIPTOR)
    for j, name in enumerate(views.object_names):
        rows = views.of(j)
        rotating = _rotating(own.size_bytes, len(rows), j)
        azimuths_deg = views.azimuth_deg[rows].tolist()
        yield Object(
            name=name,
            label=f"shelf {j % 20}",
            created_utc=_NOW,
            enrollments=(
                Enrollment(
                    status=EnrollmentStatus.COMPLETE,
                    started_utc=_NOW,
                    finished_utc=_NOW,
                    planned_azimuth_deg=tuple(azimuths_deg),
                    sessions=(_SESSION,),
                    views=tuple(
                        View(
                            index=i,
                            session=0,
                            azimuth_deg=azimuths_deg[i],
                            commanded_deg=-5.0 * i,
                            encoder_deg=-5.0 * i + 0.03,
                            imu_deg=-5.0 * i + 0.1,
                            imu_sigma_deg=0.5,
                            captured_utc=_NOW,
                            captured_ns=i,
                            image=f"{j}/{i}",
                            evidence=_EVIDENCE,
                            descriptors=(
                                BundledDescriptor(
                                    name="cedd", version=1, settings=settings, packed=pack(views.descriptors[row]).hex()
                                ),
                                BundledDescriptor(
                                    name=own.name, version=own.version, settings=settings, packed=rotating[i]
                                ),
                            ),
                        )
                        for i, row in enumerate(rows.tolist())
                    ),
                ),
            ),
        )


def _rotating(size: int, views: int, seed: int) -> list[str]:
    """Return packed levels of an object's views, as hexadecimal: a third of them changes slowly with the azimuth."""
    rng = np.random.default_rng(seed)
    base, other = rng.integers(0, 256, (2, size), np.uint8)
    begins = np.where(rng.random(size) < 1 / 3, rng.random(size), 2.0)
    share = np.arange(views)[:, None] / views
    return [row.tobytes().hex() for row in np.where((share - begins) % 1.0 < 0.5 * (begins <= 1), other, base)]


if __name__ == "__main__":
    build(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else OBJECTS)
    print(f"{sys.argv[1]}: {VIEWS_OF_AN_OBJECT} views an object")
