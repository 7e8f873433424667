"""Takes frames while the table rotates, and checks them as `rig.views.capture` does for frames at rest."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite, nan
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rig.bench import Bench
from rig.devices.camera import CameraLocks, Frame
from rig.motion.scan_speed import smear_px, time_sigma_ms
from rig.motion.trajectory import Trajectory
from rig.motion.turntable import Flight, Turntable
from rig.views.capture import Attempt, MotionEvidence, checked
from rig.views.stream import FrameStream, after_middle_row_ns, middle_ns

READINGS: Final = 8  # a third of a second: more average the noise, but the speed changes meanwhile
"""Readings of the encoder from which the angle of a frame is estimated during a flight."""
GRID_MS: Final = 1.5
"""Smallest tolerance for the distance of a stamp from the camera's regular rhythm."""
GRID_SIGMAS: Final = 5.0  # of a second of frames, none is so far off by chance
FEWEST_STAMPS: Final = 4  # fewer have no majority that shows the rhythm


@dataclass(eq=False)
class FlightFrames:
    """The frames of one flight, or of several flights with one trajectory; the table must have torque on.

    With ``newest`` those frames are dropped for which the program is too slow.
    """

    bench: Bench
    table: Turntable
    newest: bool = False
    _stamps_ns: list[int] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        self.recorder = self.table.recorder()
        self.stream = FrameStream(self.bench.camera, self.bench.clock)
        self._begun_ns = self.bench.clock.now_ns()

    def flight(
        self,
        take: Callable[[Frame], float | None],
        reach_deg: tuple[float, float],
        velocity_dps: float,
        *,
        quiet: bool = True,
    ) -> Flight:
        """Begin a flight for `Turntable.fly`, which calls ``take`` with each frame; it may return a new goal."""
        self._begun_ns = self.bench.clock.now_ns()
        self._stamps_ns.clear()

        def each() -> float | None:
            frame = self.stream.next(self.table.collect_gyro, newest=self.newest)
            if frame is None:
                return None
            self._stamps_ns.append(frame.exposed_ns)
            return take(frame)

        return Flight(each, reach_deg, self.recorder, velocity_dps, quiet)

    def about_deg(self, frame: Frame) -> float:
        """Return the approximate angle of a frame during a flight, from the last readings of the encoder."""
        time_ns = middle_ns(frame.exposed_ns, self.bench.config.camera_time)
        readings = self.recorder.readings[-READINGS:]
        if len(readings) < 2:
            return readings[-1][1] if readings else self.table.rest_deg
        times = np.array([(t - time_ns) * 1e-9 for t, _ in readings])
        angles = np.array([angle for _, angle in readings])
        if times[-1] >= 0:
            return float(np.interp(0.0, times, angles))
        rate = (angles[-1] - angles[-2]) / max(times[-1] - times[-2], 1e-3)
        return float(angles[-1] - rate * times[-1])

    def irregular_ns(self, last: int = 0) -> set[int]:
        """Return which time stamps of this flight, or of its ``last`` frames, cannot be trusted."""
        stamps_ns = np.array(self._stamps_ns[-last:], np.int64)
        off = irregular_stamps(stamps_ns.tolist(), self.stream.period_s, self.bench.config.camera_time.jitter_ms)
        return set(stamps_ns[off].tolist())

    def attempt(
        self,
        frame: Frame,
        trajectory: Trajectory,
        locks: CameraLocks,
        *,
        locks_hold: bool = True,
        stamps: int = 0,
    ) -> Attempt:
        """Return a frame of this flight as an attempt at a view: its evidence, and the reasons to reject it.

        ``locks`` are the camera's settings before the flight. The frame's time stamp is compared with the last
        ``stamps`` ones; 0 for all of this flight.
        """
        config = self.bench.config
        middle = middle_ns(frame.exposed_ns, config.camera_time)
        motion = trajectory.at([middle])
        # The uncertainty of the angle includes the distance that the platter moves in that of the frame's time.
        speed_dps = abs(float(motion.rate_dps[0]))
        time_deg = speed_dps * time_sigma_ms(config) * 1e-3
        return checked(
            1,
            frame,
            config.view,
            settled_ns=self._begun_ns,
            locks=locks,
            locks_hold=locks_hold,
            motion=MotionEvidence(
                middle,
                float(motion.angle_deg[0]),
                float(np.hypot(motion.sigma_deg[0], time_deg)),
                speed_dps,
                smear_px(config, speed_dps),
                trajectory.residual_deg,
            ),
            time_known=frame.stamped and frame.exposed_ns not in self.irregular_ns(stamps),
            angle_known=trajectory.consistent,
        )

    def at_the_object(
        self, attempt: Attempt, segmentation: Mapping[str, Any] | None, trajectory: Trajectory
    ) -> Attempt:
        """Return an attempt with the time and angle of the object's middle row, not the frame's (rolling shutter).

        ``segmentation`` is that of the attempt's image; without a box of the object nothing changes.
        """
        motion, box = attempt.evidence.motion, (segmentation or {}).get("box_px")
        if motion is None or box is None:
            return attempt
        middle_ns = motion.middle_ns + after_middle_row_ns(self.bench.config, box)
        angle_deg = float(trajectory.at([middle_ns]).angle_deg[0])
        motion = replace(motion, middle_ns=middle_ns, angle_deg=angle_deg)
        return replace(attempt, evidence=replace(attempt.evidence, motion=motion))


def irregular_stamps(stamps_ns: Sequence[int], period_s: float, jitter_ms: float) -> NDArray[np.bool_]:
    """Return which time stamps do not fit the camera's regular rhythm, bool (n,).

    Lost frames leave gaps of whole periods. The rhythm is that of most frames. Stamps that jumped, or that the computer
    set late, do not fit it. Fewer than `FEWEST_STAMPS` stamps are compared with the period alone.
    """
    if len(stamps_ns) < 2:
        return np.zeros(len(stamps_ns), np.bool_)
    times = (np.asarray(stamps_ns, np.int64) - stamps_ns[0]) * 1e-9
    limit_s = max(GRID_MS, GRID_SIGMAS * (jitter_ms if isfinite(jitter_ms) else 0.0)) * 1e-3
    steps = np.diff(times)
    whole = np.maximum(np.rint(steps / period_s), 1)
    if len(times) < FEWEST_STAMPS:
        off = np.abs(steps - whole * period_s) > limit_s
        return np.concatenate([[off.all()], off])
    # The camera's own period: it may differ by a thousandth from the nominal one.
    regular = np.abs(steps - whole * period_s) < 0.05 * period_s
    period_s = float(np.median(steps[regular] / whole[regular])) if regular.any() else period_s
    numbers = np.concatenate([[0.0], np.cumsum(whole)])
    phase = times - numbers * period_s
    off = np.abs(phase - _densest(phase, limit_s)) > limit_s
    return np.asarray(off, np.bool_)


def _densest(values: NDArray[np.float64], width: float) -> float:
    """Return the middle of the densest group of values within ``width``; nan if there are none."""
    if not len(values):
        return nan
    ordered = np.sort(values)
    ends = np.searchsorted(ordered, ordered + 2 * width, side="right")
    first = int((ends - np.arange(len(ordered))).argmax())
    return float(np.median(ordered[first : ends[first]]))
