"""Programs that enroll and identify without end, and the same searches in one process, for `tests.servers.test_soak`.

They import little: each kill is followed by a start.
"""

import hashlib
import json
import os
import random
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import hbr
from rig.catalog import Catalog, OpenEnrollment, View
from rig.catalog.journal import Journal, deliver
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import SystemClock
from rig.core.errors import RigError
from rig.search.model import CurrentModel
from rig.views.description import PAPER_DESCRIPTOR
from tests.rig.catalog.catalog_samples import PROVENANCE, image, plan

VIEWS = 4
CLOCK = SystemClock()
WORK = {"enroll": "log", "identify": "answers"}
"""The ending of the file that a program of each kind appends a line to for each thing it has done."""


def picture(name: str, index: int) -> np.ndarray[Any, Any]:
    return image(100 * hash_of(name) + index)


def levels(name: str, index: int) -> np.ndarray[Any, Any]:
    return hbr.describe(picture(name, index), descriptor=PAPER_DESCRIPTOR)


def hash_of(name: str) -> int:
    return int.from_bytes(name.encode()[-7:], "big")


def take(enrollment: OpenEnrollment, name: str) -> None:
    """Take the views of an object and complete its enrollment."""
    for index in range(VIEWS):
        enrollment.add(View(index=index, azimuth_deg=plan(VIEWS)[index]), picture(name, index))
    enrollment.finish()


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
                    take(enrollment, name)
                    log.write(name + "\n")
                    with Catalog.open(place, clock=CLOCK) as shared:
                        deliver(journal, shared)
            except RigError as error:
                print(type(error).__name__, file=sys.stderr)


def query(name: str, index: int, seed: int) -> np.ndarray[Any, Any]:
    """Return a view of an object with changed levels: with seed 0 none, else every fourth of them at the most."""
    found = levels(name, index).copy()
    rng = np.random.default_rng(seed)
    changed = rng.integers(0, 144, 36 if seed else 0)
    found[changed] = rng.integers(0, 8, changed.size)
    return found


def answer(index: hbr.ViewIndex, asked: np.ndarray[Any, Any]) -> list[list[Any]]:
    """Return the most similar views: object, azimuth, similarity."""
    views = index.views
    found, similarities = index.search(asked, min(5, len(index)))
    return [
        [views.object_names[views.object_index[row]], float(views.azimuth_deg[row]), float(similarity)]
        for row, similarity in zip(found, similarities, strict=True)
    ]


def digest(views: hbr.Views) -> str:
    """Return a digest of everything that a search compares with."""
    found = hashlib.sha256(json.dumps(views.object_names).encode())
    for part in (views.descriptors, views.azimuth_deg, views.object_index):
        found.update(np.ascontiguousarray(part).tobytes())
    return found.hexdigest()[:16]


def identify_forever() -> None:
    """Search for objects that the model has; write each answer with its query, and each model that was searched."""
    folder, url, images, process = sys.argv[1:5]
    place = CatalogPlace(Path(folder) / process, url, images)
    rng = random.Random(f"{process} {os.getpid()}")
    with Path(folder, f"{process}.answers").open("a", buffering=1) as log:
        log.write("\n")  # a kill may have cut the last line
        while True:
            try:
                with Catalog.open(place, clock=CLOCK, read_only=True) as catalog:
                    current, model = CurrentModel(catalog, PAPER_DESCRIPTOR), ""
                    for _ in range(50):
                        index = current().index
                        known = index.views.object_names
                        if not known:
                            continue
                        if (now := digest(index.views)) != model:
                            model = now
                            log.write(json.dumps({"model": model, "names": known}) + "\n")
                        asked = rng.choice(known), rng.randrange(VIEWS), rng.choice((0, rng.randrange(1, 10**6)))
                        log.write(json.dumps([model, asked, answer(index, query(*asked))]) + "\n")
            except RigError as error:
                print(type(error).__name__, file=sys.stderr)


class Answers:
    """What the programs that identify have written."""

    def __init__(self, lines: Iterable[str]) -> None:
        self.models: dict[str, tuple[str, ...]] = {}
        self.given: dict[str, list[tuple[list[Any], list[Any]]]] = {}
        self.cut = 0
        for line in filter(None, lines):
            try:
                found = json.loads(line)
            except ValueError:
                self.cut += 1
                continue
            if isinstance(found, dict):
                self.models[found["model"]] = tuple(found["names"])
            else:
                self.given.setdefault(found[0], []).append((found[1], found[2]))

    @property
    def number(self) -> int:
        return sum(map(len, self.given.values()))

    def compare(self, folder: Path, order: Sequence[str]) -> tuple[list[str], list[Any]]:
        """Ask the same queries again in one process, with a catalog in ``folder`` that gets one object after the other.

        Returns the models that this serial run does not have, and the answers that differ from its own.
        """
        other, wrong = [], []
        with Catalog.open(folder, clock=CLOCK) as serial:
            begun = {name: serial.begin(name, planned_azimuth_deg=plan(VIEWS), provenance=PROVENANCE) for name in order}
            for model, names in sorted(self.models.items(), key=lambda one: len(one[1])):
                for name in names:
                    if (enrollment := begun.pop(name, None)) is not None:
                        take(enrollment, name)
                with CurrentModel(serial, PAPER_DESCRIPTOR) as current:
                    index = current().index
                if digest(index.views) != model:
                    other.append(model)
                for asked, given in self.given.get(model, []):
                    if (alone := answer(index, query(*asked))) != given:
                        wrong.append((asked, given, alone))
        return other, wrong
