"""The worker of a server: owns the bench, runs its jobs one after the other, and watches the bench between them.

The worker runs in the main thread of the program, because signals interrupt only that thread: SIGTERM or Ctrl+C unwind
the running job and switch the torque off, as in every other command.
"""

import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

from rig.bench import Bench
from rig.core.clock import SystemClock, seconds_between
from rig.core.errors import DeviceMismatch, DeviceNotFound, DeviceSilent, RigError
from rig.core.json_form import plain
from rig.devices.servo import ServoState
from rig.events.events import Accepted, Decided, Event, Started, event_dict
from rig.events.lines import line
from rig.motion.motion_model import MotionModel
from rig.plans.estimate import TimeLeft
from rig.plans.operator import Choice
from rig.safety.stop_channel import StopAnswer, StopListener
from rig.safety.supervisor import stopped
from rig.web.jobs import JobQueue
from rig.web.outline import Outliner
from rig.web.picture import LivePicture, ObservedCamera, jpeg
from rig.web.problems import problem
from rig.web.requests import Job, JobState, Progress, Question

IDLE_S: Final = 0.05
"""Time between two checks of the queue."""
STATUS_S: Final = 0.25
"""Time between two messages about the state of the table."""
IDLE_STATUS_S: Final = 1.0
REOPEN_S: Final = 5.0
"""Time after which a bench that could not be opened is opened again."""
INTERVALS: Final = 20_000
VIEW_PX: Final = 480
JOBS_WITH_PICTURES: Final = 10
_LOST: Final = (DeviceNotFound, DeviceMismatch, DeviceSilent)
"""After these errors the bench is opened again: a device was unplugged or replaced."""


class JobCancelled(Exception):
    """The operator cancelled the running job."""


@dataclass(slots=True)
class Context:
    """The context of a job: the open bench, and functions to report and to ask.

    ``asked`` waits for the operator's choice and returns it.
    """

    bench: Bench
    job: Job
    add: Callable[[Event], None]
    note: Callable[[str], None]
    asked: Callable[[str, tuple[Choice, ...]], Choice]
    close_bench: Callable[[], None]


Work = Callable[[Context], None]
"""Runs a job to its end, and reports through its context."""


@dataclass(slots=True)
class _Open:
    bench: Bench | None = None
    error: RigError | None = None
    tried_ns: int = 0
    status: dict[str, Any] = field(default_factory=dict)


