"""The queue of jobs: what it stores stays small, and what waits is not started by accident."""

import json

import pytest

from rig.core.errors import JobRejected, UsageError
from rig.plans.operator import Choice
from rig.web.jobs import MAX_BYTES, MAX_QUEUED, MAX_QUEUED_BYTES, STORED_BYTES, JobQueue
from rig.web.requests import EnrollRequest, HomeRequest, JobQuestion, JobState, TrayObject, TrayRequest
from sim.clock import VirtualClock

LARGE = TrayRequest(objects=[TrayObject(name=f"object-{k}", note="x" * 9000) for k in range(100)])


@pytest.fixture
def queue(tmp_path):
    return JobQueue(tmp_path, VirtualClock(), lambda _job: None)


def stored(tmp_path):
    return json.loads((tmp_path / "jobs.json").read_bytes())


def test_cancelled_large_jobs_do_not_fill_the_disk(tmp_path, queue):
    for _ in range(50):
        queue.cancel(queue.submit(LARGE, "anna").id)
        assert (tmp_path / "jobs.json").stat().st_size < STORED_BYTES + 2_000_000
    newest = queue.jobs()[0]
    again = JobQueue(tmp_path, VirtualClock(), lambda _job: None)
    assert again.problem is None
    assert again.jobs()[0] == newest
    assert len(again.jobs()) == len(queue.jobs()) < 50


def test_waiting_large_jobs_are_rejected_before_the_file_is_too_large_to_read(tmp_path, queue):
    with pytest.raises(JobRejected) as rejected:
        for _ in range(MAX_QUEUED + 1):
            queue.submit(LARGE, "anna")
    assert rejected.value.evidence["bytes"] > MAX_QUEUED_BYTES
    assert (tmp_path / "jobs.json").stat().st_size < MAX_BYTES / 2
    again = JobQueue(tmp_path, VirtualClock(), lambda _job: None)  # each gets the request that continues it
    assert again.problem is None
    assert (tmp_path / "jobs.json").stat().st_size < MAX_BYTES
    assert JobQueue(tmp_path, VirtualClock(), lambda _job: None).problem is None


def test_jobs_that_wait_are_interrupted_and_the_running_one_pauses_if_the_web_process_ends(queue):
    running = queue.submit(EnrollRequest(name="lamp"), "anna")
    waiting = [queue.submit(EnrollRequest(name=name), "anna") for name in ("mug", "cup")]
    assert queue.next().id == running.id
    queue.hold()
    assert queue.is_paused(running)
    assert [queue.job(one.id).state for one in waiting] == [JobState.INTERRUPTED] * 2
    assert queue.job(waiting[0].id).resume == waiting[0].request
    assert queue.next() is None
    queue.resume(running.id)
    assert not queue.is_paused(running)


def test_stop_is_stored_once_for_all_jobs(tmp_path, monkeypatch):
    stops = [0]
    queue = JobQueue(tmp_path, VirtualClock(), lambda _job: None, stops=lambda: stops[0])
    for _ in range(MAX_QUEUED):
        queue.submit(HomeRequest(), "anna")
    written = []
    monkeypatch.setattr("rig.web.jobs.write", lambda _path, content, mode: written.append(json.loads(content)))  # noqa: ARG005
    stops[0] += 1
    assert queue.heed_stops()
    assert not queue.heed_stops()
    assert [{job["state"] for job in jobs} for jobs in written] == [{"cancelled"}]
    assert queue.next() is None
    assert queue.submit(HomeRequest(), "anna").id == queue.next().id


def test_only_the_answers_that_a_job_offers_are_accepted(queue):
    job = queue.submit(HomeRequest(), "anna")
    with pytest.raises(JobRejected, match="asks nothing"):
        queue.answer(job.id, Choice.CONTINUE)
    queue.ask(running := queue.next(), JobQuestion(text="Is it on the table?", choices=(Choice.CONTINUE, Choice.SKIP)))
    with pytest.raises(JobRejected, match="continue, skip"):
        queue.answer(job.id, Choice.RESTART)
    queue.answer(job.id, Choice.SKIP)
    assert queue.answered(running) == (Choice.SKIP, None)
    with pytest.raises(JobRejected, match="sample"):
        queue.answer(job.id, Choice.SKIP, "S-1")


def test_repeated_request_with_its_key_is_one_job(tmp_path, queue):
    first = queue.submit(HomeRequest(), "anna", "k-1")
    assert queue.submit(HomeRequest(), "anna", "k-1") == first
    again = JobQueue(tmp_path, VirtualClock(), lambda _job: None)  # also after a restart: the first one was interrupted
    assert again.submit(HomeRequest(), "anna", "k-1").id == first.id
    assert again.submit(HomeRequest(), "ben", "k-1").id != first.id
    assert again.submit(HomeRequest(), "anna").id != again.submit(HomeRequest(), "anna").id
    with pytest.raises(UsageError, match="another request"):
        again.submit(EnrollRequest(name="lamp"), "anna", "k-1")
