"""The plan that enrolls an object: one revolution, with a checked view at every step, or a fly scan without a stop.

Each view is stored before the table rotates to the next one. In a fly scan the table rotates from rest to rest by one
revolution. For each planned angle the plan holds the nearest frame in memory. After the revolution, the trajectory of
the platter gives each frame its angle, and each frame is checked like a view at rest. Nothing is stored before that, so
an interrupted revolution leaves no view. Views that fail or are missing are then taken at rest.

Decisions: docs/decisions/0002, docs/decisions/0019.
"""

from collections.abc import Collection, Generator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from math import inf
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap360
from hbr.model import symmetry
from hbr.model.views import Views
from rig.bench import Bench
from rig.catalog import Catalog, OpenEnrollment, Provenance, View
from rig.catalog.derived import camera_settings_of
from rig.catalog.retake import Retake
from rig.core.clock import seconds_between
from rig.core.errors import LimitExceeded, NoObject, ObjectMoved, ObjectNotFound, RigError, RotationDisagreement
from rig.core.json_form import plain
from rig.core.next_steps import Do
from rig.core.phrases import angle_words
from rig.devices.camera import Frame
from rig.events.events import Enrolled, Event, Rejected, ScanStarted, SimilarObjects, Started
from rig.motion.flight_views import FlightFrames
from rig.motion.move import Move
from rig.motion.scan_speed import require_camera_time, scan_speed, takes_in_motion
from rig.motion.turntable import Flight, Turntable
from rig.plans.estimate import even_azimuths, table_angles
from rig.plans.steps import ObjectCheck, accepted, announced, capture, check_camera, moved, warn_of_table
from rig.views.capture import Attempt, Viewer, image_similarity
from rig.views.description import DescribedView, ViewSegmenter
from rig.views.empty_table import empty_table_status
from rig.views.image_files import encode

SAME_SIMILARITY: Final = 0.97
"""Two images of an object at one angle are more similar; after a shift by a centimetre they are less similar."""
# more than half a step, because frames are lost; nearer to the next view, both would be nearly one
NEAR_SHARE: Final = 0.6
"""Largest distance of a frame from its planned angle, as a share of the step."""
SHOWN_SIMILAR: Final = 3
"""Similar objects that are named after an enrollment."""
HELD_DEG: Final = 15.0
"""Largest distance of a frame from its planned angle, as far as it is known during the revolution."""


@dataclass(frozen=True, eq=False)
class _SeenView:
    """An image at rest, with the index of its view and its table angle."""

    index: int
    angle_deg: float
    image_bgr: NDArray[np.uint8]


