"""Benches enroll and identify at once, with kills and restarts of the server: nothing is lost or doubled."""

import json
import os
import random
import signal
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hbr
from rig.catalog import Catalog
from rig.catalog.journal import Journal, deliver
from rig.catalog.verify import Problem, verify
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import SystemClock, seconds_between
from rig.core.errors import RigError
from rig.search.current_model import CurrentModel
from tests.programs import Program
from tests.rig.catalog.catalog_samples import PROVENANCE, finished, image, plan, record
from tests.servers.postgres import place_in, server

VIEWS = 4
CLOCK = SystemClock()


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


def program(kind: str, place: CatalogPlace, process: str) -> Program:
    code = f"from tests.servers.test_soak import {kind}_forever as run; run()"
    return Program(str(place.path), str(place.url), str(place.images), process, code=code)


@pytest.mark.parametrize("seconds", [8, pytest.param(120, marks=pytest.mark.nightly)])
def test_nothing_is_lost_or_doubled(tmp_path: Path, seconds: float) -> None:
    seconds = float(os.environ.get("RIG_TEST_SOAK_S", seconds))
    rng = random.Random(1)
    with server() as running:
        place = place_in(running.url, tmp_path / "benches", str(tmp_path / "shared"))
        Catalog.open(place, clock=CLOCK).close()
        made = {f"e{n}": "enroll" for n in range(4)} | {f"i{n}": "identify" for n in range(4)}
        programs = {process: program(kind, place, process) for process, kind in made.items()}
        begun, kills, restarts = CLOCK.now_ns(), 0, 0
        while seconds_between(begun, CLOCK.now_ns()) < seconds:
            CLOCK.sleep(rng.uniform(0.5, 1.5))
            victim = rng.choice(list(programs))
            programs[victim].close()  # kill -9
            programs[victim] = program(made[victim], place, victim)
            kills += 1
            if kills % 5 == 0:
                running.stop(rng.choice([signal.SIGINT, signal.SIGQUIT, signal.SIGKILL]))
                CLOCK.sleep(rng.uniform(0, 1))
                running.start()
                restarts += 1
        for one in programs.values():
            one.close()
        for process, kind in made.items():
            if kind == "enroll":
                with (
                    Journal.of(CatalogPlace(place.path / process, place.url, place.images), CLOCK) as journal,
                    Catalog.open(place, clock=CLOCK) as shared,
                ):
                    deliver(journal, shared)
        expected = Counter(
            name
            for process in made
            if made[process] == "enroll"
            for name in (place.path / f"{process}.log").read_text().split()
        )
        with Catalog.open(place, clock=CLOCK) as shared:
            complete = {one.name: one.views for one in shared.objects() if one.enrolled_utc is not None}
            problems = Counter(one.problem for one in finished(verify(shared, quick=True, jobs=1)).findings)
            index = shared.views().views
        doubled = [name for name, views in complete.items() if views != VIEWS]
        lost = [name for name in expected if name not in complete]
        wrong_levels = sum(
            not np.array_equal(index.descriptors[index.object_index == j], [levels(name, i) for i in range(VIEWS)])
            for j, name in enumerate(index.object_names)
        )
        answers = [
            json.loads(line)
            for process in made
            if made[process] == "identify" and (place.path / f"{process}.answers").exists()
            for line in (place.path / f"{process}.answers").read_text().splitlines()
        ]
        wrong = [one for one in answers if one[0] != one[1] or one[2:] != [VIEWS, VIEWS]]
    print(f"{seconds:g} s, {kills} kills, {restarts} restarts of the server: {len(complete)} objects of {VIEWS} views")
    print(f"lost {len(lost)}, doubled {len(doubled)}, wrong rows {wrong_levels}; {dict(problems)}")
    print(f"{len(answers)} answers, {len(wrong)} wrong")
    assert (lost, doubled, wrong_levels, wrong) == ([], [], 0, [])
    assert set(problems) <= {Problem.ORPHANED_FILE}
    assert complete
