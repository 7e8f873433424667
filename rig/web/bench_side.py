"""The process that owns the bench: control loop, devices, jobs. It answers the calls of the web process."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from pydantic import TypeAdapter

from rig.bench import Bench, open_bench
from rig.core.clock import SystemClock
from rig.core.errors import JobNotFound
from rig.plans.operator import Choice
from rig.safety.stop_channel import StopListener, listen
from rig.web.bench_catalog import BenchCatalog
from rig.web.jobs import JobQueue
from rig.web.link import Link, Message, answer
from rig.web.picture import LivePicture
from rig.web.requests import Job, JobRequest
from rig.web.setup import Setup
from rig.web.work import WorkFactory, doctor_findings
from rig.web.worker import BenchWorker

_REQUEST: Final[TypeAdapter[JobRequest]] = TypeAdapter(JobRequest)


class BenchSide:
    """The queue, the worker and the live picture of a bench, and the functions that the web process calls.

    Parameters
    ----------
    setup
        The bench.
    folder
        Folder in which the jobs are stored.
    clock
        The computer's clock.
    report
        Gets sentences about the catalog for the terminal.
    """

    def __init__(self, setup: Setup, folder: Path, clock: SystemClock, report: Callable[[str], None]) -> None:
        def opened() -> Bench:
            return open_bench(setup.bench, setup.config, seed=setup.seed)

        self.link: Link | None = None
        self.stops: StopListener = listen(setup.state_folder)
        self.picture = LivePicture(clock)
        self.queue = JobQueue(folder, clock, self._job_changed, setup.arguments, self.stops.count)
        place = setup.config.catalog_place(setup.bench)
        catalog = BenchCatalog(place, clock, lambda state: self.publish("catalog", state), report)
        factory = WorkFactory(
            *(catalog, setup.runs),
            lambda: doctor_findings(setup.bench, setup.config, setup.seed, setup.arguments),
            setup.seed or 0,
        )
        self.worker = BenchWorker(opened, self.queue, self.publish, self.picture, factory, self.stops, clock)
        self._functions: dict[str, Callable[..., Any]] = {
            "jobs": lambda: [_values(job) for job in self.queue.jobs()],
            "job": lambda job: _values(self.queue.job(job)),
            "submit": lambda request, operator: _values(self.queue.submit(_REQUEST.validate_python(request), operator)),
            "cancel": lambda job: _values(self.queue.cancel(job)),
            "pause": lambda job: _values(self.queue.pause(job)),
            "resume": lambda job: _values(self.queue.resume(job)),
            "answer": lambda job, choice: _values(self.queue.answer(job, Choice(choice))),
            "view": self._view,
            "picture": self._picture,
            "numbers": self._numbers,
        }

    def publish(self, kind: str, data: Any) -> None:
        """Send a message to the listeners of the web process, if there is one."""
        if self.link is not None:
            self.link.send({"event": kind, "data": data})

    def connect(self, link: Link) -> None:
        """Send events to a web process from now on, beginning with the present state."""
        self.link = link
        self.publish("status", self.worker.status)

    def received(self, message: Message, _content: bytes) -> None:
        """Take a message of the web process."""
        if "call" in message and self.link is not None:
            answer(self.link, self._functions, message)

    def close(self) -> None:
        self.stops.close()

    def _job_changed(self, job: Job) -> None:
        self.publish("job", _values(job))

    def _view(self, job: str, number: int) -> tuple[None, bytes]:
        found = self.worker.view(job, number)
        if found is None:
            raise JobNotFound("There is no such picture (any more).", next_step="The catalog has all enrolled views.")
        return None, found

    def _picture(self, after: int) -> tuple[Message, bytes]:
        """Return the newest frame, unless its number is ``after``, and ask the camera for more."""
        self.picture.want()
        found = self.picture.jpeg() if self.picture.number != after else None
        number, content = found or (after, b"")
        return {"number": number, "age_s": self.picture.age_s}, content

    def _numbers(self) -> Message:
        return {
            "jobs_ended": self.worker.jobs_ended,
            "stops": self.stops.count(),
            "intervals_s": list(self.worker.intervals_s),
        }


def _values(job: Job) -> dict[str, Any]:
    return job.model_dump(mode="json")
