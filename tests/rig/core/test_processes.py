"""Work in several processes ends with an explained error if one process is killed."""

from pathlib import Path

import pytest

from rig.core.errors import RigError
from rig.core.next_steps import Do
from rig.core.processes import map_in_processes
from tests.rig.core.work import blocks_interrupts, square


def test_killed_process_raises_an_error_with_a_next_step() -> None:
    with pytest.raises(RigError, match="ended before it was done") as lost:
        list(map_in_processes(square, range(6), 2))
    assert Do.RUN_AGAIN(jobs=1) in lost.value.steps


def test_interrupt_of_a_terminal_reaches_this_process_alone() -> None:
    assert sorted(map_in_processes(blocks_interrupts, [1, 2], 2)) == [(1, True), (2, True)]
    assert not blocks_interrupts(1)


def test_one_job_runs_in_this_process() -> None:
    assert list(map_in_processes(square, [1, 2], 1)) == [(1, 1), (2, 4)]


@pytest.mark.parametrize(("jobs", "most"), [(1, 1), (2, 8)])
def test_items_are_read_as_they_are_needed(jobs: int, most: int) -> None:
    numbers = iter(range(100, 200))
    results = map_in_processes(square, numbers, jobs)
    assert next(results) in [(n, n * n) for n in range(100, 100 + most)]
    assert next(numbers) <= 100 + most
    results.close()


def test_processes_import_nothing_of_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("multiprocessing", "runpy", "selectors"):
        (tmp_path / f"{module}.py").write_text("open('imported', 'w')")
    monkeypatch.chdir(tmp_path)
    assert sorted(map_in_processes(square, [1, 2], 2)) == [(1, 1), (2, 4)]
    assert not (tmp_path / "imported").exists()
