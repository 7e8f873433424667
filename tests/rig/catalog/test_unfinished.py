"""Results of a long job that was interrupted, and what is left of their file."""

import os
from pathlib import Path
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from rig.catalog.unfinished import UnfinishedJob
from tests.fuzzing import examples

RESULTS: dict[str, Any] = {"a": [1, 2], "b": None, "ü": {"x": "0x1.8p+1"}}


def stored(path: Path, job: str = "fit") -> Path:
    with UnfinishedJob(path, job) as unfinished:
        unfinished.store({"a": RESULTS["a"]})
        unfinished.store({key: RESULTS[key] for key in ("b", "ü")})
        assert unfinished.is_stored
    return path


def loaded(path: Path, job: str = "fit") -> UnfinishedJob:
    unfinished = UnfinishedJob(path, job)
    unfinished.load()
    return unfinished


def test_results_are_read_as_they_were_stored_and_continued(tmp_path: Path) -> None:
    again = loaded(stored(tmp_path / "job"))
    assert again.found == RESULTS
    with again:
        again.store({"c": 3})
    assert loaded(tmp_path / "job").found == {**RESULTS, "c": 3}
    again.remove()
    assert list(tmp_path.iterdir()) == []
    assert loaded(tmp_path / "job").found == {}


def test_results_of_another_job_are_not_used(tmp_path: Path) -> None:
    assert loaded(stored(tmp_path / "job"), "another").found == {}


@examples(30)
@given(st.data())
def test_file_that_was_cut_off_or_damaged_keeps_the_lines_before(tmp_path_factory: Any, data: st.DataObject) -> None:
    path = stored(tmp_path_factory.mktemp("unfinished") / "job")
    content = path.read_bytes()
    cut = data.draw(st.integers(0, len(content)))
    path.write_bytes(
        content[:cut] + data.draw(st.sampled_from([b"", b"\xff\xfe\n", b"[1]\n", b"{", b"NaN\n", b"[" * 9999]))
    )
    found = loaded(path).found
    assert list(found.items()) == list(RESULTS.items())[: len(found)]
    assert len(found) >= content[:cut].count(b"\n") - 1


def test_folder_that_cannot_be_written_stops_nothing(tmp_path: Path) -> None:
    unfinished = UnfinishedJob(tmp_path / "missing" / "job", "fit")
    unfinished.load()
    unfinished.store({"a": 1})
    assert not unfinished.is_stored
    unfinished.remove()


def test_pipe_is_not_waited_for_and_a_link_is_not_followed(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "job")
    assert loaded(tmp_path / "job").found == {}
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_text("kept")
    (tmp_path / "job.part").symlink_to(elsewhere)
    assert loaded(stored(tmp_path / "job")).found == RESULTS
    assert elsewhere.read_text() == "kept"
