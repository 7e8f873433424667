"""Programs that enroll and identify without end, for `tests.servers.test_soak`.

They import little: each kill is followed by a start.
"""

import json
import random
import sys
from pathlib import Path
from typing import Any

import numpy as np

import hbr
from rig.catalog import Catalog
from rig.catalog.delivery import deliver
from rig.catalog.journal import Journal
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import SystemClock
from rig.core.errors import RigError
from rig.search.current_model import CurrentModel
from tests.rig.catalog.catalog_samples import PROVENANCE, image, plan, record

VIEWS = 4
CLOCK = SystemClock()
WORK = {"enroll": "log", "identify": "answers"}
"""The ending of the file that a program of each kind appends a line to for each thing it has done."""


def levels(name: str, index: int) -> np.ndarray[Any, Any]:
    return np.random.default_rng(100 * hash_of(name) + index).integers(0, 8, 144, np.uint8)


def hash_of(name: str) -> int:
    return int.from_bytes(name.encode()[-7:], "big")


def enroll_forever() -> None:
    """Enroll objects through the journal, and print the name of each one that is complete there."""
    folder, url, images, process = sys.argv[1:5]
    place = CatalogPlace(Path(folder) / process, url, images)
    count = Path(folder, f"{process}.count")
    number = int(count.read_text()) if count.exists() else 0
    with Path(folder, f"{process}.log").open("a", buffering=1) as log:
        while True:
            number += 1
            count.write_text(str(number))
            name = f"{process}-{number}"
            try:
                with Journal.of(place, CLOCK) as journal:
                    enrollment = journal.begin(name, planned_azimuth_deg=plan(VIEWS), provenance=PROVENANCE)
                    for index in range(VIEWS):
                        enrollment.add(record(index, descriptors={"cedd": levels(name, index)}), image(index))
                    enrollment.finish()
                    log.write(name + "\n")
                    with Catalog.open(place, clock=CLOCK) as shared:
                        deliver(journal, shared)
            except RigError as error:
                print(type(error).__name__, file=sys.stderr)


def identify_forever() -> None:
    """Search for objects that the model has, with their own views; print each answer."""
    folder, url, images, process = sys.argv[1:5]
    place = CatalogPlace(Path(folder) / process, url, images)
    rng = random.Random(process)
    with Path(folder, f"{process}.answers").open("a", buffering=1) as log:
        while True:
            try:
                with Catalog.open(place, clock=CLOCK, read_only=True) as catalog:
                    current = CurrentModel(catalog, "cedd")
                    for _ in range(50):
                        index = current().index
                        known = index.views.object_names
                        if not known:
                            continue
                        name = rng.choice(known)
                        query = levels(name, rng.randrange(VIEWS))
                        best = int(
                            np.argmax(hbr.descriptor("cedd").similarity(query[None], index.views.descriptors)[0])
                        )
                        counts = np.bincount(index.views.object_index, minlength=len(known))
                        answer = known[index.views.object_index[best]]
                        log.write(json.dumps([name, answer, int(counts.min()), int(counts.max())]) + "\n")
            except RigError as error:
                print(type(error).__name__, file=sys.stderr)
