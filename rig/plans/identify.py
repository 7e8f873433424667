"""The plans that identify the object on the table, once or one object after the other.

View, rank, decide, rotate, until the search ends. In motion, the first view is taken at rest. Then the table rotates
along an arc; each frame is checked, described and added to the belief. Each time the frames have covered another step
of the circle, the search decides: it ends during the rotation, continues, or gives the table another goal without a
stop. If the table arrives first, the next view is taken at rest. `ResultRecorder` records the answers in a catalog.

Decisions: docs/decisions/0002, docs/decisions/0019.
"""

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap360
from hbr.dense.pixel_fit import LocalView
from hbr.dense.session import answered
from rig.bench import Bench, Placer
from rig.catalog import Catalog, Provenance
from rig.catalog.journal import open_for_enrollment
from rig.catalog.records import RecordedOutcome
from rig.catalog.results import Answer, NewResult, record
from rig.config import RigConfig
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock, seconds_between
from rig.core.errors import CatalogError, CatalogUnavailable, MotionStopped, NoObject, RigError, ViewRejected
from rig.core.json_form import plain
from rig.devices.camera import CameraLocks, Frame
from rig.events.events import (
    Accepted,
    Event,
    Failed,
    FrameUsed,
    Identified,
    Moved,
    Note,
    NoteCode,
    ObjectChanged,
    Recorded,
    Rejected,
    Started,
    Waiting,
    WaitReason,
    Warned,
    event_dict,
)
from rig.motion.flight_views import FlightFrames
from rig.motion.move import FIRST_REST_S, Move
from rig.motion.scan_speed import can_fly, require_camera_time, scan_speed
from rig.motion.turntable import Turntable
from rig.plans.steps import ObjectCheck, accepted, announced, capture, check_camera, moved, warn_of_table
from rig.search.model import Model, begin_search, empty_table_for
from rig.search.session import AnyStrategy, Finish, Rotate, Search
from rig.views.capture import Viewer
from rig.views.description import SearchDescriber
from rig.views.empty_table import empty_table_status

FIRST_REST_IN_MOTION_S: Final = 0.15
"""Time over which the gyro is averaged before a search in motion; the fit of the trajectory corrects the bias later."""
STAMPS: Final = 30
"""Time stamps that are compared with each other: a second of frames."""
# as many as a search at rest has views: a camera that loses frames must not keep the table in motion
MOST_FLIGHTS: Final = 8
MOST_REJECTED: Final = 15  # half a second at 30 frames/s: what spoils so many does not pass by itself
"""Number of successive rejected frames after which the table stops and the next view is taken at rest."""
NEW_GOAL_DEG: Final = 10.0  # smaller: the table changes its speed for goals that show nearly the same side