@dataclass(eq=False)
class EnrollmentViews:
    """Takes and stores the views of one session of an enrollment."""

    bench: Bench
    enrollment: OpenEnrollment | Retake
    empty_table: NDArray[np.uint8] | None
    """The sheet of empty-table images (`rig.views.table_sheet`)."""
    in_motion: bool = False
    first: _SeenView | None = None
    """The image that shows, taken again at the end, whether the object was moved: by default the first one."""
    retakes: int = field(default=0, init=False)
    """The number of images that were taken again."""

    def __post_init__(self) -> None:
        self.segment = ViewSegmenter(self.bench.config.view, empty_table=self.empty_table)
        self.viewer = Viewer(self.bench.camera, self.bench.config, encodes=not self.in_motion)
        self.table = Turntable(self.bench)
        self._check = ObjectCheck(self.bench, self.empty_table)

    def take(self, angles_deg: Mapping[int, float]) -> Generator[Event, None, None]:
        """Take and store the views at these table angles; check that the object was not moved; return to 0.

        Raises `LimitExceeded`: the cable budget does not allow a revolution. `NoObject`: the table is empty.
        `RotationDisagreement`: encoder and gyro disagree: no view is stored at an uncertain angle, and none of a
        revolution. `ObjectMoved`: the object was moved between any two views, so all views of this session are
        abandoned.
        """
        with self.table:
            left = dict(angles_deg)
            if self.in_motion:
                stored = yield from self._fly(angles_deg)
                left = {index: angle_deg for index, angle_deg in angles_deg.items() if index not in stored}
                self.retakes += len(left)
            if left:
                yield from self._at_rest(left)
            else:
                self._park()

    def _at_rest(self, angles_deg: Mapping[int, float]) -> Generator[Event, None, None]:
        """Take and store the views at these table angles at rest, check the first view again, and return to 0."""
        last = yield from self._step(angles_deg)
        # Return to the first view to check that the object was not moved, then to 0 to free the cable: without its
        # supply the servo loses the count of revolutions, and the next enrollment would wind up the cable further.
        first = self.first or last
        if first is not last:
            move = yield from announced(first.index, self.table, first.angle_deg)
            again = yield from capture(first.index, self.viewer, self.table, move.settled_ns)
            self._require_not_moved(first, again)
        if first is last or first.angle_deg != 0.0:
            yield from announced(last.index, self.table, 0.0)

    def _step(self, angles_deg: Mapping[int, float]) -> Generator[Event, None, _SeenView]:
        """Take and store the views at these table angles at rest; return the last one."""
        imu_deg, imu_sigma_deg = None, 0.0
        for index, angle_deg in angles_deg.items():
            move = yield from announced(index, self.table, angle_deg)
            yield moved(index, move)
            if move.agreement is None or not move.agreement.agrees:
                disagreement = _disagreement(move)
                if move.agreement is not None:
                    self.bench.safety.latch(disagreement)  # a platter that has slipped once will slip again
                raise disagreement
            # The angle by the gyro alone, from the first one of the encoder.
            if imu_deg is None:
                imu_deg = move.commanded_deg if move.by_gyro else move.encoder_deg
            else:
                imu_deg += move.gyro.angle_deg
                imu_sigma_deg += move.gyro.sigma_deg  # added linearly: all moves share the same bias and scale error
            table_deg = imu_deg if move.by_gyro else move.encoder_deg
            azimuth_deg = self._azimuth_deg(table_deg)
            attempt = yield from capture(index, self.viewer, self.table, move.settled_ns)
            self.retakes += attempt.number - 1
            self._require_object(attempt.image_bgr, azimuth_deg)
            segmented = self.segment(attempt.image_bgr, azimuth_deg)
            view = View(
                index=index,
                commanded_deg=move.commanded_deg,
                encoder_deg=move.encoder_deg,
                azimuth_deg=azimuth_deg,
                imu_deg=imu_deg,
                imu_sigma_deg=imu_sigma_deg,
            )
            yield from self._store(view, attempt, segmented)
            last = _SeenView(index, angle_deg, attempt.image_bgr)
            self.first = self.first or last
        return last

    def _fly(self, angles_deg: Mapping[int, float]) -> Generator[Event, None, set[int]]:
        """Take the views at these table angles in one revolution, store those that pass their checks; return them."""
        # Plan the revolution and its speed.
        config, table = self.bench.config, self.table
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
        speed = scan_speed(config, self.bench.imu.range_dps, spacing_deg, self.bench.camera.identity.fps)
        # Rotate, between two frames at rest of the same side.
        if abs(table.rest_deg - start_deg) > config.table.tolerance_deg:
            yield moved(0, (yield from announced(0, table, start_deg)))
        before = yield from capture(0, self.viewer, table, self.bench.clock.now_ns())
        self._require_object(before.image_bgr, self._azimuth_deg(start_deg))
        self.first = _SeenView(0, start_deg, before.image_bgr)
        yield ScanStarted(speed.dps, speed.limit, speed.value, start_deg, end_deg)
        frames = FlightFrames(self.bench, table)
        nearest: dict[int, tuple[float, Frame]] = {}

        def hold_nearest(frame: Frame) -> None:
            about_deg = frames.about_deg(frame)
            for index, angle_deg in angles_deg.items():
                away_deg = abs(angle_deg - about_deg)
                if away_deg < nearest.get(index, (HELD_DEG, None))[0]:
                    nearest[index] = away_deg, frame

        move = table.fly(end_deg, frames.flight(hold_nearest, (start_deg, end_deg), speed.dps))
        yield moved(len(angles_deg), move)
        trajectory = frames.recorder.fit()
        if trajectory is None or move.agreement is None or not (move.agreement.agrees and trajectory.consistent):
            disagreement = _disagreement(move, None if trajectory is None else trajectory.residual_deg)
            if move.gyro.valid:
                self.bench.safety.latch(disagreement)
            raise disagreement
        after = yield from capture(0, self.viewer, table, move.settled_ns)
        # Check the nearest frame to each angle, and store the accepted ones.
        locks, locks_hold = before.evidence.locks, before.evidence.locks_hold and after.evidence.locks_hold
        stored: set[int] = set()
        encoder = ThreadPoolExecutor(1, "encoder")
        for index, angle_deg in angles_deg.items():
            _, frame = nearest.pop(index, (inf, None))
            if frame is None:
                continue
            attempt = frames.attempt(frame, trajectory, locks, locks_hold=locks_hold)
            assert attempt.evidence.motion is not None
            if abs(attempt.evidence.motion.angle_deg - angle_deg) > NEAR_SHARE * spacing_deg:
                continue  # the frames near this angle were lost
            if not attempt.accepted:
                yield Rejected(index, attempt.number, attempt.reasons, attempt.evidence)
                continue
            azimuth_deg = self._azimuth_deg(attempt.evidence.motion.angle_deg)
            self._require_object(attempt.image_bgr, azimuth_deg)
            attempt = replace(attempt, encoded=encoder.submit(encode, attempt.image_bgr))
            segmented = self.segment(attempt.image_bgr, azimuth_deg)
            attempt = frames.at_the_object(attempt, segmented.segmentation, trajectory)
            assert attempt.evidence.motion is not None
            measured_deg = attempt.evidence.motion.angle_deg
            azimuth_deg = self._azimuth_deg(measured_deg)
            view = View(index=index, commanded_deg=angle_deg, encoder_deg=measured_deg, azimuth_deg=azimuth_deg)
            yield from self._store(view, attempt, segmented)
            stored.add(index)
        self._require_not_moved(self.first, after)
        return stored

    def _store(self, view: View, attempt: Attempt, segmented: DescribedView) -> Generator[Event, None, None]:
        """Store an accepted view, which has its angles."""
        view.captured_ns, view.evidence = attempt.evidence.exposed_ns, plain(attempt.evidence)
        view.region = self.bench.config.view.roi
        self.enrollment.add(view, attempt.image_bgr, attempt.encoded)
        yield accepted(view.index, view.azimuth_deg, attempt, segmented)
        yield from warn_of_table(self.bench, view.index, segmented)

    def _azimuth_deg(self, table_deg: float) -> float:
        return float(wrap360(self.bench.config.table.orientation_sign * table_deg))

    def _require_object(self, image_bgr: NDArray[np.uint8], azimuth_deg: float) -> None:
        """Check a view that is not stored yet; views of an empty table must not be continued."""
        try:
            self._check(image_bgr, azimuth_deg)
        except NoObject:
            if self.first is not None:
                self.enrollment.abandon()
            raise

    def _require_not_moved(self, first: _SeenView, again: Attempt) -> None:
        """Compare two frames of one angle; abandon the enrollment and raise `ObjectMoved` if the object moved."""
        same_size = first.image_bgr.shape == again.image_bgr.shape
        alike = image_similarity(first.image_bgr, again.image_bgr, self.bench.config.view) if same_size else 0.0
        if alike < SAME_SIMILARITY:
            self.enrollment.abandon()
            raise ObjectMoved(
                f"{self.enrollment.object_name} is not where it was for view {first.index + 1}: it fell, was pushed, "
                "or slid on the platter. The views of this session are abandoned.",
                next_step=(
                    "Put the object back on its mark, and fasten it.",
                    Do.ENROLL_AGAIN(name=self.enrollment.object_name),
                ),
                evidence={
                    "similarity": round(alike, 3),
                    "smallest_similarity": SAME_SIMILARITY,
                    "table_deg": first.angle_deg,
                },
            )

    def _park(self) -> None:
        """Return to 0 to free the cable; the table need not be quiet there, because no view follows."""
        table, config = self.table, self.bench.config.table
        reach_deg = min(0.0, table.rest_deg), max(0.0, table.rest_deg)
        pause = partial(self.bench.clock.sleep, config.poll_s)
        table.fly(0.0, Flight(pause, reach_deg, table.recorder(), config.velocity_dps, quiet=False))


