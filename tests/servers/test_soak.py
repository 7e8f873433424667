"""Benches enroll and identify at once, with kills and restarts of the server.

Nothing is lost or doubled, and each answer is that of one process that does the same with the same objects.
"""

import os
import random
import signal
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from rig.catalog import Catalog, derived
from rig.catalog.jobs import finished
from rig.catalog.journal import Journal, deliver
from rig.catalog.verify import verify
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import seconds_between
from tests.programs import Program
from tests.rig.catalog.catalog_samples import without_waiting
from tests.servers.postgres import place_in, server
from tests.servers.soak import CLOCK, VIEWS, WORK, Answers, levels

MADE = {f"e{n}": "enroll" for n in range(4)} | {f"i{n}": "identify" for n in range(4)}
"""The programs with their kinds."""
PATIENCE_S = 60


def program(kind: str, place: CatalogPlace, process: str) -> Program:
    code = f"from tests.servers.soak import {kind}_forever as run; run()"
    return Program(str(place.path), str(place.url), str(place.images), process, code=code)


def lines(place: CatalogPlace, process: str) -> list[str]:
    """Return what a program has done so far."""
    path = place.path / f"{process}.{WORK[MADE[process]]}"
    return path.read_text().splitlines() if path.exists() else []


def wait_for_work(place: CatalogPlace, process: str, before: int) -> None:
    """Wait until a program has done something since its start: a kill in its imports would show nothing."""
    begun = CLOCK.now_ns()
    while len(lines(place, process)) <= before:
        assert seconds_between(begun, CLOCK.now_ns()) < PATIENCE_S, f"{process} does nothing"
        CLOCK.sleep(0.05)


@pytest.mark.parametrize("seconds", [8, pytest.param(180, marks=[pytest.mark.nightly, pytest.mark.timeout(600)])])
def test_nothing_is_lost_or_doubled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    seconds = float(os.environ.get("RIG_TEST_SOAK_S", seconds))
    rng = random.Random(1)
    with server() as running:
        place = place_in(running.url, tmp_path / "benches", str(tmp_path / "shared"))
        Catalog.open(place, clock=CLOCK).close()
        programs = {process: program(kind, place, process) for process, kind in MADE.items()}
        done = dict.fromkeys(MADE, 0)
        begun, kills, restarts = CLOCK.now_ns(), 0, 0
        while seconds_between(begun, CLOCK.now_ns()) < seconds:
            victim = rng.choice(list(programs))
            wait_for_work(place, victim, done[victim])
            CLOCK.sleep(rng.uniform(0, 1))
            programs[victim].close()  # kill -9
            done[victim] = len(lines(place, victim))
            programs[victim] = program(MADE[victim], place, victim)
            kills += 1
            if kills % 5 == 0:
                running.stop(rng.choice([signal.SIGINT, signal.SIGQUIT, signal.SIGKILL]))
                CLOCK.sleep(rng.uniform(0, 1))
                running.start()
                restarts += 1
        for one in programs.values():
            one.close()
        for process, kind in MADE.items():
            if kind == "enroll":
                with (
                    Journal.of(CatalogPlace(place.path / process, place.url, place.images), CLOCK) as journal,
                    Catalog.open(place, clock=CLOCK) as shared,
                ):
                    deliver(journal, shared)
        expected = [name for process in MADE if MADE[process] == "enroll" for name in lines(place, process)]
        with Catalog.open(place, clock=CLOCK) as shared:
            complete = {one.name: one.views for one in shared.objects() if one.enrolled_utc is not None}
            problems = Counter(one.problem for one in finished(verify(shared, jobs=1)).findings)
            views = derived.views(shared)
            delivered = {name: len(shared.object(name).enrollments) for name in complete}
        doubled = [name for name, number in complete.items() if number != VIEWS or delivered[name] != 1]
        lost = [name for name in expected if name not in complete]
        wrong_levels = sum(
            not np.array_equal(views.descriptors[views.object_index == j], [levels(name, i) for i in range(VIEWS)])
            for j, name in enumerate(views.object_names)
        )
        answers = Answers(line for process in MADE if MADE[process] == "identify" for line in lines(place, process))
        without_waiting(monkeypatch)
        other, wrong = answers.compare(tmp_path / "serial", views.object_names)
    print(f"{seconds:g} s, {kills} kills, {restarts} restarts of the server: {len(complete)} objects of {VIEWS} views")
    print(f"lost {len(lost)}, doubled {len(doubled)}, wrong rows {wrong_levels}; {dict(problems)}")
    print(f"{answers.number} answers on {len(answers.models)} states of the catalog; {answers.cut} lines cut by kills")
    print(f"against a serial run: {len(other)} other states, {len(wrong)} other answers")
    assert (lost, doubled, wrong_levels, other, wrong) == ([], [], 0, [], [])
    assert answers.number
    assert answers.cut <= kills + len(MADE)
    assert not problems
    assert complete
