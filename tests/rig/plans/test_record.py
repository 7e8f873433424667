"""The recorder of results: the answer is reported first, even if it cannot be recorded."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from rig.catalog import Catalog
from rig.catalog.results import find_results
from rig.core.next_steps import Do
from rig.events.events import Accepted, Identified, NoteCode, ObjectChanged, Recorded, Warned
from rig.events.wording import note_steps
from rig.plans.identify import ResultRecorder
from tests.rig.report.report_samples import identifying


def stream(recorder: ResultRecorder, times: int = 1):
    for _ in range(times):
        for event in identifying():
            yield event
            if recorded := recorder.add(event):
                yield recorded


@pytest.fixture
def recorder(simulated, tmp_path: Path) -> ResultRecorder:
    bench = simulated().bench
    with Catalog.open(tmp_path, clock=bench.clock):
        return ResultRecorder(tmp_path, bench, clock=bench.clock, catalog_version=lambda: "c" * 64)


def test_each_answer_is_recorded_with_its_sample_and_its_first_image(recorder, tmp_path):
    recorder.sample = "S-1"  # of the first object only
    shown = list(stream(recorder, times=2))
    assert [event for event in shown if isinstance(event, Recorded)] == [Recorded(1, "S-1"), Recorded(2, None)]
    assert all(isinstance(shown[k + 1], Recorded) for k, event in enumerate(shown) if isinstance(event, Identified))
    first = next(event for event in shown if isinstance(event, Accepted))
    with Catalog.open(tmp_path, clock=recorder.clock, read_only=True) as catalog:
        for result in find_results(catalog):
            assert np.array_equal(catalog.read_image(result.image), first.image_bgr)
            assert len(result.azimuths_deg) == result.details["views"]
            assert result.provenance.devices["camera"]


def test_result_has_the_image_and_the_views_of_the_new_object(recorder, tmp_path):
    events = list(identifying())
    changed = max(k for k, event in enumerate(events) if isinstance(event, Accepted) and event.index == 1) + 1
    for event in (*events[:changed], ObjectChanged(1, 1, 7.5, 3.0), *events[changed:]):
        recorder.add(event)
    new = [event for event in events if isinstance(event, Accepted) and event.index]
    with Catalog.open(tmp_path, clock=recorder.clock, read_only=True) as catalog:
        (result,) = find_results(catalog)
        assert np.array_equal(catalog.read_image(result.image), new[0].image_bgr)
        assert list(result.azimuths_deg) == [event.azimuth_deg for event in new]


def test_answer_is_reported_on_a_full_disk(recorder, monkeypatch):
    def fail(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fail)
        *_, answer, warned = stream(recorder)
    assert isinstance(answer, Identified)
    assert isinstance(warned, Warned)
    assert warned.note.code is NoteCode.NOT_RECORDED
    assert "full" in warned.note.values["detail"]
    assert Do.FREE_DISK() in note_steps(warned.note)


def test_missing_catalog_is_not_created(recorder, tmp_path):
    (tmp_path / "catalog.sqlite").unlink()
    *_, warned = stream(recorder)
    assert isinstance(warned, Warned)
    assert not (tmp_path / "catalog.sqlite").exists()
