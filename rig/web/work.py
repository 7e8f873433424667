"""The job that runs on the served bench: its desk, what the pages see of it, and what they answer."""

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, closing, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from rig.bench import Bench
from rig.bench.bench import DEVICES
from rig.catalog import Catalog
from rig.catalog.copying import open_or_copy
from rig.catalog.log import asked_by
from rig.config import RigConfig
from rig.core.clock import SystemClock
from rig.core.errors import UsageError
from rig.core.json_form import plain
from rig.core.next_steps import NextSteps, as_steps
from rig.core.plugins import plugins
from rig.doctor.examination import open_context
from rig.doctor.finding import Finding
from rig.events.events import Accepted, Decided, Enrolled, Event, Identified, Started, event_dict
from rig.events.wording import next_steps, page_line
from rig.jobs.desk import Desk, JobResult, Progress, Remark, Step, Steps
from rig.jobs.doctor import examine
from rig.jobs.enroll import enroll, enroll_list, retake
from rig.jobs.identify import identify
from rig.jobs.table import acknowledge, goto, home, refer
from rig.jobs.table_image import take_table_image
from rig.motion.move import MotionTimes
from rig.plans.operator import Choice, Operator, Question
from rig.plans.tray import TrayItem
from rig.views.description import within
from rig.web import requests
from rig.web.access import LOCAL
from rig.web.picture import jpeg
from rig.web.requests import Job, JobState, TrayObject
from rig.web.worker import BenchWorker

VIEW_PX: Final = 480  # a tile on the page of the job; the full image comes from the catalog
CALIBRATIONS: Final = "rig.calibrations"
"""Entry-point group of the calibrations."""


class ServedCalibration(Protocol):
    """A calibration that a job can run, if necessary with an object that the request names."""

    @property
    def title(self) -> str: ...

    def __call__(self, desk: Desk, thing: str | None) -> Steps[bool]: ...


def calibrations() -> dict[str, ServedCalibration]:
    """Return the installed calibrations by name."""
    return dict(sorted(plugins(CALIBRATIONS)))


