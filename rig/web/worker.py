"""The worker of a server: owns the bench, runs its jobs one after the other, and watches the bench between them.

The worker runs in the main thread of the program, because signals interrupt only that thread: SIGTERM or Ctrl+C unwind
the running job and switch the torque off, as in every other command.
"""

import socket
import threading
from base64 import b64encode
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

from pydantic import validate_call

from rig.bench import Bench, open_bench
from rig.catalog.copying import Attempts
from rig.config import RigConfig
from rig.core.clock import SystemClock, seconds_between
from rig.core.errors import DeviceMismatch, DeviceNotFound, DeviceSilent, JobNotFound, RigError
from rig.core.json_form import plain
from rig.core.notify import notify_of_job
from rig.devices.servo import ServoState
from rig.jobs.status import bench_facts
from rig.motion.traces import stored
from rig.safety.saved_state import SERVER_FOLDER
from rig.safety.stop_channel import StopAnswer, StopListener, listen
from rig.safety.supervisor import stopped
from rig.web.answers import BenchStatus
from rig.web.jobs import JobQueue
from rig.web.link import Link
from rig.web.picture import LivePicture, jpeg
from rig.web.requests import Job, JobState
from rig.web.setup import Setup

IDLE_S: Final = 0.05  # shorter: an idle bench heats the computer; longer: a job and a STOP at rest wait for it
"""Time between two checks of the queue."""
STATUS_S: Final = 0.25  # a page that shows the angle looks smooth enough; more messages load the bus and the network
"""Time between two messages about the state of the table."""
IDLE_STATUS_S: Final = 1.0  # at rest, the state changes by hand or supply only, and each reading occupies the bus
REOPEN_S: Final = 5.0
"""Time after which a bench that could not be opened is opened again."""
SHELF_PX: Final = 200  # a tile of the shelf; the objects are drawn on request
JOBS_WITH_PICTURES: Final = 10  # older jobs keep their events, without pictures
ASKED: Final = ("jobs", "job", "submit", "approve", "cancel", "pause", "resume", "answer")
"""Functions of the queue that the web process calls."""
_LOST: Final = (DeviceNotFound, DeviceMismatch, DeviceSilent)
"""After these errors the bench is opened again: a device was unplugged or replaced."""


class JobCancelled(Exception):
    """The operator cancelled the running job."""


