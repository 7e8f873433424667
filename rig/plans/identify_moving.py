"""The part of an identification in which the table rotates: every frame on the way is evidence.

The first view is taken at rest. Then the table rotates along an arc; each frame is checked, described and added to the
belief. Each time the frames have covered another step of the circle, the search decides: it ends during the rotation,
continues, or gives the table another goal without a stop. If the table arrives first, the next view is taken at rest.

Decision: docs/decisions/0047.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

from hbr.core.angles import wrap360
from rig.core.clock import seconds_between
from rig.core.errors import MotionStopped
from rig.devices.camera import CameraLocks
from rig.events.events import Event, FrameUsed, Rejected
from rig.motion.flight_views import FlightFrames
from rig.motion.move import Move
from rig.motion.scan_speed import scan_speed
from rig.motion.turntable import Turntable
from rig.plans.capture import accepted, moved
from rig.plans.search_steps import Searched, SearchSteps, unwound
from rig.search.strategies import Finish
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
class _ArcFrames:
    """The frames of a search on its arcs.

    ``number`` counts the views, and ``rejected`` the frames that were not used. ``events`` are those of the present arc
    that have not been yielded. ``ended_ns`` is when the search ended on it, ``goal_deg`` where the table rotates to.
    """

    steps: SearchSteps
    table: Turntable
    live: Callable[[FrameUsed], object]
    started_ns: int
    velocity_dps: float
    number: int = 0
    rejected: int = 0
    goal_deg: float = 0.0
    ended_ns: int | None = None
    rejected_in_a_row: int = 0
    events: list[Event] = field(default_factory=list)
    locks: CameraLocks = field(init=False)

    @cached_property
    def flight(self) -> FlightFrames:
        return FlightFrames(self.steps.bench, self.table, newest=True)

    def fly(self, goal_deg: float, locks: CameraLocks) -> Move:
        """Rotate along an arc; ``locks`` are the camera's settings of the view before it."""
        self.goal_deg, self.rejected_in_a_row, self.locks = goal_deg, 0, locks
        (low_deg, high_deg), here_deg = self.table.limits_deg, self.table.rest_deg
        reach_deg = max(low_deg, here_deg - 360.0), min(high_deg, here_deg + 360.0)
        return self.flight.fly(goal_deg, self.take, reach_deg, self.velocity_dps, quiet=False)

    def take(self, frame: StreamFrame) -> float | None:
        """Take a frame as evidence; return a new goal, or the stopping angle if the search has ended."""
        if self.ended_ns is not None or self.rejected_in_a_row >= MOST_REJECTED:
            return self.goal_deg
        # Check the frame.
        trajectory = self.flight.recorder.fit()
        if trajectory is None:
            return None
        irregular = frame.stamp_ns in self.flight.irregular_ns(STAMPS)
        attempt = self.flight.attempt(frame, trajectory, self.locks, locks_hold=True, irregular=irregular)
        if not attempt.accepted:
            self.rejected += 1
            self.rejected_in_a_row += 1
            self.events.append(Rejected(self.number + 1, 1, attempt.reasons, attempt.evidence))
            return self._stop() if self.rejected_in_a_row >= MOST_REJECTED else None
        # Describe it, and add it to the search.
        self.rejected_in_a_row = 0
        self.number += 1
        search, bench = self.steps.search, self.steps.bench
        described = self.steps.describe(attempt.image_bgr)
        attempt = self.flight.at_the_object(attempt, described.segmentation, trajectory)
        motion = attempt.evidence.motion
        assert motion is not None
        sign = bench.config.table.orientation_sign
        azimuth_deg = float(wrap360(sign * motion.angle_deg))
        self.events.append(accepted(self.number, azimuth_deg, attempt, described))
        ranked, step = search.add(described, azimuth_deg, table_deg=motion.angle_deg)
        seconds = seconds_between(self.started_ns, bench.clock.now_ns())
        used = search.frame_used(self.number, azimuth_deg, seconds, self.rejected)
        self.live(used)
        self.events.append(used)
        # Follow a new decision: stop, or steer to another goal.
        if not search.is_new_decision:
            return None
        self.events.append(ranked)
        if isinstance(step, Finish):
            self.ended_ns = bench.clock.now_ns()
            return self._stop()
        goal_deg = motion.angle_deg + sign * step.rotation_deg
        if abs(goal_deg - self.goal_deg) <= NEW_GOAL_DEG:
            return None
        self.goal_deg = goal_deg
        self.events.append(self.steps.decided(self.number, step, goal_deg))
        return goal_deg

    def _stop(self) -> float:
        self.goal_deg = self.flight.stopping_deg()
        return self.goal_deg


def search_in_motion(steps: SearchSteps, live: Callable[[FrameUsed], object]) -> Generator[Event, None, Searched]:
    """Search along arcs until the stopping rule ends the search; the frames of an arc become events at its end.

    ``live`` gets the event of each frame while the table still rotates. It must return at once, because it is called in
    the control loop. After a fault in an arc, the events of its frames come when the torque is off, because the
    consumer of events may pause. After a stop they do not come. Raises what `rig.plans.identify.identify` raises.
    """
    bench = steps.bench
    started_ns = bench.clock.now_ns()
    speed = scan_speed(bench.config, fps=bench.config.camera.fps, gyro_range_dps=bench.imu.range_dps, spacing_deg=None)
    frames = _ArcFrames(steps, Turntable(bench, first_rest_s=FIRST_REST_S), live, started_ns, speed.dps)
    try:
        return (yield from _search(frames))
    except MotionStopped:
        raise
    except Exception:
        yield from frames.events
        raise


def _search(frames: _ArcFrames) -> Generator[Event, None, Searched]:
    steps, bench, search = frames.steps, frames.steps.bench, frames.steps.search
    sign = bench.config.table.orientation_sign
    travelled_deg = 0.0
    with frames.table as table:
        low_deg, high_deg = table.limits_deg
        settled_ns = bench.clock.now_ns()
        for _ in range(MOST_FLIGHTS):
            # A view at rest: the first one, and after each arc that ended without an answer.
            azimuth_deg = float(wrap360(sign * table.rest_deg))
            captured = yield from steps.view(frames.number, table, settled_ns, azimuth_deg)
            ended_ns, step = steps.decided_ns, search.step
            if isinstance(step, Finish):
                break
            # An arc: frames are evidence while the table rotates.
            goal_deg = min(max(table.rest_deg + sign * step.rotation_deg, low_deg), high_deg)
            if search.is_new_decision:
                yield steps.decided(frames.number, step, goal_deg)
            move = frames.fly(goal_deg, captured.evidence.locks)
            yield from frames.events
            frames.events.clear()
            travelled_deg += abs(move.rotation_deg)
            yield moved(frames.number, move)
            if frames.ended_ns is not None:
                ended_ns = frames.ended_ns
                break
            frames.number += 1
            still = table.hold()
            settled_ns = still.settled_ns
            yield moved(frames.number, still)
        seconds = seconds_between(frames.started_ns, ended_ns)
        failed = yield from unwound(frames.number, table)
    return Searched(travelled_deg, seconds, failed)
