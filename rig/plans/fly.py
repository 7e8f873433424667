"""The part of an enrollment in which the views are taken while the table rotates: a fly scan.

The table rotates from rest to rest by one revolution. For each planned angle the plan holds the nearest frame in
memory. After the revolution, the trajectory of the platter gives each frame its angle, and each frame is checked like a
view at rest. Nothing is stored before that, so an interrupted revolution leaves no view.

Decision: docs/decisions/0047.
"""

from collections.abc import Generator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from math import inf

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap360
from rig.bench import Bench
from rig.catalog import Enrollment, ViewRecord
from rig.core.errors import LimitExceeded, RotationDisagreement
from rig.core.phrases import angle_words
from rig.events.events import Accepted, Event, Rejected, ScanStarted, plain
from rig.motion.flight_views import FlightFrameCheck
from rig.motion.move import Move
from rig.motion.scan_speed import require_camera_time, scan_speed
from rig.motion.trajectory import TrajectoryRecorder
from rig.motion.turntable import Flight, Turntable
from rig.plans.capture import announced, capture, check_object, moved, warn_of_table
from rig.views.capture import Attempt, Viewer
from rig.views.description import DescribedView, ViewDescriber
from rig.views.image_files import Encoder
from rig.views.stream import FrameStream, StreamFrame, middle_ns

NEAR_SHARE = 0.6
"""Largest distance of a frame from its planned angle, as a share of the step."""
READINGS = 8
"""Readings of the encoder from which the angle of a frame is estimated during the revolution."""


@dataclass
class Scan:
    """The frames of a revolution: the nearest one to each planned angle, and the time stamps of all."""

    bench: Bench
    table: Turntable
    stream: FrameStream
    recorder: TrajectoryRecorder
    angles_deg: Mapping[int, float]
    nearest: dict[int, tuple[float, StreamFrame]] = field(default_factory=dict)
    stamps_ns: list[int] = field(default_factory=list)

    def each(self) -> None:
        """Wait for the next frame, and hold it in memory if it is the nearest so far to a planned angle."""
        frame = self.stream.next(self.table.collect_gyro)
        if frame is None:
            return
        self.stamps_ns.append(frame.stamp_ns)
        about_deg = self._about_deg(middle_ns(frame.stamp_ns, self.bench.config.camera_time))
        for index, angle_deg in self.angles_deg.items():
            away_deg = abs(angle_deg - about_deg)
            if away_deg < self.nearest.get(index, (15.0, None))[0]:
                self.nearest[index] = away_deg, frame

    def _about_deg(self, time_ns: int) -> float:
        """Return the approximate angle at a time, from the last readings of the encoder."""
        readings = self.recorder.newest_readings(READINGS)
        if len(readings) < 2:
            return readings[-1][1] if readings else self.table.rest_deg
        times = np.array([(t - time_ns) * 1e-9 for t, _ in readings])
        angles = np.array([angle for _, angle in readings])
        if times[-1] >= 0:
            return float(np.interp(0.0, times, angles))
        rate = (angles[-1] - angles[-2]) / max(times[-1] - times[-2], 1e-3)
        return float(angles[-1] - rate * times[-1])


def start_of_revolution(bench: Bench, angles_deg: Mapping[int, float]) -> float | None:
    """Return the start of a revolution upwards that passes all angles; None if the cable budget does not allow one."""
    low_deg, high_deg = bench.config.table.limits_deg
    start_deg = min(min(angles_deg.values()), high_deg - 360.0)
    return start_deg if start_deg >= low_deg and max(angles_deg.values()) <= start_deg + 360.0 else None


