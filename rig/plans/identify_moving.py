"""The part of an identification in which the table rotates: every frame on the way is evidence.

The first view is taken at rest. Then the table rotates along an arc; each frame is checked, described and added to the
belief. Each time the frames have covered another step of the circle, the search decides: it ends during the rotation,
continues, or gives the table another goal without a stop. If the table arrives first, the next view is taken at rest.

Decision: docs/decisions/0047.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr import StopReason
from hbr.core.angles import wrap360
from rig.bench import Bench
from rig.core.clock import seconds_between
from rig.core.errors import MotionStopped, RigError
from rig.devices.camera import CameraLocks
from rig.events.events import Decided, Event, FrameUsed, Ranked, Rejected
from rig.motion.flight_views import FlightFrames
from rig.motion.scan_speed import scan_speed
from rig.motion.turntable import Turntable
from rig.plans.capture import accepted, add_view, capture, moved, unwind, warn_of_table
from rig.search.session import ArcSearch
from rig.search.strategies import Finish, Rotate
from rig.views.capture import Viewer
from rig.views.description import ViewDescriber
from rig.views.stream import StreamFrame

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
class _Arcs:
    """The state of a search along arcs, and what it does with each frame of an arc."""

    bench: Bench
    search: ArcSearch
    describe: ViewDescriber
    top: int
    started_ns: int
    live: Callable[[FrameUsed], object]
    events: list[Event] = field(default_factory=list)
    """Events of the present arc, which have not been yielded."""
    number: int = 0
    rejected: int = 0
    rejected_in_a_row: int = 0
    ended_ns: int | None = None
    goal_deg: float = 0.0
    locks: CameraLocks = field(init=False)
    ranked: Ranked = field(init=False)
    step: Rotate | Finish = field(init=False)

    def take(self, frames: FlightFrames, frame: StreamFrame) -> float | None:
        """Take a frame as evidence; return a new goal, or the stopping angle if the search has ended."""
        if self.ended_ns is not None or self.rejected_in_a_row >= MOST_REJECTED:
            return self.goal_deg
        # Check the frame.
        trajectory = frames.recorder.fit()
        if trajectory is None:
            return None
        irregular = frame.stamp_ns in frames.irregular_ns(STAMPS)
        attempt = frames.attempt(frame, trajectory, self.locks, locks_hold=True, irregular=irregular)
        if not attempt.accepted:
            self.rejected += 1
            self.rejected_in_a_row += 1
            self.events.append(Rejected(self.number + 1, 1, attempt.reasons, attempt.evidence))
            return self._stop(frames) if self.rejected_in_a_row >= MOST_REJECTED else None
        # Describe it, and add it to the search.
        self.rejected_in_a_row = 0
        self.number += 1
        described = self.describe(attempt.image_bgr)
        attempt = frames.at_the_object(attempt, described.segmentation, trajectory)
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
            return self._stop(frames)
        goal_deg = motion.angle_deg + sign * self.step.rotation_deg
        if abs(goal_deg - self.goal_deg) <= NEW_GOAL_DEG:
            return None
        self.goal_deg = goal_deg
        self.events.append(decided(self.number, self.step, goal_deg, self.top))
        return goal_deg

    def _stop(self, frames: FlightFrames) -> float:
        self.goal_deg = frames.stopping_deg()
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
    arcs = _Arcs(bench, search, describe, top, started_ns, live)
    try:
        return (yield from _search(arcs, viewer, check))
    except MotionStopped:
        raise
    except Exception:
        yield from arcs.events
        raise


def _search(arcs: _Arcs, viewer: Viewer, check: Callable[[NDArray[np.uint8]], None]) -> Generator[Event, None, Found]:
    bench, search = arcs.bench, arcs.search
    config = bench.config
    sign = config.table.orientation_sign
    speed = scan_speed(config, fps=config.camera.fps, gyro_range_dps=bench.imu.range_dps, spacing_deg=None)
    travelled_deg = 0.0
    failed: RigError | None = None
    with Turntable(bench, first_rest_s=FIRST_REST_S) as table:
        low_deg, high_deg = table.limits_deg
        frames: FlightFrames | None = None
        settled_ns = bench.clock.now_ns()
        for _ in range(MOST_FLIGHTS):
            # A view at rest: the first one, and after each arc that ended without an answer.
            captured = yield from capture(arcs.number, viewer, table, settled_ns)
            azimuth_deg = float(wrap360(sign * table.rest_deg))
            described = arcs.describe(captured.image_bgr)
            yield accepted(arcs.number, azimuth_deg, captured, described)
            if arcs.number == 0:
                check(captured.image_bgr)
            yield from warn_of_table(bench, arcs.number, described)
            arcs.ranked, arcs.step = add_view(search, described, azimuth_deg, table.rest_deg)
            ended_ns = bench.clock.now_ns()
            if search.is_new_decision:
                yield arcs.ranked
            if isinstance(arcs.step, Finish):
                break
            # An arc: frames are evidence while the table rotates.
            arcs.goal_deg = min(max(table.rest_deg + sign * arcs.step.rotation_deg, low_deg), high_deg)
            if search.is_new_decision:
                yield decided(arcs.number, arcs.step, arcs.goal_deg, arcs.top)
            frames = frames or FlightFrames(bench, table, newest=True)
            arcs.locks, arcs.rejected_in_a_row = captured.evidence.locks, 0
            reach_deg = max(low_deg, table.rest_deg - 360.0), min(high_deg, table.rest_deg + 360.0)
            move = frames.fly(arcs.goal_deg, partial(arcs.take, frames), reach_deg, speed.dps, quiet=False)
            yield from arcs.events
            arcs.events.clear()
            travelled_deg += abs(move.rotation_deg)
            yield moved(arcs.number, move)
            if arcs.ended_ns is not None:
                ended_ns = arcs.ended_ns
                break
            arcs.number += 1
            still = table.hold()
            settled_ns = still.settled_ns
            yield moved(arcs.number, still)
        seconds = seconds_between(arcs.started_ns, ended_ns)
        try:
            yield from unwind(arcs.number, table)
        except RigError as error:
            failed = error  # report the answer first
    end = arcs.step if isinstance(arcs.step, Finish) else Finish(StopReason.MAX_VIEWS)
    return Found(arcs.ranked, end, travelled_deg, seconds, failed)


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