def _disagreement(move: Move, residual_deg: float | None = None) -> RotationDisagreement:
    """Return the error that the platter did not follow the servo, or that this is not known.

    ``residual_deg`` is the largest difference on the way, of views in motion.
    """
    servo, platter = (angle_words(angle_deg, 2) for angle_deg in (move.rotation_encoder_deg, move.gyro.angle_deg))
    evidence: dict[str, float] = {"table_deg": round(move.encoder_deg, 2)}
    if move.agreement is None:
        return RotationDisagreement(
            f"It is not known whether the platter followed the servo's rotation of {servo}: {move.gyro.reason}.",
            next_step=("If nothing hit the table,", Do.CONTINUE_ENROLLMENT(), "Otherwise,", Do.ENROLL_AGAIN()),
            evidence=evidence,
        )
    evidence |= {
        "difference_deg": round(move.agreement.difference_deg, 3),
        "bound_deg": round(move.agreement.bound_deg, 3),
    }
    way = ""
    if residual_deg is not None:
        way = f" On the way they differed by up to {residual_deg:.2f}°."
        evidence["residual_deg"] = round(residual_deg, 3)
    return RotationDisagreement(
        f"The servo rotated {servo}, but the platter {platter}.{way}",
        next_step=(
            "Tighten the platter.",
            Do.ACKNOWLEDGE(),
            Do.ENROLL_AGAIN(),
            "Views from before and after a slip do not fit together.",
        ),
        evidence=evidence,
    )


