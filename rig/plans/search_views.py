"""How a bench brings a search its views: each at rest, or in motion, where every frame on the way is evidence.

In motion, the first view is taken at rest. Then the table rotates along an arc; each frame is checked, described and
added to the belief. Each time the frames have covered another step of the circle, the search decides: it ends during
the rotation, continues, or gives the table another goal without a stop. If the table arrives first, the next view is
taken at rest.

Decision: docs/decisions/0047.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap360
from rig.bench import Bench
from rig.core.clock import seconds_between
from rig.devices.camera import CameraLocks, Frame
from rig.events.events import Event, FrameUsed, Moved, Rejected
from rig.motion.flight_views import FlightFrames
from rig.motion.move import Move
from rig.motion.scan_speed import scan_speed
from rig.motion.turntable import FIRST_REST_S, Turntable
from rig.plans.capture import accepted, announced, capture, moved, warn_of_table
from rig.search.session import Search
from rig.search.strategies import Finish, Rotate
from rig.views.capture import Viewer
from rig.views.description import SearchDescriber

FIRST_REST_IN_MOTION_S: Final = 0.15
"""Time over which the gyro is averaged before a search in motion; the fit of the trajectory corrects the bias later."""
STAMPS: Final = 30
"""Time stamps that are compared with each other: a second of frames."""
MOST_FLIGHTS: Final = 8
MOST_REJECTED: Final = 15
"""Number of successive rejected frames after which the table stops and the next view is taken at rest."""
NEW_GOAL_DEG: Final = 10.0


@dataclass(eq=False)
class ViewsAtRest:
    """The views of a search, each at rest.

    Attributes
    ----------
    check
        Gets the image of the first view, and raises an error if it shows no object.
    live
        Called with the event of each frame of a search in motion.
    number
        Counts the views from 0.
    is_over, ended_ns
        Whether the search has ended, and when its last view was decided.
    unseen
        The events of the present rotation that were not yielded yet.
    """

    bench: Bench
    search: Search
    viewer: Viewer
    describe: SearchDescriber
    check: Callable[[NDArray[np.uint8]], None]
    live: Callable[[FrameUsed], object]
    first_rest_s: float = FIRST_REST_S
    number: int = 0
    travelled_deg: float = 0.0
    is_over: bool = False
    started_ns: int = field(init=False)
    ended_ns: int = field(init=False)
    settled_ns: int = field(init=False)
    locks: CameraLocks = field(init=False)
    unseen: list[Event] = field(default_factory=list)
    _orientation_deg: float = field(init=False)

    def __post_init__(self) -> None:
        self.table = Turntable(self.bench, first_rest_s=self.first_rest_s)
        self.sign = self.bench.config.table.orientation_sign  # the camera moves opposite to the table
        self.started_ns = self.bench.clock.now_ns()

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
        """Add an acceptable frame at rest to the search; errors as for `rig.plans.capture.capture`."""
        captured = yield from capture(self.number, self.viewer, self.table, self.settled_ns)
        described, azimuth_deg = self.describe(captured.image_bgr), self.azimuth_deg
        self.locks = captured.evidence.locks
        yield accepted(self.number, azimuth_deg, captured, described)
        if self.number == 0:
            self.check(captured.image_bgr)
        yield from warn_of_table(self.bench, self.number, described)
        ranked, step = self.search.add(described, azimuth_deg, table_deg=self.table.rest_deg)
        self.ended_ns, self.is_over = self.bench.clock.now_ns(), isinstance(step, Finish)
        if self.search.is_new_decision:
            yield ranked

    def rotate(self, step: Rotate) -> Generator[Event, None, None]:
        """Rotate to the next view: within the cable budget, and use the measured rotation."""
        asked_deg = self.table.rest_deg + self.sign * step.rotation_deg
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

    Attributes
    ----------
    rejected, rejected_in_a_row
        Count the frames that were not used.
    goal_deg
        Where the table rotates to.
    """

    first_rest_s: float = FIRST_REST_IN_MOTION_S
    flights: int = 0
    rejected: int = 0
    rejected_in_a_row: int = 0
    goal_deg: float = 0.0

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
        described = self.describe(attempt.image_bgr)
        attempt = self.frames.at_the_object(attempt, described.segmentation, trajectory)
        motion = attempt.evidence.motion
        assert motion is not None
        azimuth_deg = float(wrap360(self.sign * motion.angle_deg))
        self.unseen.append(accepted(self.number, azimuth_deg, attempt, described))
        ranked, step = self.search.add(described, azimuth_deg, table_deg=motion.angle_deg)
        used = self.search.frame_used(self.number, azimuth_deg, self.seconds, self.rejected)
        self.live(used)
        self.unseen.append(used)
        # Follow a new decision: stop, or steer to another goal.
        if not self.search.is_new_decision:
            return None
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
