"""The queue of jobs: one runs at a time. The queue survives the server; a job that was running then is interrupted."""

import json
import secrets
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from rig.catalog.results import clean_text
from rig.core.clock import Clock
from rig.core.errors import JobNotFound, JobRejected, ObjectExists, RigError, StateNotStored, UsageError, os_errors_as
from rig.core.files import read, write
from rig.core.next_steps import Do, NextStep
from rig.plans.operator import Choice
from rig.web.requests import (
    EnrollRequest,
    IdentifyRequest,
    Job,
    JobQuestion,
    JobRequest,
    JobState,
    RetakeRequest,
    TrayRequest,
)

FILE: Final = "jobs.json"
STORED: Final = 200
"""Largest number of stored jobs."""
STORED_BYTES: Final = 2_000_000
"""Largest size of the stored jobs that have ended; the oldest are dropped."""
MAX_QUEUED: Final = 50  # a script that queues without an end is noticed early
MAX_QUEUED_BYTES: Final = 4_000_000
MAX_BYTES: Final = 20_000_000
"""Largest size of the file: the waiting jobs and their continuations, a running one, and those that have ended."""


class JobQueue:
    """The jobs of one bench; all methods may be called from any thread.

    ``changed`` gets each job that has changed. ``stops`` returns the number of stops so far: a job that was submitted
    before a stop never starts.
    """

    def __init__(
        self,
        folder: Path,
        clock: Clock,
        changed: Callable[[Job], None],
        stops: Callable[[], int] = lambda: 0,
    ) -> None:
        self._file = folder / FILE
        self._clock = clock
        self._changed = changed
        self._lock = threading.RLock()
        self._arrived = threading.Condition(self._lock)
        self._jobs: dict[str, Job] = {}
        self._cancelled: set[str] = set()
        self._pausing: set[str] = set()
        self._answers: dict[str, tuple[Choice, str | None]] = {}
        self._texts: dict[str, str] = {}
        self._stops = stops
        self.heeded = stops()
        """Number of stops that have cancelled the jobs before them."""
        self.problem: RigError | None = None
        self._load()

    def jobs(self) -> list[Job]:
        """Return all jobs, the newest first."""
        with self._lock:
            return [job.model_copy() for job in reversed(self._jobs.values())]

    def job(self, job_id: str) -> Job:
        """Return a job. Raises `JobNotFound`."""
        with self._lock:
            return self._find(job_id).model_copy()

    def submit(self, request: JobRequest, operator: str, key: str | None = None, proposed: bool = False) -> Job:
        """Add a job to the queue and return it; if the operator has submitted it with this ``key``, return that job.

        A ``proposed`` job waits until it is approved.

        Raises `JobRejected`: too many jobs wait, or too large ones. `UsageError`: the key was that of another request.
        """
        with self._lock:
            self.heed_stops()  # a job that is submitted after a stop is not cancelled by it
            if key is not None and (earlier := self._submitted(operator, key)):
                if earlier.request != request:
                    raise UsageError(
                        "This Idempotency-Key was used for another request.",
                        next_step="Use a new key for each request, and the same one only to repeat it.",
                        evidence={"job": earlier.id},
                    )
                return earlier.model_copy()
            # What waits is stored at each change, so its size is limited as well as its number.
            waiting = self._waiting(JobState.QUEUED, JobState.PROPOSED)
            size = len(request.model_dump_json()) + sum(len(self._texts[job.id]) for job in waiting)
            if len(waiting) >= MAX_QUEUED or size > MAX_QUEUED_BYTES:
                raise JobRejected(
                    f"{len(waiting)} jobs wait already.",
                    next_step="Wait until some have ended, or cancel some.",
                    evidence={"jobs": len(waiting), "largest_number": MAX_QUEUED, "bytes": size},
                )
            job = Job(
                id=secrets.token_hex(6),
                request=request,
                state=JobState.PROPOSED if proposed else JobState.QUEUED,
                created_utc=self._now(),
                operator=operator,
                key=key,
            )
            self._jobs[job.id] = job
            self._store(job)
            self._arrived.notify_all()
            return job.model_copy()

    def approve(self, job_id: str, operator: str) -> Job:
        """Let a proposed job start when those before it have ended. Raises `JobNotFound`, `JobRejected`."""
        with self._lock:
            self.heed_stops()
            job = self._unended(job_id)
            if job.state is not JobState.PROPOSED:
                raise JobRejected(f"The job is {job.state}, not proposed.", next_step="Look at its state.")
            job.state, job.approved_by = JobState.QUEUED, operator
            self._store(job)
            self._arrived.notify_all()
            return job.model_copy()

    def cancel(self, job_id: str) -> Job:
        """Cancel a job; a running one ends at its next step. Raises `JobNotFound`, `JobRejected`."""
        with self._lock:
            job = self._unended(job_id)
            if job.state in (JobState.QUEUED, JobState.PROPOSED):
                self._end(JobState.CANCELLED, job)
            else:
                self._cancelled.add(job_id)
            return job.model_copy()

    def heed_stops(self) -> bool:
        """Cancel the running job and all that wait, if there was a stop since the last call; return whether."""
        with self._lock:
            stops = self._stops()
            if stops == self.heeded:
                return False
            self.heeded = stops
            self._cancelled |= {job.id for job in self._jobs.values() if not job.state.ended}
            self._end(JobState.CANCELLED, *self._waiting(JobState.QUEUED, JobState.PROPOSED))
            return True

    def hold(self) -> None:
        """Pause the running job and interrupt those that wait, because no page can show them any more."""
        with self._lock:
            self._pausing |= {job.id for job in self._jobs.values() if job.state is JobState.RUNNING}
            self._interrupt(*self._waiting())

    def pause(self, job_id: str) -> Job:
        """Pause a running job at its next view. Raises `JobNotFound`, `JobRejected`."""
        with self._lock:
            job = self._unended(job_id)
            if job.state is not JobState.RUNNING:
                raise JobRejected(f"A {job.state} job cannot be paused.", next_step="Pause a running job.")
            self._pausing.add(job_id)
            return job.model_copy()

    def resume(self, job_id: str) -> Job:
        """Resume a paused job. Raises `JobNotFound`, `JobRejected`."""
        with self._lock:
            job = self._unended(job_id)
            if job_id not in self._pausing:
                raise JobRejected("The job is not paused.", next_step="Look at its state.")
            self._pausing.discard(job_id)
            return job.model_copy()

    def answer(self, job_id: str, choice: Choice, sample: str | None = None) -> Job:
        """Answer the question of a job; ``sample`` if it asks for one.

        Raises `JobNotFound`, `JobRejected`. `UsageError`: the sample cannot be recorded.
        """
        with self._lock:
            job = self._unended(job_id)
            if job.question is None or choice not in job.question.choices:
                asked = "asks nothing" if job.question is None else f"takes {', '.join(job.question.choices)}"
                raise JobRejected(f"The job {asked}.", next_step="Load the job again and answer its question.")
            if sample is not None and not job.question.takes_sample:
                raise JobRejected("The job does not ask for a sample.", next_step="Answer without a sample.")
            self._answers[job_id] = choice, None if sample is None else clean_text(sample, "sample")
            return job.model_copy()

    # -- for the worker -----------------------------------------------------------------------------------------------

    def next(self, timeout_s: float = 0.0) -> Job | None:
        """Return the oldest job that waits, now running; None if there is none within the time."""
        with self._lock:
            self.heed_stops()
            if not self._waiting() and timeout_s > 0:
                self._arrived.wait(timeout_s)
                self.heed_stops()
            if not (waiting := self._waiting()):
                return None
            job = waiting[0]
            job.state, job.started_utc = JobState.RUNNING, self._now()
            self._store(job)
            return job

    # These two are asked during a motion, so they do not wait for the lock: another thread may be storing jobs.

    def is_cancelled(self, job: Job) -> bool:
        return job.id in self._cancelled

    def is_paused(self, job: Job) -> bool:
        return job.id in self._pausing

    def ask(self, job: Job, question: JobQuestion | None) -> None:
        """Show a question, or with None remove it."""
        with self._lock:
            self._answers.pop(job.id, None)
            job.question = question
            job.state = JobState.RUNNING if question is None else JobState.WAITING
            self._store(job)

    def answered(self, job: Job) -> tuple[Choice, str | None] | None:
        """Return the answer to the job's question, and the sample that it names, once there is one."""
        with self._lock:
            return self._answers.get(job.id)

    def update(self, job: Job, *, durable: bool = False) -> None:
        """Report that a job has changed; ``durable`` stores it."""
        with self._lock:
            if durable:
                self._store(job)
            else:
                self._changed(job.model_copy())

    def end(self, job: Job, state: JobState, error: RigError | None = None) -> None:
        """End a job; an unfinished one gets the request that continues it."""
        with self._lock:
            job.error = None if error is None else error.problem
            if state is not JobState.DONE:  # also a cancelled one: who pressed STOP continues later
                self._offer_to_continue(job, error)
            self._end(state, job)

    # -- inside -------------------------------------------------------------------------------------------------------

    def _waiting(self, *states: JobState) -> list[Job]:
        """Return the jobs that wait for the bench; of these ``states`` if any are given."""
        return [job for job in self._jobs.values() if job.state in (states or (JobState.QUEUED,))]

    def _submitted(self, operator: str, key: str) -> Job | None:
        """Return the job that an operator has submitted with a key, if it is not dropped."""
        return next((job for job in self._jobs.values() if (job.operator, job.key) == (operator, key)), None)

    def _interrupt(self, *jobs: Job) -> None:
        for job in jobs:
            self._offer_to_continue(job)
        self._end(JobState.INTERRUPTED, *jobs)

    def _end(self, state: JobState, *jobs: Job) -> None:
        """End jobs, and store them together."""
        for job in jobs:
            job.state, job.ended_utc, job.question = state, self._now(), None
            self._cancelled.discard(job.id)
            self._pausing.discard(job.id)
            self._answers.pop(job.id, None)
        if jobs:
            self._store(*jobs)

    def _offer_to_continue(self, job: Job, error: RigError | None = None) -> None:
        """Set the request that continues the work of a job that ended early, with this error."""
        request = job.request
        # A rotation, a check or a calibration leaves nothing to continue: a person asks for it again.
        if isinstance(request, EnrollRequest):
            actions = [step.action for step in (error.steps if error else ()) if isinstance(step, NextStep)]
            started = job.views > 0 or request.resume or Do.CONTINUE_ENROLLMENT in actions
            if started:
                job.resume = request.model_copy(update={"resume": True, "replace": False})
            elif not isinstance(error, ObjectExists):  # the same request would be rejected again
                job.resume = request
        elif isinstance(request, TrayRequest | IdentifyRequest | RetakeRequest):
            job.resume = request  # of a tray, complete objects are skipped, and interrupted ones resumed

    def _find(self, job_id: str) -> Job:
        if job_id not in self._jobs:
            raise JobNotFound("There is no job with that id.", next_step="Choose one of GET /api/v1/jobs.")
        return self._jobs[job_id]

    def _unended(self, job_id: str) -> Job:
        job = self._find(job_id)
        if job.state.ended:
            raise JobRejected(f"The job is {job.state} already.", next_step="Submit a new job.")
        return job

    def _now(self) -> str:
        """Return the time to the millisecond: it is the order of jobs that begin in the same second."""
        return self._clock.utc().isoformat(timespec="milliseconds").replace("+00:00", "Z")

    def _store(self, *changed: Job) -> None:
        """Store all jobs, and report those that have changed."""
        # Only what has changed is written as JSON again: a long tray takes milliseconds, and there are many.
        for job in changed:
            self._texts[job.id] = job.model_dump_json()
        self._drop_old()
        content = f"[{','.join(self._texts.values())}]".encode()
        step = (Do.FREE_DISK(), "The bench works, but the list of jobs does not survive the server.")
        try:
            with os_errors_as(StateNotStored, f"The jobs cannot be stored in {self._file}.", next_step=step):
                self._file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
                write(self._file, content, mode=0o600)
            self.problem = None
        except StateNotStored as error:  # a full disk must not stop the bench
            self.problem = error
        for job in changed:
            self._changed(job.model_copy())

    def _drop_old(self) -> None:
        """Drop the oldest jobs that have ended, beyond `STORED` and `STORED_BYTES`; the newest of them stays."""
        ended = [job for job in self._jobs.values() if job.state.ended]
        size = sum(len(self._texts[job.id]) for job in ended)
        for job in ended[:-1]:
            if len(self._jobs) <= STORED and size <= STORED_BYTES:
                break
            size -= len(self._texts.pop(job.id))
            del self._jobs[job.id]

    def _load(self) -> None:
        try:
            stored = json.loads(read(self._file, max_bytes=MAX_BYTES))
            jobs = [Job.model_validate(values) for values in stored]
        except FileNotFoundError:
            return
        except (OSError, ValueError, ValidationError, RecursionError, TypeError):
            step = "The old list is in jobs.json.damaged. No views are lost: they are in the catalog."
            self.problem = StateNotStored(f"The list of jobs in {self._file} is damaged.", next_step=step)
            with os_errors_as(StateNotStored, f"{self._file} cannot be renamed.", next_step="Delete it."):
                self._file.replace(self._file.with_suffix(".json.damaged"))
            return
        self._jobs = {job.id: job for job in jobs}
        self._texts = {job.id: job.model_dump_json() for job in jobs}
        # A program that ended in the middle of a job wrote no end of it.
        self._interrupt(*(job for job in jobs if not job.state.ended))
