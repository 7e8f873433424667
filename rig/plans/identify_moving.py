"""The part of an identification in which the table rotates: every frame on the way is evidence.

The first view is taken at rest. Then the table rotates along an arc; each frame is checked, described and added to the
belief. Each time the frames have covered another step of the circle, the search decides: it ends during the rotation,
continues, or gives the table another goal without a stop. If the table arrives first, the next view is taken at rest.

Decision: docs/decisions/0047.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr import StopReason
from hbr.core.angles import wrap360
from rig.bench import Bench
from rig.core.clock import seconds_between
from rig.core.errors import MotionStopped, RigError
from rig.events.events import Decided, Event, FrameUsed, Ranked, Rejected
from rig.motion.flight_views import FlightFrameCheck
from rig.motion.scan_speed import scan_speed
from rig.motion.trajectory import TrajectoryRecorder
from rig.motion.turntable import Flight, Turntable
from rig.plans.capture import accepted, add_view, capture, moved, unwind, warn_of_table
from rig.search.session import ArcSearch
from rig.search.strategies import Finish, Rotate
from rig.views.capture import Viewer
from rig.views.description import ViewDescriber
from rig.views.stream import FrameStream

FIRST_REST_S: Final = 0.15
"""Time over which the gyro is averaged before the first view; the fit of the trajectory corrects the bias later."""
STAMPS: Final = 30
"""Time stamps that are compared with each other: a second of frames."""
MOST_FLIGHTS: Final = 8
MOST_REJECTED: Final = 15
"""Number of successive rejected frames after which the table stops and the next view is taken at rest."""
NEW_GOAL_DEG: Final = 10.0


@dataclass
class Found:
    """The end of a search in motion."""

    ranked: Ranked
    end: Finish
    travelled_deg: float
    seconds: float
    failed: RigError | None


@dataclass
class _ArcFrames:
    """The frames of an arc: the function `Flight.each` of a search."""

    bench: Bench
    table: Turntable
    search: ArcSearch
    stream: FrameStream
    recorder: TrajectoryRecorder
    frame_check: FlightFrameCheck
    describe: ViewDescriber
    top: int
    live: Callable[[FrameUsed], object]
    started_ns: int
    number: int
    rejected: int
    ranked: Ranked
    step: Rotate | Finish
    goal_deg: float
    events: list[Event]
    ended_ns: int | None = None
    rejected_in_a_row: int = 0
    stamps_ns: list[int] = field(default_factory=list)

    def each(self) -> float | None:
        """Take the next frame as evidence; return a new goal, or the stopping angle if the search has ended."""
        frame = self.stream.next(self.table.collect_gyro, newest=True)
        if frame is None:
            return None
        self.stamps_ns = [*self.stamps_ns[1 - STAMPS :], frame.stamp_ns]
        if self.ended_ns is not None or self.rejected_in_a_row >= MOST_REJECTED:
            return self.goal_deg
        # Check the frame.
        trajectory = self.recorder.fit()
        if trajectory is None:
            return None
        irregular = bool(self.frame_check.irregular(self.stamps_ns)[-1])
        attempt = self.frame_check.attempt(frame, trajectory, irregular=irregular)
        if not attempt.accepted:
            self.rejected += 1
            self.rejected_in_a_row += 1
            self.events.append(Rejected(self.number + 1, 1, attempt.reasons, attempt.evidence))
            return self._stop() if self.rejected_in_a_row >= MOST_REJECTED else None
        # Describe it, and add it to the search.
        self.rejected_in_a_row = 0
        self.number += 1
        described = self.describe(attempt.image_bgr)
        attempt = self.frame_check.at_the_object(attempt, described.segmentation, trajectory)
        motion = attempt.evidence.motion
        assert motion is not None
        sign = self.bench.config.table.orientation_sign
        azimuth_deg = float(wrap360(sign * motion.angle_deg))
        self.events.append(accepted(self.number, azimuth_deg, attempt, described))
        self.ranked, self.step = add_view(self.search, described, azimuth_deg, motion.angle_deg)
        seconds = seconds_between(self.started_ns, self.bench.clock.now_ns())
        used = self.search.frame_used(self.number, azimuth_deg, seconds, self.rejected)
        self.live(used)
        self.events.append(used)
        # Follow a new decision: stop, or steer to another goal.
        if not self.search.is_new_decision:
            return None
        self.events.append(self.ranked)
        if isinstance(self.step, Finish):
            self.ended_ns = self.bench.clock.now_ns()
            return self._stop()
        goal_deg = motion.angle_deg + sign * self.step.rotation_deg
        if abs(goal_deg - self.goal_deg) <= NEW_GOAL_DEG:
            return None
        self.goal_deg = goal_deg
        self.events.append(decided(self.number, self.step, goal_deg, self.top))
        return goal_deg

    def _stop(self) -> float:
        """Return the angle at which the table stops if it brakes now."""
        self.goal_deg = self.table.stopping_deg(self.bench.servo.read_state())
        return self.goal_deg


def search_in_motion(
    bench: Bench,
    search: ArcSearch,
    viewer: Viewer,
    describe: ViewDescriber,
    *,
    check: Callable[[NDArray[np.uint8]], None],
    top: int,
    started_ns: int,
    live: Callable[[FrameUsed], object],
) -> Generator[Event, None, Found]:
    """Search along arcs until the stopping rule ends the search; the frames of an arc become events at its end.

    ``check`` gets the first view, and raises an error if it shows no object. ``live`` gets the event of each frame
    while the table still rotates. It must return at once, because it is called in the control loop. Raises what
    `rig.plans.identify.identify` raises. After a fault in an arc, the events of its frames come when the torque is off,
    because the consumer of events may pause. After a stop they do not come.
    """
    left: list[Event] = []
    try:
        found = yield from _search(
            bench, search, viewer, describe, left, top=top, started_ns=started_ns, check=check, live=live
        )
    except MotionStopped:
        raise
    except Exception:
        yield from left
        raise
    return found


def _search(
    bench: Bench,
    search: ArcSearch,
    viewer: Viewer,
    describe: ViewDescriber,
    left: list[Event],
    *,
    check: Callable[[NDArray[np.uint8]], None],
    top: int,
    started_ns: int,
    live: Callable[[FrameUsed], object],
) -> Generator[Event, None, Found]:
    """Search; ``left`` receives the events of an arc that have not been yielded."""
    config = bench.config
    sign = config.table.orientation_sign
    speed = scan_speed(config, fps=config.camera.fps, gyro_range_dps=bench.imu.range_dps, spacing_deg=None)
    travelled_deg = 0.0
    number = rejected = 0
    failed: RigError | None = None
    with Turntable(bench, first_rest_s=FIRST_REST_S) as table:
        low_deg, high_deg = table.limits_deg
        stream: FrameStream | None = None
        recorder: TrajectoryRecorder | None = None
        settled_ns = bench.clock.now_ns()
        for _ in range(MOST_FLIGHTS):
            # A view at rest: the first one, and after each arc that ended without an answer.
            captured = yield from capture(number, viewer, table, settled_ns)
            azimuth_deg = float(wrap360(sign * table.rest_deg))
            described = describe(captured.image_bgr)
            yield accepted(number, azimuth_deg, captured, described)
            if number == 0:
                check(captured.image_bgr)
            yield from warn_of_table(bench, number, described)
            ranked, step = add_view(search, described, azimuth_deg, table.rest_deg)
            ended_ns = bench.clock.now_ns()
            if search.is_new_decision:
                yield ranked
            if isinstance(step, Finish):
                break
            # An arc: frames are evidence while the table rotates.
            goal_deg = min(max(table.rest_deg + sign * step.rotation_deg, low_deg), high_deg)
            if search.is_new_decision:
                yield decided(number, step, goal_deg, top)
            recorder = recorder or table.recorder()
            stream = stream or FrameStream(bench.camera, bench.clock)
            frame_check = FlightFrameCheck(config, captured.evidence.locks, True, bench.clock.now_ns(), stream.period_s)
            arc_frames = _ArcFrames(
                bench,
                table,
                search,
                stream,
                recorder,
                frame_check,
                describe,
                top,
                live,
                started_ns,
                number,
                rejected,
                ranked,
                step,
                goal_deg,
                left,
            )
            reach_deg = max(low_deg, table.rest_deg - 360.0), min(high_deg, table.rest_deg + 360.0)
            move = table.fly(goal_deg, Flight(arc_frames.each, reach_deg, recorder, speed.dps, quiet=False))
            yield from left
            left.clear()
            number, rejected, ranked, step = arc_frames.number, arc_frames.rejected, arc_frames.ranked, arc_frames.step
            travelled_deg += abs(move.rotation_deg)
            yield moved(number, move)
            if arc_frames.ended_ns is not None:
                ended_ns = arc_frames.ended_ns
                break
            number += 1
            still = table.hold()
            settled_ns = still.settled_ns
            yield moved(number, still)
        seconds = seconds_between(started_ns, ended_ns)
        try:
            yield from unwind(number, table)
        except RigError as error:
            failed = error  # report the answer first
    end = step if isinstance(step, Finish) else Finish(StopReason.MAX_VIEWS)
    return Found(ranked, end, travelled_deg, seconds, failed)


def decided(number: int, step: Rotate, target_deg: float, top: int) -> Decided:
    """Return the event of a decision to rotate."""
    return Decided(
        index=number,
        side="left" if step.rotation_deg >= 0 else "right",
        rotation_deg=step.rotation_deg,
        target_deg=target_deg,
        s_left=step.s_left,
        s_right=step.s_right,
        candidates=step.candidates[:top],
        reason=step.reason,
        note=step.note,
        weighed=step.weighed,
    )
