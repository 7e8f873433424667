"""The operations of several processes on one catalog have a serial order."""

import random
import uuid
from pathlib import Path

import pytest

from rig.catalog import Catalog
from rig.catalog.jobs import finished
from rig.catalog.verify import verify
from rig.core.clock import SystemClock
from tests.programs import Program
from tests.servers.history import Operation, read_log, serial_order
from tests.servers.postgres import PostgresServer, place_in

CODE = "from tests.servers.history import main; main()"


def op(process: int, begun: int, ended: int | None, name: str, *arguments: object, result: object) -> Operation:
    return Operation(process, begun, ended, name, arguments, result)


BEGUN = [
    op(1, 0, 10, "begin", "mug", "a", result="done"),
    op(2, 5, 15, "begin", "mug", "b", result="CatalogError"),
]


@pytest.mark.parametrize(
    ("history", "is_serial"),
    [
        (BEGUN, True),
        ([BEGUN[0], BEGUN[1]._replace(result="done")], False),  # one name, given twice
        ([*BEGUN, op(3, 20, 30, "list", result=[["mug", 0, 0]])], True),
        ([*BEGUN, op(3, 20, 30, "list", result=[])], False),  # a list that is older than its call
        ([*BEGUN, op(3, 7, 30, "list", result=[])], True),
        ([op(1, 0, None, "begin", "mug", "a", result=None), op(2, 5, 9, "list", result=[["mug", 0, 0]])], True),
        ([op(1, 0, None, "begin", "mug", "a", result=None), op(2, 5, 9, "list", result=[])], True),
        ([op(1, 0, 3, "list", result=[["mug", 0, 0]]), op(2, 5, 9, "begin", "mug", "a", result="done")], False),
    ],
)
def test_checker_detects_wrong_histories(history: list[Operation], is_serial: bool) -> None:
    assert (serial_order(history) is not None) is is_serial


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.nightly)])
def test_random_operations_have_a_serial_order(postgres: PostgresServer, tmp_path: Path, seed: int) -> None:
    place = place_in(postgres.url, tmp_path / "shared" / uuid.uuid4().hex)
    Catalog.open(place, clock=SystemClock()).close()
    logs = [tmp_path / f"{number}.log" for number in range(4)]
    arguments = [(str(place.path), str(place.url), str(log), str(10 * seed + n), "60") for n, log in enumerate(logs)]
    programs = [Program(*words, code=CODE) for words in arguments]
    rng = random.Random(seed)
    victim = programs[-1]
    assert victim.stdout is not None
    while not logs[-1].exists() or len(logs[-1].read_text().splitlines()) < rng.randint(20, 60):
        if victim.returncode is not None:
            break
    victim.kill()
    for program in programs[:-1]:
        out, errors = program.communicate(120)
        assert program.returncode == 0, (out, errors)
    victim.close()
    history = [one for number, log in enumerate(logs) for one in read_log(log, number)]
    assert len(history) > 150
    order = serial_order(history)
    assert order is not None
    seen = {one.result for one in history if isinstance(one.result, str)}
    assert {"done", "ObjectExists", "ObjectNotFound"} <= seen
    with Catalog.open(place, clock=SystemClock()) as catalog:
        assert finished(verify(catalog, jobs=1)).findings == ()