def enroll(
    bench: Bench,
    catalog: Catalog,
    name: str,
    *,
    views: int | None = None,
    label: str | None = None,
    note: str | None = None,
    resume: bool = False,
    replace: bool = False,
    fly: bool | None = None,
) -> Generator[Event, None, Enrolled]:
    """Enroll the object ``name`` with views at even steps; yields events and returns the last of them.

    The table rotates upwards from 0, so that its backlash stays on one side. View k has the azimuth −k·360/views, or
    +k·360/views if the servo moves the camera around the object. If the cable budget does not allow that, the table
    starts further back; a table that covers less than a revolution takes the views within its limits. An interrupted
    enrollment keeps its views: ``resume`` takes the missing ones, provided that the object was not moved. Closing the
    generator switches the torque off.

    With ``fly`` the views are taken in one revolution without a stop (`rig.plans.enroll`). Views that fail or are
    missing are then taken at rest. The default is ``enroll.mode``; "auto" means at rest.

    Every view is segmented for its checks and its event, with the bench's empty-table image if there is one
    (`rig.plans.photograph_table`); the enrollment stores it. At the end all views are segmented and described together
    (`OpenEnrollment.finish`).

    Raises `ObjectExists`, `CatalogError`, `CatalogBusy`: see `Catalog.begin` and `Catalog.resume`.
    `CameraSettingsDiffer`: the camera has other settings than at the views to continue. `RotationDisagreement`: encoder
    and gyro differ by more than their uncertainty, or the gyro has no value: no view is stored at an uncertain angle.
    `NoObject`: the table is empty. If its image shows that, nothing is stored, otherwise the views of this session are
    abandoned (`rig.plans.steps.ObjectCheck`). `ObjectMoved`: the object is not where it was
    for the first view of this session: the enrollment is abandoned. `ViewRejected`, `LimitExceeded`, `MotionTimeout`,
    `DeviceFault`, `DeviceSilent`: see `rig.views.capture` and `rig.motion.turntable`; the views stored so far stay.
    """
    limits_deg, sign = bench.config.table.limits_deg, bench.config.table.orientation_sign
    in_motion = takes_in_motion(bench.config, fly)
    if in_motion:
        require_camera_time(bench.config)
    provenance, empty_table = _session(bench)
    # Begin or resume the enrollment in the catalog.
    if resume:
        begun = catalog.resumable(name)
        check_camera(bench, camera_settings_of(begun.enrollment.views if begun else ()))
        enrollment = catalog.resume(name, provenance=provenance, empty_table=empty_table)
    else:
        enrollment = catalog.begin(
            name,
            planned_azimuth_deg=even_azimuths(views or bench.config.enroll.views, limits_deg, sign),
            provenance=provenance,
            label=label,
            note=note,
            replace=replace,
            empty_table=empty_table,
        )
    views = len(enrollment.planned_azimuth_deg)
    angles_deg = table_angles(enrollment.planned_azimuth_deg, limits_deg, sign)
    missing = enrollment.missing()
    to_go = {index: angles_deg[index] for index in missing}
    yield Started(
        "enroll",
        enrollment.object_name,
        len(missing),
        dict(provenance.conditions),
        angles_deg=tuple(to_go.values()),
        in_motion=in_motion,
    )
    # Take and store the missing views.
    started_ns = bench.clock.now_ns()
    retakes = 0
    if missing:
        try:
            bench.place(enrollment.object_name)
            taking = EnrollmentViews(bench, enrollment, empty_table, in_motion)
            yield from taking.take(to_go)
            retakes = taking.retakes
        except BaseException:
            if not resume:
                with suppress(RigError):  # it has views to resume
                    enrollment.discard()  # a mistyped name, or a table that did not start, is not left in the catalog
            raise
    enrollment.finish()
    done = Enrolled(enrollment.object_name, views, retakes, seconds_between(started_ns, bench.clock.now_ns()))
    yield done
    return done


