"""Builds a catalog of 1,000 objects with 72 views, with the records of a real bench and tiny images.

python -m benchmarks.large_catalog FOLDER [OBJECTS]

All objects have the same records, with descriptors of their own, and all views the same black image.
"""

import argparse
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import insert
from sqlalchemy.orm import Session as Transaction

from benchmarks.bench_search import VIEWS_OF_AN_OBJECT, model
from hbr import Views, descriptor
from hbr.core.arrays import LevelArray
from rig.catalog import (
    Action,
    Catalog,
    Enrollment,
    EnrollmentStatus,
    Provenance,
    Session,
    View,
    describing,
    log,
    state,
)
from rig.catalog.facts import Derived, Entry, digest_of, seal_of
from rig.core.clock import SystemClock
from rig.views import image_files
from rig.views.description import BENCH_DESCRIPTOR, PAPER_DESCRIPTOR

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


def build(folder: Path, objects: int = OBJECTS) -> Views:
    """Make the catalog in a new folder, and return the views in it."""
    views = model(objects)
    with Catalog.open(folder, clock=SystemClock()) as catalog:
        png = image_files.encode(np.zeros((480, 560, 3), np.uint8))
        image = catalog.database.images.put(png, settled=False), len(png)
        with catalog.database.write() as transaction:
            log.add(transaction, *_entries(transaction, catalog, views, *image))
        _describe(catalog, views)
    return views


def _entries(transaction: Transaction, catalog: Catalog, views: Views, image: str, size: int) -> Iterator[Entry]:
    """Insert the rows of all objects, and yield the lines of the log about them."""
    now = catalog.clock.utc()
    for j, name in enumerate(views.object_names):
        own = views.of(j)
        azimuths_deg = tuple(views.azimuth_deg[own].tolist())
        key = hashlib.sha256(name.encode()).hexdigest()
        enrollment = Enrollment(key=key, object_id=j + 1, started_utc=now, planned_azimuth_deg=azimuths_deg)
        session = Session(number=0, started_utc=now, provenance=_PROVENANCE)
        taken = [
            View(
                index=i,
                commanded_deg=-5.0 * i,
                encoder_deg=-5.0 * i + 0.03,
                imu_deg=-5.0 * i + 0.1,
                imu_sigma_deg=0.5,
                azimuth_deg=azimuth_deg,
                captured_ns=i,
                evidence=_EVIDENCE,
                region=(80, 0, 480, 480),
                image=image,
                image_bytes=size,
            )
            for i, azimuth_deg in enumerate(azimuths_deg)
        ]
        enrollment.sessions, enrollment.views = [session], taken
        for row in (enrollment, session, *taken):
            row.digest = digest_of(row, key)
        transaction.add(enrollment)
        transaction.flush()
        yield Entry(
            id=0,
            time_utc=now,
            **log.author(),
            action=Action.ENROLLED,
            object_name=name,
            object_id=j + 1,
            label=f"shelf {j % 20}",
            note="",
            deleted=False,
            created_utc=now,
            enrollment_id=enrollment.id,
            status=EnrollmentStatus.COMPLETE,
            finished_utc=now,
            seal=seal_of(enrollment),
        )
        transaction.expunge_all()


def _describe(catalog: Catalog, views: Views) -> None:
    """Store descriptors that differ from object to object, as if the images did."""
    with catalog.database.write() as transaction:
        for j, one in enumerate(state.State(transaction, catalog.clock).used()):
            own = views.of(j)
            for kind in (descriptor(PAPER_DESCRIPTOR), descriptor(BENCH_DESCRIPTOR)):
                packed = _rotating(kind.size_bytes, VIEWS_OF_AN_OBJECT, j)
                if kind.name == PAPER_DESCRIPTOR:
                    packed = kind.pack_rows(views.descriptors[own])
                content = describing.content_of(kind, packed, views.azimuth_deg[own])
                transaction.execute(insert(Derived).values(describing.row_of(one.seal, kind.name, content)))
            evidence = json.dumps([{}] * VIEWS_OF_AN_OBJECT).encode()
            transaction.execute(insert(Derived).values(describing.row_of(one.seal, describing.SEGMENTATION, evidence)))


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
    arguments = parser.parse_args()
    build(arguments.folder, arguments.objects)
    print(f"{arguments.folder}: {VIEWS_OF_AN_OBJECT} views an object")