class ServedDesk(Desk):
    """The desk of a job of the server, and its operator: the bench is open, and the pages ask."""

    is_there = True
    log_waits_for_server = False  # which may be away: that would delay the answer to a STOP

    def __init__(self, worker: BenchWorker, job: Job) -> None:
        self.operator = self
        self.config = worker.config
        self.place = worker.setup.catalog_place
        self.job = job
        self.setup = worker.setup
        self._worker = worker
        self._left: Callable[[int], float] | None = None

    # -- what a job needs ---------------------------------------------------------------------------------------------

    def open_bench(self, devices: Iterable[str] = DEVICES) -> AbstractContextManager[Bench]:  # noqa: ARG002
        return nullcontext(self._worker.bench())

    def close_bench(self) -> None:
        """Close the bench, for a job that opens its devices itself."""
        self._worker.close()

    def open_with(self, config: RigConfig) -> None:
        """Open the bench again, with this configuration from now on."""
        self._worker.open(config)

    def who_places(self, bench: Bench) -> Operator:  # noqa: ARG002
        return self

    def open_to_read(self) -> Catalog:
        create = not self.place.may_exist()
        return open_or_copy(self.place, SystemClock(), create=create, attempts=self._worker.attempts)

    def choose(self, question: Question) -> Choice:
        asked = requests.JobQuestion(
            text=question.text, choices=tuple(question.choices), steps=as_steps(question.steps)
        )
        choice, _ = self._ask(asked)
        return choice

    def ask_sample(self) -> str | None:
        text = "Scan or type the sample that is on the table."
        _, sample = self._ask(requests.JobQuestion(text=text, choices=(Choice.CONTINUE,), takes_sample=True))
        return sample

    def _ask(self, question: requests.JobQuestion) -> tuple[Choice, str | None]:
        """Show a question, and wait for its answer; a sample only if it asks for one."""
        queue, job = self._worker.queue, self.job
        queue.ask(job, question)
        while (answer := queue.answered(job)) is None:
            self._worker.wait(job)
        queue.ask(job, None)
        return answer

    def next_folder(self) -> Path:
        """Return the folder of the job's next saved run."""
        job, runs = self.job, self.setup.runs
        name = f"{self._worker.bench().clock.utc():%Y%m%d-%H%M%S}-{job.id}"
        job.run = name if not (runs / name).exists() else f"{name}-{job.views}"
        return runs / job.run

    # -- what the pages see -------------------------------------------------------------------------------------------

    def show_step(self, step: Step) -> None:
        match step:
            case Remark(text=text, event=event, steps=steps):
                self._note(text, as_steps(steps)) if event is None else self.show(event)
            case Progress(words=text):
                self._note(text)
            case Finding():
                self._note(f"{step.topic}: {step.words}")
            case JobResult():
                self.job.result, self.job.result_text = step.values, step.text
            case _:
                self.show(step)

    def _note(self, text: str, steps: NextSteps = ()) -> None:
        if self.job.result is not None:  # of an object that was enrolled: whether it was delivered
            self.job.result_text += f"\n{text}"
        self._publish(text, steps, {"event": "note"})
        self._worker.check(self.job)

    def _publish(self, text: str, steps: NextSteps, values: dict[str, Any]) -> None:
        if steps:
            values["steps"] = plain(steps)
        self._worker.publish("plan", {"job": self.job.id, "text": text, **values}, self.job)

    def show(self, event: Event) -> None:
        """Show an event; then pause or cancel the job if the operator asked for it."""
        job, values, text = self.job, event_dict(event), page_line(event)
        # Count: views done, and the time that the others take.
        if isinstance(event, Started):
            bench = self._worker.bench()
            job.progress = requests.StepsDone(done=0, total=event.views)
            left = partial(MotionTimes(bench.config).left_s, event.angles_deg, in_motion=event.in_motion)
            self._left = left if event.angles_deg else None
        if isinstance(event, Accepted):
            self._worker.views[job.id].append(jpeg(self._described(event.image_bgr), VIEW_PX))
            values["picture"] = job.views
            job.views += 1
            if job.progress is not None:
                done = job.progress.done + 1
                left_s = None if self._left is None else self._left(done)
                job.progress = job.progress.model_copy(update={"done": done, "seconds_left": left_s})
        # Tell: the event itself, and the job where it has changed. The first view is stored, because from then on the
        # job can be continued after a kill.
        if isinstance(event, Enrolled | Identified):
            job.result, job.result_text = event, text
        self._publish(text, next_steps(event), values)
        if isinstance(event, Started | Accepted):
            self._worker.queue.update(job, durable=job.views == 1)
        # Obey: these are the places where a job may end or wait without losing a view.
        self._worker.check(job)
        if isinstance(event, Accepted | Decided):
            self._pause()

    def _described(self, image_bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the region of a frame that is described."""
        return within(image_bgr, self._worker.bench().config.view.roi)

    def _pause(self) -> None:
        """Wait while the operator wants the job to pause."""
        worker, job = self._worker, self.job
        if not worker.queue.is_paused(job):
            return
        job.state = JobState.PAUSED
        worker.queue.update(job, durable=True)
        while worker.queue.is_paused(job):
            worker.wait(job)
        job.state = JobState.RUNNING
        worker.queue.update(job, durable=True)


def run_job(worker: BenchWorker, job: Job) -> None:
    """Run a job to its end; an operator who cancels closes it, and so the torque goes off."""
    desk, request = ServedDesk(worker, job), job.request
    parameters = {name: value for name, value in request if name != "kind"}
    operator = None if job.operator == LOCAL else job.operator
    with asked_by(operator), closing(JOBS[type(request)](desk, **parameters)) as steps:
        for step in steps:
            desk.show_step(step)


# -- the jobs ----------------------------------------------------------------------------------------------------------


def _enroll(desk: ServedDesk, **parameters: Any) -> Steps[None]:
    return enroll(desk, **parameters, ask=False)


def _tray(desk: ServedDesk, objects: list[TrayObject], **parameters: Any) -> Steps[None]:
    items = [TrayItem(number, one.name, one.label, one.note, one.views) for number, one in enumerate(objects, 1)]
    return enroll_list(desk, items, **parameters, ask=False)


def _identify(desk: ServedDesk, **parameters: Any) -> Steps[Identified | None]:
    return identify(
        desk,
        **parameters,
        seed=desk.setup.seed or 0,
        person=desk.job.operator,
        next_folder=desk.next_folder,
        live=desk.show,
    )


def _examine(desk: ServedDesk) -> Steps[None]:
    desk.close_bench()  # the checks open the devices themselves
    setup = desk.setup
    opened = open_context(setup.bench, desk.config, seed=setup.seed, options=setup.arguments, is_held=True)
    return examine(setup.bench, opened)


def _lock_camera(desk: ServedDesk, **settings: float | None) -> Steps[None]:
    """Open the bench with other settings of its camera; if it does not take them, the next job has those before."""
    given = {key: value for key, value in settings.items() if value is not None}
    camera = desk.config.camera.model_copy(update=given)
    desk.open_with(desk.config.model_copy(update={"camera": camera}))
    yield JobResult(requests.CameraSettings(**settings), "The camera is locked with these settings.")


def _calibrate(desk: ServedDesk, name: str, object: str | None) -> Steps[None]:
    """Run a calibration; its results are those of the job together."""
    found = calibrations()
    if name not in found:
        raise UsageError(f"There is no calibration {name!r}.", next_step=f"Choose one of {', '.join(found)}.")
    results: list[JobResult] = []
    with closing(found[name](desk, object)) as steps:
        for step in steps:
            if isinstance(step, JobResult):
                results.append(step)
                yield Remark(step.text)
            else:
                yield step
    ran = [
        requests.CalibrationRun(name=one.values["name"], passed=one.values["passed"], text=one.text) for one in results
    ]
    yield JobResult(requests.Calibrated(calibrations=ran), "\n".join(one.text for one in results))


JOBS: Final[dict[type[BaseModel], Callable[..., Steps[object]]]] = {
    requests.EnrollRequest: _enroll,
    requests.RetakeRequest: retake,
    requests.TrayRequest: _tray,
    requests.IdentifyRequest: _identify,
    requests.EmptyTableRequest: take_table_image,
    requests.GotoRequest: goto,
    requests.HomeRequest: home,
    requests.ReferenceRequest: refer,
    requests.AcknowledgeRequest: acknowledge,
    requests.CalibrateRequest: _calibrate,
    requests.DoctorRequest: _examine,
    requests.CameraRequest: _lock_camera,
}
"""The job of each request; the fields of the request are its parameters."""