@dataclass(eq=False)
class ViewsAtRest:
    """The views of a search, each at rest."""

    bench: Bench
    model: Model
    search: Search
    live: Callable[[FrameUsed], object]
    """Called with the event of each frame of a search in motion."""
    first_rest_s: float = FIRST_REST_S
    number: int = 0
    """Counts the views from 0."""
    travelled_deg: float = 0.0
    is_over: bool = False
    started_ns: int = field(init=False)
    """When the object was on the table."""
    ended_ns: int = field(init=False)
    """When the last view was decided."""
    settled_ns: int = field(init=False)
    locks: CameraLocks = field(init=False)
    unseen: list[Event] = field(default_factory=list)
    """The events of the present rotation that were not yielded yet."""
    _orientation_deg: float = field(init=False)
    _missing: CatalogError | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        bench, search = self.bench, self.search
        self.table = Turntable(bench, first_rest_s=self.first_rest_s)
        self.sign = bench.config.table.orientation_sign  # the camera moves opposite to the table
        self.viewer = Viewer(bench.camera, bench.config)
        empty_table, self.notes = empty_table_for(bench, self.model)
        self.describe = SearchDescriber(
            bench.config.view,
            search.descriptor,
            empty_table,
            revise=not search.in_motion,
            enrolled_table=self.model.empty_table,
        )
        # A search without an empty-table image still notices an empty table by that of the bench.
        own = empty_table_status(bench).table if empty_table is None else None
        self.check = ObjectCheck(bench, empty_table if own is None else own.image_bgr)

    @property
    def seconds(self) -> float:
        """The duration of the search until now, or until its end."""
        return seconds_between(self.started_ns, self.ended_ns if self.is_over else self.bench.clock.now_ns())

    @property
    def azimuth_deg(self) -> float:
        """The orientation of the camera around the object, by the measured rotations."""
        return float(wrap360(self._orientation_deg))

    def begin(self) -> Generator[Event, None, None]:
        """Begin with a table that has its torque on."""
        move = self.table.hold()
        self._orientation_deg = self.sign * move.encoder_deg
        yield self._rested(move)

    def view(self) -> Generator[Event, None, None]:
        """Add an acceptable frame at rest to the search; errors as for `rig.plans.steps.capture`."""
        # Take and describe a view; an empty table must end the plan before the search ranks it.
        captured = yield from capture(self.number, self.viewer, self.table, self.settled_ns)
        azimuth_deg = self.azimuth_deg
        described = self.describe(captured.image_bgr, azimuth_deg)
        self.locks = captured.evidence.locks
        yield accepted(self.number, azimuth_deg, captured, described)
        self.check(captured.image_bgr, azimuth_deg)
        yield from warn_of_table(self.bench, self.number, described)
        # Add it to the search; a comparison with enrolled views comes before the decision, because that depends on it.
        self.search.add(described, azimuth_deg, table_deg=self.table.rest_deg)
        if (changed := self.search.changed()) is not None:
            yield changed
        yield from self._compared()
        ranked, step = self.search.decide()
        self.ended_ns, self.is_over = self.bench.clock.now_ns(), isinstance(step, Finish)
        if self.search.is_new_decision:
            yield ranked

    def _compared(self) -> Generator[Event, None, None]:
        """Compare the views with enrolled ones, if the search asks for them.

        If an enrolled image is missing, the search decides without it; only the first one is reported.
        """
        known = self._missing
        event = answered(self.search.verify(self.describe.hypotheses), self._enrolled)
        if known is None and self._missing is not None:
            yield Warned(None, Note(NoteCode.NOT_COMPARED, plain(self._missing.problem)))
        if event is not None:
            yield event

    def _enrolled(self, object_index: int, azimuths_deg: Sequence[float]) -> Sequence[LocalView] | None:
        # The comparison with all candidates takes some tenths of a second: a stop must not wait for its end.
        self.bench.safety.check_stop_request()
        read, name = self.model.leader_views, self.search.names[object_index]
        try:
            return None if read is None else read(name, azimuths_deg)
        except CatalogError as error:
            self._missing = error
            return None

    def rotate(self, step: Rotate) -> Generator[Event, None, None]:
        """Rotate to the next view: within the cable budget, and use the measured rotation.

        A camera that moves around the object goes to the nearest azimuth with an empty-table image.
        """
        rotation_deg = self.describe.rotation_deg(self.azimuth_deg, step.rotation_deg)
        asked_deg = self.table.rest_deg + self.sign * rotation_deg
        target_deg = self.table.within_reach(asked_deg)
        yield self.search.decided(self.number, target_deg)
        move = yield from announced(self.number, self.table, target_deg, asked_deg=asked_deg)
        self.travelled_deg += abs(move.rotation_deg)
        self._orientation_deg += self.sign * move.rotation_deg
        self.number += 1
        yield self._rested(move)

    def _rested(self, move: Move) -> Moved:
        self.settled_ns = move.settled_ns
        return moved(self.number, move)


