"""The part of an enrollment in which the views are taken while the table rotates: a fly scan.

The table rotates from rest to rest by one revolution. For each planned angle the plan holds the nearest frame in
memory. After the revolution, the trajectory of the platter gives each frame its angle, and each frame is checked like a
view at rest. Nothing is stored before that, so an interrupted revolution leaves no view.

Decision: docs/decisions/0047.
"""

from collections.abc import Generator, Mapping
from concurrent.futures import Future
from functools import partial
from math import inf

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap360
from rig.bench import Bench
from rig.catalog import Enrollment, ViewRecord
from rig.core.errors import LimitExceeded, RotationDisagreement
from rig.core.json_form import plain
from rig.core.phrases import angle_words
from rig.events.events import Accepted, Event, Rejected, ScanStarted
from rig.motion.flight_views import FlightFrames
from rig.motion.move import Move
from rig.motion.scan_speed import scan_speed
from rig.motion.turntable import Flight, Turntable
from rig.plans.capture import announced, capture, check_object, moved, warn_of_table
from rig.views.capture import Attempt, Viewer
from rig.views.description import DescribedView, ViewDescriber
from rig.views.image_files import Encoder
from rig.views.stream import StreamFrame

NEAR_SHARE = 0.6
"""Largest distance of a frame from its planned angle, as a share of the step."""
HELD_DEG = 15.0
"""Largest distance of a frame from its planned angle, as far as it is known during the revolution."""


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
    LimitExceeded
        The cable budget does not allow a revolution.
    NoObject
        The table is empty.
    RotationDisagreement
        Encoder and gyro disagree: no view of the revolution is stored.
    """
    # Plan the revolution and its speed.
    config = bench.config
    low_deg, high_deg = config.table.limits_deg
    ordered = sorted(angles_deg.values())
    start_deg = min(ordered[0], high_deg - 360.0)
    if start_deg < low_deg or ordered[-1] > start_deg + 360.0:
        raise LimitExceeded(
            "A scan needs a revolution upwards. The cable budget does not allow that.",
            next_step="Increase table.limits_deg if the cable is long enough, or take the views at rest.",
            evidence={"limits_deg": list(config.table.limits_deg)},
        )
    end_deg = start_deg + 360.0
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
    frames = FlightFrames(bench, table)
    nearest: dict[int, tuple[float, StreamFrame]] = {}

    def hold_nearest(frame: StreamFrame) -> None:
        about_deg = frames.about_deg(frame)
        for index, angle_deg in angles_deg.items():
            away_deg = abs(angle_deg - about_deg)
            if away_deg < nearest.get(index, (HELD_DEG, None))[0]:
                nearest[index] = away_deg, frame

    move = frames.fly(end_deg, hold_nearest, (start_deg, end_deg), speed.dps)
    yield moved(len(angles_deg), move)
    trajectory = frames.recorder.fit()
    if trajectory is None or move.agreement is None or not (move.agreement.agrees and trajectory.consistent):
        raise _disagreement(bench, move, None if trajectory is None else trajectory.residual_deg)
    after = yield from capture(0, viewer, table, move.settled_ns)
    # Check the nearest frame to each angle, and store the accepted ones.
    locks, locks_hold = before.evidence.locks, before.evidence.locks_hold and after.evidence.locks_hold
    irregular_ns = frames.irregular_ns()
    stored: set[int] = set()
    encoder = Encoder()
    for index, angle_deg in angles_deg.items():
        _, frame = nearest.pop(index, (inf, None))
        if frame is None:
            continue
        irregular = frame.stamp_ns in irregular_ns
        attempt = frames.attempt(frame, trajectory, locks, locks_hold=locks_hold, irregular=irregular)
        assert attempt.evidence.motion is not None
        if abs(attempt.evidence.motion.angle_deg - angle_deg) > NEAR_SHARE * spacing_deg:
            continue  # the frames near this angle were lost
        if not attempt.accepted:
            yield Rejected(index, attempt.number, attempt.reasons, attempt.evidence)
            continue
        encoded = encoder.begin(attempt.image_bgr)
        described = describe(attempt.image_bgr)
        attempt = frames.at_the_object(attempt, described.segmentation, trajectory)
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
    config = bench.config.table
    reach_deg = min(0.0, table.rest_deg), max(0.0, table.rest_deg)
    pause = partial(bench.clock.sleep, config.poll_s)
    return table.fly(0.0, Flight(pause, reach_deg, table.recorder(), config.velocity_dps, quiet=False))


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