def fly_views(
    bench: Bench,
    enrollment: Enrollment,
    table: Turntable,
    viewer: Viewer,
    angles_deg: Mapping[int, float],
    describe: ViewDescriber,
) -> Generator[Event, None, tuple[set[int], float, NDArray[np.uint8], NDArray[np.uint8]]]:
    """Take the views at these table angles in one revolution, and store those that pass their checks.

    Returns the indices of the stored views, the start angle, and the frames at rest before and after the revolution,
    which show the same side of the object.

    Raises
    ------
    UsageError
        The camera's time is not calibrated.
    LimitExceeded
        The cable budget does not allow a revolution.
    NoObject
        The table is empty.
    RotationDisagreement
        Encoder and gyro disagree: no view of the revolution is stored.
    """
    # Plan the revolution and its speed.
    config = bench.config
    require_camera_time(config)
    start_deg = start_of_revolution(bench, angles_deg)
    if start_deg is None:
        raise LimitExceeded(
            "A scan needs a revolution upwards. The cable budget does not allow that.",
            next_step="Increase table.limits_deg if the cable is long enough, or take the views at rest.",
            evidence={"limits_deg": list(config.table.limits_deg)},
        )
    end_deg = start_deg + 360.0
    ordered = sorted(angles_deg.values())
    spacing_deg = min(np.diff(ordered).tolist(), default=360.0)
    speed = scan_speed(
        config, fps=bench.camera.identity.fps, gyro_range_dps=bench.imu.range_dps, spacing_deg=spacing_deg
    )
    # Rotate, between two frames at rest of the same side.
    if abs(table.rest_deg - start_deg) > config.table.tolerance_deg:
        yield moved(0, (yield from announced(0, table, start_deg)))
    before = yield from capture(0, viewer, table, bench.clock.now_ns())
    check_object(bench, before.image_bgr, describe.empty_table)
    yield ScanStarted(speed.dps, speed.limit, speed.value, start_deg, end_deg)
    recorder = table.recorder()
    scan = Scan(bench, table, FrameStream(bench.camera, bench.clock), recorder, angles_deg)
    begun_ns = bench.clock.now_ns()
    move = table.fly(end_deg, Flight(scan.each, (start_deg, end_deg), recorder, speed.dps))
    yield moved(len(angles_deg), move)
    trajectory = recorder.fit()
    if trajectory is None or move.agreement is None or not (move.agreement.agrees and trajectory.consistent):
        raise _disagreement(bench, move, None if trajectory is None else trajectory.residual_deg)
    after = yield from capture(0, viewer, table, move.settled_ns)
    # Check the nearest frame to each angle, and store the accepted ones.
    frame_check = FlightFrameCheck(
        config,
        before.evidence.locks,
        before.evidence.locks_hold and after.evidence.locks_hold,
        begun_ns,
        scan.stream.period_s,
    )
    off = dict(zip(scan.stamps_ns, frame_check.irregular(scan.stamps_ns).tolist(), strict=True))
    stored: set[int] = set()
    encoder = Encoder()
    for index, angle_deg in angles_deg.items():
        _, frame = scan.nearest.pop(index, (inf, None))
        if frame is None:
            continue
        attempt = frame_check.attempt(frame, trajectory, irregular=off[frame.stamp_ns])
        assert attempt.evidence.motion is not None
        if abs(attempt.evidence.motion.angle_deg - angle_deg) > NEAR_SHARE * spacing_deg:
            continue  # the frames near this angle were lost
        if not attempt.accepted:
            yield Rejected(index, attempt.number, attempt.reasons, attempt.evidence)
            continue
        encoded = encoder.begin(attempt.image_bgr)
        described = describe(attempt.image_bgr)
        attempt = frame_check.at_the_object(attempt, described.segmentation, trajectory)
        yield from _store(bench, enrollment, index, angle_deg, attempt, described, encoded)
        stored.add(index)
    return stored, start_deg, before.image_bgr, after.image_bgr


def _store(
    bench: Bench,
    enrollment: Enrollment,
    index: int,
    angle_deg: float,
    attempt: Attempt,
    described: DescribedView,
    encoded: Future[bytes],
) -> Generator[Event, None, None]:
    motion = attempt.evidence.motion
    assert motion is not None
    record = ViewRecord(
        index=index,
        commanded_deg=angle_deg,
        encoder_deg=motion.angle_deg,
        azimuth_deg=float(wrap360(bench.config.table.orientation_sign * motion.angle_deg)),
        descriptors=described.levels,
        captured_ns=attempt.evidence.exposed_ns,
        evidence=plain(attempt.evidence),
        region=bench.config.view.roi,
        segmentation=described.segmentation,
    )
    enrollment.add(record, attempt.image_bgr, encoded, described.segmented)
    yield Accepted(index, record.azimuth_deg, attempt.evidence, attempt.image_bgr, described.segmentation)
    yield from warn_of_table(bench, index, described)


def park(table: Turntable, bench: Bench) -> Move:
    """Return to 0 to free the cable; the table need not be quiet there, because no view follows."""
    low_deg, high_deg = sorted((0.0, table.rest_deg))
    poll_s = bench.config.table.poll_s
    flight = Flight(
        lambda: bench.clock.sleep(poll_s),
        (low_deg, high_deg),
        table.recorder(),
        bench.config.table.velocity_dps,
        quiet=False,
    )
    return table.fly(0.0, flight)


def _disagreement(bench: Bench, move: Move, residual_deg: float | None) -> RotationDisagreement:
    servo, platter = (angle_words(angle_deg, 2) for angle_deg in (move.rotation_encoder_deg, move.gyro.angle_deg))
    what = f"The servo rotated {servo}, the platter {platter}"
    if residual_deg is not None:
        what += f", and on the way they differed by up to {residual_deg:.2f}°"
    error = RotationDisagreement(
        f"{what}. No view of this revolution is stored.",
        next_step="Tighten the platter.",
        afterwards="Enroll the object again with --replace. If the gyro lost samples, check the IMU's cable and "
        "continue with --resume.",
        evidence={
            "table_deg": round(move.encoder_deg, 2),
            "residual_deg": None if residual_deg is None else round(residual_deg, 3),
            "gyro": move.gyro.reason or "valid",
        },
    )
    if move.gyro.valid:
        bench.safety.latch(error)
    return error