class BenchWorker:
    """Runs jobs on one bench, and offers the web process its queue, its events and its pictures.

    ``run_job`` is `rig.web.work.run_job`.
    """

    def __init__(self, setup: Setup, clock: SystemClock, run_job: Callable[["BenchWorker", Job], None]) -> None:
        def changed(job: Job) -> None:
            self.publish("job", job)

        self.setup = setup
        self.config = setup.config
        """The configuration with which the bench was opened last."""
        self.attempts = Attempts(clock)
        """Those to open the catalog."""
        self.status = BenchStatus()
        """The last known state of the bench; another one after each change."""
        self.views: dict[str, list[bytes]] = {}
        """Pictures of the last jobs as JPEG."""
        self._run_job = run_job
        self._clock = clock
        self._link: Link | None = None
        self._picture = LivePicture(clock)
        self._bench: Bench | None = None
        self._locks: dict[str, Any] = {}
        """The camera's settings since the bench was opened."""
        self._error: RigError | None = None
        """Why the bench is not open."""
        self._tried_ns: int | None = None
        self._status_ns = 0
        self._job: Job | None = None
        self._ended = threading.Event()
        self._jobs_ended: Counter[str] = Counter()
        self._hands: deque[list[str]] = deque()
        """What a person at a page does by hand at a simulated bench, for the thread that owns the bench."""
        self._put: list[str] = []
        """What was put on the table last: another simulated bench, after the loss of a device, gets it again."""
        self._stops: StopListener = listen(setup.state_folder)
        self._stops_before = self._stops.count()
        """Number of stops before the present job: a further one stops it."""
        self.queue = JobQueue(setup.state_folder / SERVER_FOLDER, clock, changed, self._stops.count)

    # -- the web process ----------------------------------------------------------------------------------------------

    def connect(
        self,
        connection: socket.socket,
        ended: Callable[[], None] = lambda: None,
        alive: Callable[[], None] = lambda: None,
    ) -> Link:
        """Return the link to a web process, which gets events from now on, beginning with the present state.

        ``ended`` is called when the process has gone, and ``alive`` at each of its signs of life.
        """
        of_queue = (getattr(self.queue, name) for name in ASKED)
        functions = {
            **{function.__name__: validate_call(function) for function in of_queue},
            "view": self._view,
            "picture": self._newest,
            "numbers": self._numbers,
            "moves": lambda: [] if self._bench is None else stored(self._bench.state),
            "shelf": self._shelf_state,
            "thing": self._thing,
            "by_hand": self._by_hand,
            "alive": alive,
        }
        self._link = link = Link(connection, functions, ended)
        link.start()
        self.publish("status", self.status)
        return link

    def publish(self, kind: str, data: Any, job: Job | None = None) -> None:
        """Send a message to the listeners of the web process, if there is one; ``job`` if it is an event of one."""
        if self._link is not None:
            self._link.tell("publish", kind=kind, data=data, job=None if job is None else job.id)

    def _view(self, job_id: str, number: int) -> str:
        pictures = self.views.get(job_id, [])
        if not 0 <= number < len(pictures):
            raise JobNotFound("There is no such picture (any more).", next_step="The catalog has all enrolled views.")
        return b64encode(pictures[number]).decode()

    def _newest(self, after: int) -> dict[str, Any]:
        """Return the newest frame, unless its number is ``after``, and ask the camera for more."""
        self._picture.want()
        found = self._picture.jpeg() if self._picture.number != after else None
        number, content = found or (after, b"")
        return {"number": number, "age_s": self._picture.age_s, "jpeg": b64encode(content).decode()}

    def _numbers(self) -> dict[str, Any]:
        jobs = Counter(job.state.value for job in self.queue.jobs())
        return {"jobs": jobs, "jobs_ended": self._jobs_ended, "stops": self._stops.count()}

    # -- the shelf of a simulated bench -------------------------------------------------------------------------------

    def _shelf_state(self) -> dict[str, Any]:
        if self._bench is None or self._bench.shelf is None:
            raise JobNotFound("This bench has no simulated shelf.", next_step="Put the objects on the table by hand.")
        return {"things": list(self._bench.shelf.things), **self._bench.shelf.state()}

    def _thing(self, thing: str) -> str:
        self._shelf_state()
        assert self._bench is not None
        assert self._bench.shelf is not None
        return b64encode(jpeg(self._bench.shelf.picture(thing), SHELF_PX)).decode()

    def _by_hand(self, words: list[str]) -> dict[str, Any]:
        """Do something by hand as soon as the bench's thread looks; errors go to the pages."""
        state = self._shelf_state()
        self._hands.append(words)
        return state

    def _use_hands(self) -> None:
        bench = self._bench
        while self._hands and bench is not None and bench.shelf is not None:
            words = self._hands.popleft()
            try:
                bench.shelf.do(words)
            except RigError as failure:
                self.publish("shelf", {**bench.shelf.state(), "error": failure.problem})
                continue
            if words[0] in ("put", "clear"):
                self._put = words
            self.publish("shelf", {**bench.shelf.state(), "error": None})

    # -- jobs ---------------------------------------------------------------------------------------------------------

    def end(self) -> None:
        """Make `run` return after the present step."""
        self._ended.set()

    def run(self) -> None:
        """Run jobs until `end` is called; then close the bench."""
        try:
            while not self._ended.is_set():
                job = self.queue.next(IDLE_S)
                if job is None:
                    self._idle()
                else:
                    self._run(job)
        except BaseException as error:  # a signal, for example
            self.close(error)
            raise
        self.close()

    def _run(self, job: Job) -> None:
        """Run a job to its end, and tell its state to all who look."""
        # Show that it begins, and make room for its pictures.
        self._job = job
        # A job may ask before it reads the servo: until then, only this changes.
        self.status = self.status.model_copy(update={"job": job.id})
        self.publish("status", self.status)
        self._stops_before = self.queue.heeded  # not the present number: a stop since then is for this job
        self.views[job.id] = []
        for old in list(self.views)[:-JOBS_WITH_PICTURES]:
            del self.views[old]
        # The work itself. Whatever is not a `RigError` is a defect or a signal, and ends the program.
        state, error = JobState.FAILED, None
        try:
            if self._bench is not None:
                self._bench.state.clear_stop()  # of an earlier job; `_check_stop` looks for those of this one
                self._use_hands()
            self._run_job(self, job)
            state = JobState.DONE
        except JobCancelled:
            state = JobState.CANCELLED
        except RigError as failure:
            error = failure
            if self._stopped() or self.queue.is_cancelled(job):
                state = JobState.CANCELLED  # the operator asked for the stop of the motion
        except BaseException as failure:
            self.queue.end(job, JobState.FAILED if isinstance(failure, Exception) else JobState.INTERRUPTED)
            raise
        finally:
            self._job = None
        # The torque first: who pressed STOP waits for the answer, and the list of jobs may be on a slow disk.
        self._answer_stop()
        if isinstance(error, _LOST):
            self._error = error
            self.close()
        self.queue.end(job, state, error)
        words = job.result_text if job.error is None else job.error.detail
        notify_of_job(
            self.setup.config.notify_command, self.setup.bench, job.request.kind, words, job.model_dump(mode="json")
        )
        self._jobs_ended[state.value] += 1
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
        self.publish("stop", {"ended": False})
        answer, bench = StopAnswer.NOT_CONFIRMED, self._bench
        if bench is not None:
            with suppress(RigError):
                bench.servo.torque_off()
                bench.state.clear_stop()
                answer = StopAnswer.TORQUE_OFF
        self._stops.answer(answer)
        self.queue.heed_stops()
        self.publish("stop", {"ended": True, "torque_off": answer is StopAnswer.TORQUE_OFF})

    def check(self, job: Job) -> None:
        """Raise `JobCancelled` if the operator cancelled the running job."""
        if self._stopped() or self.queue.is_cancelled(job):
            raise JobCancelled

    def wait(self, job: Job) -> None:
        """Wait a little for the operator, with a live picture. Raises `JobCancelled`."""
        self.check(job)
        if self._ended.is_set():
            raise JobCancelled
        self._clock.sleep(IDLE_S)
        self._use_hands()
        self._show_picture()

    # -- the bench ----------------------------------------------------------------------------------------------------

    def bench(self) -> Bench:
        """Return the bench; it is opened if it is not open."""
        return self.open(self.config) if self._bench is None else self._bench

    def open(self, config: RigConfig) -> Bench:
        """Open the bench again with a configuration; if that succeeds, it is opened with this one from now on."""
        self.close()
        self._tried_ns = self._clock.now_ns()
        try:
            bench = open_bench(self.setup.bench, config, seed=self.setup.seed)
        except RigError as error:
            self._error = error
            self._read_status()
            raise
        if bench.shelf is not None:  # the person at the page takes the objects from the shelf
            bench.placer = None
            self._hands.extend([self._put] if self._put else [])
        bench.camera.observers += [self._picture.show, lambda _: self._use_hands()]
        bench.safety.observers.append(self._observe)
        bench.safety.monitors.append(self._check_stop)
        self._locks = plain(bench.camera.read_locks())
        self._bench, self._error, self.config = bench, None, config
        self._read_status()
        return bench

    def close(self, error: BaseException | None = None) -> None:
        """Close the bench; ``error`` is why."""
        bench, self._bench = self._bench, None  # first, so that no other function uses a bench that closes
        if bench is not None:
            with suppress(RigError):  # the fault is latched, and the next opening reports it
                bench.__exit__(type(error), error, None)

    def close_stops(self) -> None:
        """End the reception of stops, after `run`."""
        self._stops.close()

    def _idle(self) -> None:
        self._answer_stop()
        now_ns = self._clock.now_ns()
        if self._bench is None:
            if self._tried_ns is None or seconds_between(self._tried_ns, now_ns) > REOPEN_S:
                with suppress(RigError):
                    self.bench()
            return
        self._bench.clock.sleep(IDLE_S)
        self._use_hands()
        if seconds_between(self._status_ns, now_ns) >= IDLE_STATUS_S:
            self._read_status()
        self._show_picture()

    def _show_picture(self) -> None:
        """Take a frame for the viewers, at most at the camera's rate."""
        bench, age_s = self._bench, self._picture.age_s
        if bench is None or not self._picture.wanted:
            return
        if age_s is not None and age_s < 1.0 / max(bench.camera.identity.fps, 1.0):
            return
        try:
            bench.camera.capture(bench.clock.now_ns())
        except RigError as error:
            self._error = error
            if self._job is None:  # a job that waits for the operator meets the error itself when it continues
                self.close()
            self._read_status()

    def _observe(self, state: ServoState) -> None:
        """Take a reading of the servo from the control loop."""
        self._use_hands()
        if seconds_between(self._status_ns, self._clock.now_ns()) >= STATUS_S:
            self._publish_status(state)

    def _read_status(self) -> None:
        """Ask the servo for its state, and publish it."""
        bench, state = self._bench, None
        if bench is not None:
            try:
                state = bench.servo.read_state()
            except RigError as error:
                self._error = error
                self.close()
                bench = None
        self._publish_status(state)

    def _publish_status(self, state: ServoState | None) -> None:
        bench = self._bench
        # An open bench works; all that may be wrong then is that its list of jobs cannot be stored.
        error = self._error if bench is None else self.queue.problem
        self._status_ns = self._clock.now_ns()
        values: dict[str, Any] = {"open": bench is not None, "job": self._job.id if self._job else None}
        values["error"] = None if error is None else error.problem
        values["picture_age_s"] = self._picture.age_s
        if bench is not None:
            values |= bench_facts(bench, state)
            values |= {"camera": bench.camera.identity, "locks": self._locks, "region": bench.config.view.roi}
        # Without a reading, the values of the servo are unknown: none is shown, not the last one.
        if bench is not None and state is not None:
            values |= {
                "velocity_dps": state.velocity_dps,
                "servo": {
                    "model": bench.servo.identity.model,
                    "load_percent": state.load_percent,
                    "voltage_v": state.voltage_v,
                    "temperature_c": state.temperature_c,
                    "moving": state.moving,
                },
            }
        self.status = BenchStatus.model_validate(values)
        self.publish("status", self.status)