@dataclass(eq=False)
class ViewsInMotion(ViewsAtRest):
    """The views of a search in motion: those at rest, and the frames of the arcs between them.

    The frames of an arc become events at its end. ``live`` gets the event of each frame while the table still rotates.
    It must return at once, because it is called in the control loop.

    ``rejected`` and ``rejected_in_a_row`` count the frames that were not used. The table rotates to ``goal_deg``.
    """

    first_rest_s: float = FIRST_REST_IN_MOTION_S
    flights: int = 0
    rejected: int = 0
    rejected_in_a_row: int = 0
    goal_deg: float = 0.0
    _newest: tuple[NDArray[np.uint8], float] | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.velocity_dps = scan_speed(self.bench.config, self.bench.imu.range_dps).dps

    @property
    def azimuth_deg(self) -> float:
        return float(wrap360(self.sign * self.table.rest_deg))

    @cached_property
    def frames(self) -> FlightFrames:
        return FlightFrames(self.bench, self.table, newest=True)

    def begin(self) -> Generator[Event, None, None]:
        self.settled_ns = self.bench.clock.now_ns()
        yield from ()

    def rotate(self, step: Rotate) -> Generator[Event, None, None]:
        """Rotate along an arc; frames are evidence on the way."""
        (low_deg, high_deg), here_deg = self.table.limits_deg, self.table.rest_deg
        self.goal_deg = min(max(here_deg + self.sign * step.rotation_deg, low_deg), high_deg)
        if self.search.is_new_decision:
            yield self.search.decided(self.number, self.goal_deg)
        reach_deg = max(low_deg, here_deg - 360.0), min(high_deg, here_deg + 360.0)
        self.rejected_in_a_row = 0
        move = self.table.fly(self.goal_deg, self.frames.flight(self._take, reach_deg, self.velocity_dps, quiet=False))
        yield from self.unseen
        self.unseen.clear()
        self.travelled_deg += abs(move.rotation_deg)
        yield moved(self.number, move)
        if self._newest is not None:  # not in the control loop
            self.check(*self._newest)
        if self.is_over:
            return
        self.flights += 1
        self.is_over = self.flights == MOST_FLIGHTS
        self.number += 1
        yield self._rested(self.table.hold())

    def _take(self, frame: Frame) -> float | None:
        """Take a frame as evidence; return a new goal, or the stopping angle if the search has ended."""
        if self.is_over or self.rejected_in_a_row >= MOST_REJECTED:
            return self.goal_deg
        # Check the frame.
        trajectory = self.frames.recorder.fit()
        if trajectory is None:
            return None
        attempt = self.frames.attempt(frame, trajectory, self.locks, stamps=STAMPS)
        if not attempt.accepted:
            self.rejected += 1
            self.rejected_in_a_row += 1
            self.unseen.append(Rejected(self.number + 1, 1, attempt.reasons, attempt.evidence))
            return self._stop() if self.rejected_in_a_row >= MOST_REJECTED else None
        # Describe it, and add it to the search.
        self.rejected_in_a_row = 0
        self.number += 1
        assert attempt.evidence.motion is not None
        described = self.describe(attempt.image_bgr, float(wrap360(self.sign * attempt.evidence.motion.angle_deg)))
        attempt = self.frames.at_the_object(attempt, described.segmentation, trajectory)
        motion = attempt.evidence.motion
        assert motion is not None
        azimuth_deg = float(wrap360(self.sign * motion.angle_deg))
        self.unseen.append(accepted(self.number, azimuth_deg, attempt, described))
        self._newest = attempt.image_bgr, azimuth_deg
        self.search.add(described, azimuth_deg, table_deg=motion.angle_deg)
        if (changed := self.search.changed()) is not None:
            self.unseen.append(changed)
        used = self.search.frame_used(self.number, azimuth_deg, self.seconds, self.rejected)
        self.live(used)
        self.unseen.append(used)
        # Follow a new decision: stop, or steer to another goal.
        if not self.search.is_new_decision:
            return None
        ranked, step = self.search.decide()
        self.unseen.append(ranked)
        if isinstance(step, Finish):
            self.ended_ns, self.is_over = self.bench.clock.now_ns(), True
            return self._stop()
        goal_deg = motion.angle_deg + self.sign * step.rotation_deg
        if abs(goal_deg - self.goal_deg) <= NEW_GOAL_DEG:
            return None
        self.goal_deg = goal_deg
        self.unseen.append(self.search.decided(self.number, goal_deg))
        return goal_deg

    def _stop(self) -> float:
        self.goal_deg = self.table.stopping_deg(self.bench.servo.read_state())
        return self.goal_deg