def retake(bench: Bench, catalog: Catalog, name: str, indices: Collection[int]) -> Generator[Event, None, Retake]:
    """Take views of an enrolled object again, at their angles; yields events and returns what was done.

    The object must stand as it stood for the other views: afterwards, the image of the view on the other side is
    taken again and compared with the stored one. Only then, all new views take the places of the present ones in a
    single transaction (`rig.catalog.retake`), so after any interruption the present ones are in use.

    Raises `ObjectNotFound`, `CatalogError`, `UsageError`: see `Retake.of`. `ObjectMoved`: the object does not stand as
    it stood, or that view is bad, too. The others are as for `enroll`, and nothing changes.
    """
    provenance, empty_table = _session(bench)
    taking = Retake.of(catalog, name, indices, provenance=provenance, empty_table=empty_table)
    check_camera(bench, camera_settings_of(taking.former.views))
    plan, table = taking.former.planned_azimuth_deg, bench.config.table
    angles_deg = table_angles(plan, table.limits_deg, table.orientation_sign)
    to_go = {index: angles_deg[index] for index in taking.indices}
    # A hand that was in a picture may be in those beside it, but not in that of the other side.
    opposite = (taking.indices[0] + len(plan) // 2) % len(plan)
    others = sorted(set(range(len(plan))) - set(taking.indices), key=lambda index: abs(index - opposite))
    known = taking.former.views[others[0]]
    seen = _SeenView(known.index, angles_deg[known.index], catalog.read_image(known.image))
    yield Started(
        "enroll", taking.object_name, len(to_go), dict(provenance.conditions), angles_deg=tuple(to_go.values())
    )
    bench.place(taking.object_name)
    try:
        yield from EnrollmentViews(bench, taking, empty_table, first=seen).take(to_go)
    except ObjectMoved as error:
        raise ObjectMoved(
            f"{taking.object_name} does not stand as it stood for view {known.index + 1}, or that view is bad, too. "
            "Its present views stay in use.",
            next_step=(
                "Put the object exactly as it stood, and take the view again. If you do not know how it stood,",
                Do.ENROLL_AGAIN(name=taking.object_name),
            ),
            evidence=error.evidence,
        ) from error
    taking.finish()
    return taking


def _session(bench: Bench) -> tuple[Provenance, NDArray[np.uint8] | None]:
    """Return what takes the views of a session, and the sheet of its empty-table images, if there is one."""
    status = empty_table_status(bench)
    conditions = {
        **bench.conditions,
        **bench.config.model_dump(mode="json", include={"table", "imu", "camera", "view"}),
        "findings": list(bench.findings),
        "empty_table": status.as_json(),
    }
    provenance = Provenance(bench=bench.name, devices=bench.devices(), conditions=conditions)
    return provenance, None if status.table is None else status.table.image_bgr


def similar_objects(views: Views, name: str) -> SimilarObjects:
    """Measure how similar an enrolled object is to itself from other sides, and to the other objects.

    Raises `ObjectNotFound`: the object has no views.
    """
    if name not in views.object_names:
        raise ObjectNotFound(
            f"{name!r} has no complete enrollment.",
            next_step=(Do.ENROLL(name=name), "Or", Do.CONTINUE_ENROLLMENT(name=name)),
        )
    number = views.object_names.index(name)
    own = symmetry.symmetry(views, number)
    return SimilarObjects(
        name=name,
        period_deg=own.period_deg if own else None,
        neighbour_similarity=own.neighbours if own else None,
        period_similarity=own.similarity if own else None,
        objects=symmetry.similar_objects(views, number, SHOWN_SIMILAR),
    )