class BenchWorker:
    """Runs jobs on one bench.

    Parameters
    ----------
    open_bench
        Opens the bench.
    queue
        The source of the jobs.
    publish
        Sends a message to the listeners: its kind, and its JSON values. It must not wait.
    picture
        Receives the camera's frames.
    work
        Returns the work of a job.
    stops
        Receives the requests to stop.
    clock
        The computer's clock.
    """

    def __init__(
        self,
        open_bench: Callable[[], Bench],
        queue: JobQueue,
        publish: Callable[[str, Any], None],
        picture: LivePicture,
        work: Callable[[Job], Work],
        stops: StopListener,
        clock: SystemClock,
    ) -> None:
        self._open_bench = open_bench
        self._queue = queue
        self._publish = publish
        self._picture = picture
        self._work = work
        self._clock = clock
        self._held = _Open()
        self._job: Job | None = None
        self._ended = threading.Event()
        self._stops = stops
        self._stops_before = stops.count()
        """Number of stops before the present job: a further one stops it."""
        self._views: dict[str, list[bytes]] = {}
        self._left: TimeLeft | None = None
        self._outline: Outliner | None = None
        self._status_ns = 0
        self._polled_ns: int | None = None
        self.intervals_s: deque[float] = deque(maxlen=INTERVALS)
        self.jobs_ended: dict[str, int] = {}

    @property
    def status(self) -> dict[str, Any]:
        """The last known state of the bench, as JSON values; a new dict after each change."""
        return self._held.status

    def view(self, job_id: str, number: int) -> bytes | None:
        """Return a picture of a job as JPEG; None if there is none (any more)."""
        pictures = self._views.get(job_id, [])
        return pictures[number] if 0 <= number < len(pictures) else None

    def end(self) -> None:
        """Make `run` return after the present step."""
        self._ended.set()

    def run(self) -> None:
        """Run jobs until `end` is called; then close the bench."""
        try:
            while not self._ended.is_set():
                job = self._queue.next(IDLE_S)
                if job is None:
                    self._idle()
                else:
                    self._run(job)
        finally:
            self._close()

    # -- jobs ---------------------------------------------------------------------------------------------------------

    def _run(self, job: Job) -> None:
        self._job = job
        self._stops_before = self._queue.heeded
        self._views[job.id] = []
        self._left = self._outline = None
        for old in list(self._views)[:-JOBS_WITH_PICTURES]:
            del self._views[old]
        self._polled_ns = None
        state, error = JobState.FAILED, None
        try:
            if self._held.bench is not None:
                self._held.bench.state.clear_stop()  # of an earlier job; `_check_stop` looks for those of this one
            work = self._work(job)
            work(self._context(job))
            state = JobState.DONE
        except JobCancelled:
            state = JobState.CANCELLED
        except RigError as failure:
            error = failure
            if self._stopped() or self._queue.is_cancelled(job):
                state = JobState.CANCELLED  # the operator asked for the stop of the motion
        except BaseException:
            self._queue.end(job, JobState.INTERRUPTED)
            raise
        finally:
            self._job = None
        self._answer_stop()
        if isinstance(error, _LOST):
            self._held.error = error
            self._close()
        self._queue.end(job, state, error)
        self.jobs_ended[state.value] = self.jobs_ended.get(state.value, 0) + 1
        self._read_status()

    def _stopped(self) -> bool:
        """Return whether STOP was pressed since the present job began."""
        return self._stops.count() != self._stops_before

    def _check_stop(self) -> None:
        """Raise `MotionStopped` after a STOP; called in each round of the control loop."""
        if self._stopped():
            raise stopped()

    def _answer_stop(self) -> None:
        """After a STOP: switch the torque off, tell it to those who wait, and cancel all jobs.

        Nothing is stored before the answer.
        """
        if not self._stopped():
            return
        self._stops_before = self._stops.count()
        self._publish("stop", {"ended": False})
        answer, bench = StopAnswer.NOT_CONFIRMED, self._held.bench
        if bench is not None:
            with suppress(RigError):
                bench.servo.torque_off()
                bench.state.clear_stop()
                answer = StopAnswer.TORQUE_OFF
        self._stops.answer(answer)
        self._queue.heed_stops()
        self._publish("stop", {"ended": True, "torque_off": answer is StopAnswer.TORQUE_OFF})

    def _context(self, job: Job) -> Context:
        return Context(
            bench=self._bench(),
            job=job,
            add=lambda event: self._add(job, event),
            note=lambda text: self._note(job, text),
            asked=lambda text, choices: self._ask(job, text, choices),
            close_bench=self._close,
        )

    def _add(self, job: Job, event: Event) -> None:
        """Report an event of the running job; then pause or cancel the job if the operator asked for it."""
        values = event_dict(event)
        if isinstance(event, Started):
            job.progress = Progress(done=0, total=event.views)
            bench = self._bench()
            self._outline = Outliner(bench)
            model = MotionModel(bench.config)
            left = TimeLeft(model, event.angles_deg, in_motion=event.in_motion)
            self._left = left if event.angles_deg else None
        if self._left is not None:
            self._left.add(event)
        if isinstance(event, Accepted):
            self._views[job.id].append(jpeg(event.image_bgr, VIEW_PX))
            values["picture"] = job.views
            values["outline_px"] = None if self._outline is None else self._outline(event.image_bgr)
            job.views += 1
            if job.progress is not None:
                left_s = None if self._left is None else self._left.seconds
                job.progress = job.progress.model_copy(update={"done": job.progress.done + 1, "seconds_left": left_s})
        self._publish("plan", {"job": job.id, "text": line(event), **values})
        if isinstance(event, Started | Accepted):
            self._queue.update(job, durable=job.views == 1)
        self._check(job, can_pause=isinstance(event, Accepted | Decided))

    def _note(self, job: Job, text: str) -> None:
        self._publish("plan", {"job": job.id, "event": "note", "text": text})
        self._check(job, can_pause=False)

    def _check(self, job: Job, *, can_pause: bool) -> None:
        if self._stopped() or self._queue.is_cancelled(job):
            raise JobCancelled
        if not (can_pause and self._queue.is_paused(job)):
            return
        job.state = JobState.PAUSED
        self._queue.update(job, durable=True)
        while self._queue.is_paused(job):
            self._wait(job)
        job.state = JobState.RUNNING
        self._queue.update(job, durable=True)

    def _ask(self, job: Job, text: str, choices: tuple[Choice, ...]) -> Choice:
        self._queue.ask(job, Question(text=text, choices=choices))
        while (choice := self._queue.answered(job)) is None:
            self._wait(job)
        self._queue.ask(job, None)
        return choice

    def _wait(self, job: Job) -> None:
        """Wait a little for the operator, with a live picture."""
        if self._stopped() or self._queue.is_cancelled(job) or self._ended.is_set():
            raise JobCancelled
        self._clock.sleep(IDLE_S)
        self._show_picture()

    # -- the bench ----------------------------------------------------------------------------------------------------

    def _bench(self) -> Bench:
        held = self._held
        if held.bench is None:
            held.tried_ns = self._clock.now_ns()
            try:
                bench = self._open_bench()
            except RigError as error:
                held.error = error
                self._read_status()
                raise
            bench.camera = ObservedCamera(bench.camera, self._picture.show)
            bench.safety.observers.append(self._observe)
            bench.safety.monitors.append(self._check_stop)
            held.bench, held.error = bench, None
            self._read_status()
        return held.bench

    def _close(self) -> None:
        bench, self._held.bench = self._held.bench, None
        if bench is not None:
            with suppress(RigError):  # the fault is latched, and the next opening reports it
                bench.close()

    def _idle(self) -> None:
        self._answer_stop()
        held, now_ns = self._held, self._clock.now_ns()
        if held.bench is None:
            if held.tried_ns == 0 or seconds_between(held.tried_ns, now_ns) > REOPEN_S:
                with suppress(RigError):
                    self._bench()
            return
        held.bench.clock.sleep(IDLE_S)
        if seconds_between(self._status_ns, now_ns) >= IDLE_STATUS_S:
            self._read_status()
        self._show_picture()

    def _show_picture(self) -> None:
        """Take a frame for the viewers, at most at the camera's rate."""
        bench, age_s = self._held.bench, self._picture.age_s
        if bench is None or not self._picture.wanted:
            return
        if age_s is not None and age_s < 1.0 / max(bench.camera.identity.fps, 1.0):
            return
        try:
            bench.camera.capture(bench.clock.now_ns())
        except RigError as error:
            self._held.error = error
            if self._job is None:
                self._close()
            self._read_status()

    def _observe(self, state: ServoState) -> None:
        """Take a reading of the servo from the control loop."""
        now_ns = self._clock.now_ns()
        if self._polled_ns is not None and state.moving:
            self.intervals_s.append(seconds_between(self._polled_ns, now_ns))
        self._polled_ns = now_ns if state.moving else None
        if seconds_between(self._status_ns, now_ns) >= STATUS_S:
            self._publish_status(state)

    def _read_status(self) -> None:
        """Ask the servo for its state, and publish it."""
        bench, state = self._held.bench, None
        if bench is not None:
            try:
                state = bench.servo.read_state()
            except RigError as error:
                self._held.error = error
                self._close()
                bench = None
        self._publish_status(state)

    def _publish_status(self, state: ServoState | None) -> None:
        held, bench = self._held, self._held.bench
        self._status_ns = self._clock.now_ns()
        values: dict[str, Any] = {"open": bench is not None, "job": self._job.id if self._job else None}
        values["error"] = plain(held.error.as_dict()) if held.error is not None and bench is None else None
        values["picture_age_s"] = self._picture.age_s
        values["problem"] = None if (found := self._queue.problem) is None else problem(found)
        if bench is not None:
            safety, config = bench.safety, bench.config
            values |= {
                "bench": bench.name,
                "state": str(safety.state),
                "fault": safety.fault.model_dump() if safety.fault else None,
                "doubt": str(safety.doubt) if safety.doubt else None,
                "limits_deg": list(config.table.limits_deg),
                "findings": list(bench.findings),
                "camera": plain(bench.camera.identity),
                "region": list(config.view.roi) if config.view.roi else None,
            }
        if bench is not None and state is not None:
            known = bench.safety.doubt is None
            table_deg = bench.safety.angle_reference.to_table(state.position_deg) if known else None
            values |= {
                "table_deg": table_deg,
                "velocity_dps": state.velocity_dps,
                "servo": {
                    "model": bench.servo.identity.model,
                    "load_percent": state.load_percent,
                    "voltage_v": state.voltage_v,
                    "temperature_c": state.temperature_c,
                    "moving": state.moving,
                },
            }
        held.status = values
        self._publish("status", values)