def identify(
    bench: Bench,
    model: Model,
    *,
    config: RigConfig | None = None,
    placer: Placer | None = None,
    strategy: AnyStrategy | str | None = None,
    seed: int = 0,
    live: Callable[[FrameUsed], object] = lambda _: None,
) -> Generator[Event, None, Identified]:
    """Identify the object on the table; yields events and returns the answer.

    After each view the strategy chooses the next view or ends the search (`rig.search.strategies`). Closing the
    generator turns the torque off.

    The model is from `rig.search.model.load_model` or `rig.search.model.model_of`. The default strategy is the one that
    the model is for; ``seed`` is for those that draw random numbers. ``config`` are settings of the search that are not
    those of the bench. ``placer`` puts the object on the table, or waits for it; the default is that of the bench.
    ``live`` is called with the event of each frame of a search in motion while the
    table rotates; the plan yields these events when it has stopped. It must return at once.

    Raises `CatalogError`: nothing is enrolled. `CameraSettingsDiffer`: all objects were enrolled with other settings of
    the camera. `UsageError`: there is no such strategy, or the model is not for it. `NoObject`: the table is
    empty. `ViewRejected`, `MotionTimeout`, `DeviceFault`, `DeviceSilent`: see `rig.views.capture` and
    `rig.motion.turntable`.
    """
    config = config or bench.config
    if strategy is None and _flies(config, model):
        strategy = "arc"
    search = begin_search(model, config, strategy, seed=seed)
    if search.in_motion:
        require_camera_time(bench.config)
    check_camera(bench, model.camera)
    views = (ViewsInMotion if search.in_motion else ViewsAtRest)(bench, model, search, live)
    (placer or bench).place(None)
    yield Started(
        "identify",
        None,
        config.identify.max_views,
        dict(bench.conditions),
        strategy=search.strategy.name,
        seed=seed,
        descriptor=search.descriptor,
        notes=(*model.notes, *views.notes),
    )
    # Take views until the search ends.
    views.started_ns = bench.clock.now_ns()
    try:
        with views.table as table:
            yield from views.begin()
            while not views.is_over:
                yield from _noticed(search, views.view())
                if isinstance(search.step, Rotate):
                    yield from _noticed(search, views.rotate(search.step))
            seconds = views.seconds
            failed = yield from _unwound(views.number, table)
    except MotionStopped:
        raise
    except Exception:
        # The events of an interrupted arc come when the torque is off, because their consumer may pause.
        yield from views.unseen
        raise
    answer = search.answer(travelled_deg=views.travelled_deg, seconds=seconds)
    yield answer
    if failed:  # the answer is reported first
        raise failed
    return answer


def _noticed(search: Search, events: Generator[Event, None, None]) -> Generator[Event, None, None]:
    """Yield events that the search notices, as a replay of them does."""
    for event in events:
        search.notice(event)
        yield event


def _flies(config: RigConfig, model: Model) -> bool:
    """Return whether a search without a named strategy takes frames in motion, by ``identify.mode``."""
    mode = config.identify.mode
    return (
        model.is_dense and config.identify.strategy is None and (mode == "fly" or (mode == "auto" and can_fly(config)))
    )


