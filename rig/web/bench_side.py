"""The process that owns the bench: control loop, devices, jobs. It answers the calls of the web process."""

import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import validate_call

from rig.bench import Bench, open_bench
from rig.core.clock import SystemClock
from rig.core.errors import JobNotFound
from rig.safety.stop_channel import StopListener, listen
from rig.web.bench_catalog import BenchCatalog
from rig.web.jobs import JobQueue
from rig.web.link import Functions, Link
from rig.web.picture import LivePicture
from rig.web.requests import Job
from rig.web.setup import Setup
from rig.web.work import ServedDesk
from rig.web.worker import BenchWorker


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
            bench = open_bench(setup.bench, setup.config, seed=setup.seed)
            bench.camera.observers.append(self.picture.show)
            return bench

        def run(worker: BenchWorker, job: Job) -> None:
            ServedDesk(worker, job, setup, catalog).run()

        self.link: Link | None = None
        self.stops: StopListener = listen(setup.state_folder)
        self.picture = LivePicture(clock)
        self.queue = JobQueue(folder, clock, lambda job: self.publish("job", job), setup.arguments, self.stops.count)
        place = setup.config.catalog_place(setup.bench)
        catalog = BenchCatalog(place, clock, lambda state: self.publish("catalog", state), report)
        self.worker = BenchWorker(opened, self.queue, self.publish, self.picture, run, self.stops, clock)
        asked = ("jobs", "job", "submit", "cancel", "pause", "resume", "answer")
        self._functions: Functions = {
            **{name: validate_call(getattr(self.queue, name)) for name in asked},
            "view": self._view,
            "candidates": self._candidates,
            "picture": self._picture,
            "numbers": self._numbers,
        }

    def publish(self, kind: str, data: Any) -> None:
        """Send a message to the listeners of the web process, if there is one."""
        if self.link is not None:
            self.link.tell("publish", kind=kind, data=data)

    def connect(
        self,
        connection: socket.socket,
        ended: Callable[[], None] = lambda: None,
        alive: Callable[[], None] = lambda: None,
    ) -> Link:
        """Return the link to a web process, which gets events from now on, beginning with the present state.

        ``ended`` is called when the process has gone, and ``alive`` at each of its signs of life.
        """
        self.link = link = Link(connection, {**self._functions, "alive": alive}, ended)
        link.start()
        self.publish("status", self.worker.status)
        return link

    def close(self) -> None:
        self.stops.close()

    def _view(self, job_id: str, number: int) -> tuple[None, bytes]:
        pictures = self.worker.views.get(job_id, [])
        if not 0 <= number < len(pictures):
            raise JobNotFound("There is no such picture (any more).", next_step="The catalog has all enrolled views.")
        return None, pictures[number]

    def _candidates(self, job_id: str) -> str:
        if job_id not in self.worker.charts:
            raise JobNotFound("There is no such chart (any more).", next_step="Open the report of the saved run.")
        return self.worker.charts[job_id]

    def _picture(self, after: int) -> tuple[dict[str, Any], bytes]:
        """Return the newest frame, unless its number is ``after``, and ask the camera for more."""
        self.picture.want()
        found = self.picture.jpeg() if self.picture.number != after else None
        number, content = found or (after, b"")
        return {"number": number, "age_s": self.picture.age_s}, content

    def _numbers(self) -> dict[str, Any]:
        return {
            "jobs_ended": self.worker.jobs_ended,
            "stops": self.stops.count(),
            "intervals_s": list(self.worker.intervals_s),
        }