def _unwound(number: int, table: Turntable) -> Generator[Event, None, RigError | None]:
    """Unwind the cable by whole revolutions, so that the camera sees the same side as before; return the error."""
    target_deg = table.unwound_deg()
    try:
        if table.unwound_revolutions(target_deg):
            yield from announced(number, table, target_deg)
    except RigError as error:
        return error
    return None


def watch(
    bench: Bench, identify_next: Callable[[], Generator[Event, None, Identified]]
) -> Generator[Event, None, None]:
    """Identify one object after the other, until closed; yields a `Waiting` before the events of each.

    After each answer the table returns to its start angle and unwinds its cable. If no view of an object is acceptable,
    or no object is on the table, the plan yields `Failed` and waits for the next object; any other error ends the plan.

    ``identify_next`` begins `identify` for the next object, with a model of what is enrolled then. Its placer brings
    the objects, or waits for them.

    Raises `RigError`: as `identify`, except for `NoObject` and `ViewRejected`.
    """
    with Turntable(bench) as table:
        home_deg = table.return_deg
    reason = WaitReason.FIRST_OBJECT
    while True:
        yield Waiting(reason)
        reason = WaitReason.NEXT_OBJECT
        try:
            answer = yield from identify_next()
            views = answer.views + len(answer.left_out)
        except (NoObject, ViewRejected) as error:
            yield Failed(error.problem)
            views = 0
        with Turntable(bench) as table:
            if abs(table.rest_deg - home_deg) > bench.config.table.tolerance_deg:
                yield moved(views, table.goto(home_deg))


@dataclass(eq=False)
class ResultRecorder:
    """Records each answer of `identify` or `watch`, with the image of its first view.

    If the object changed, the image is that of the view that showed it, and the views before the change do not count.

    An answer is never lost: show it before it is recorded. A catalog that cannot be written is a `Warned`.

    ``sample`` is the sample on the table, None if it has no name. It is for one object: give it before each answer.
    """

    place: CatalogPlace | Path
    bench: Bench
    clock: Clock
    """Gives the civil time of the results."""
    catalog_version: Callable[[], str]
    """Returns `Catalog.version` of the views that the search has loaded."""
    operator: str | None = None
    """None for the user's account."""
    with_image: bool = True
    sample: str | None = field(default=None, init=False)
    _image: NDArray[np.uint8] | None = field(default=None, init=False)
    _newest: NDArray[np.uint8] | None = field(default=None, init=False)
    _azimuths_deg: list[float] = field(default_factory=list, init=False)

    def add(self, event: Event) -> Recorded | Warned | None:
        """Take the next event; record an answer, and return the event about it."""
        match event:
            case Started():
                self._image, self._azimuths_deg = None, []
            case Accepted():
                self._newest = event.image_bgr if self.with_image else None
                if self._image is None:
                    self._image = self._newest
                self._azimuths_deg.append(event.azimuth_deg)
            case ObjectChanged():
                self._image = self._newest
                del self._azimuths_deg[: event.first - event.index - 1]
            case Identified():
                recorded = self._record(event)
                self.sample = None
                return recorded
            case Failed():
                self.sample = None
            case _:
                pass
        return None

    def _record(self, answer: Identified) -> Recorded | Warned:
        try:
            new = NewResult(
                Answer(RecordedOutcome(answer.outcome.value), next(iter(answer.possible), None), self.sample),
                event_dict(answer),
                tuple(self._azimuths_deg),
                Provenance(self.bench.name, self.bench.devices(), self.bench.conditions),
                self.catalog_version(),
                self.operator,
            )
            try:
                with Catalog.open(self.place, clock=self.clock, create=False) as catalog:
                    return Recorded(record(catalog, new, self._image), self.sample)
            except CatalogUnavailable:
                with open_for_enrollment(CatalogPlace.of(self.place), self.clock) as journal:
                    return Recorded(record(journal, new, self._image), self.sample)
        except RigError as error:
            return Warned(None, Note(NoteCode.NOT_RECORDED, plain(error.problem)))
