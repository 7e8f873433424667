"""The plan that enrolls an object: one revolution, with a checked view at every step.

Each view is stored before the table rotates to the next one.

Decision: docs/decisions/0002.
"""

from collections.abc import Generator, Mapping
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap360
from rig.bench import Bench
from rig.catalog import Catalog, Enrollment, Provenance, ViewRecord
from rig.catalog.descriptions import unfinished_camera_settings
from rig.core.clock import seconds_between
from rig.core.errors import ObjectMoved, RigError, RotationDisagreement
from rig.core.json_form import plain
from rig.core.phrases import angle_words
from rig.events.events import Accepted, Enrolled, Event, Started
from rig.motion.move import Move
from rig.motion.scan_speed import require_camera_time, takes_in_motion
from rig.motion.turntable import Turntable
from rig.plans.capture import announced, capture, check_camera, check_object, moved, warn_of_table
from rig.plans.estimate import even_azimuths, table_angles
from rig.plans.fly import fly_views, park
from rig.views.capture import Viewer, image_similarity
from rig.views.description import DESCRIPTORS, ViewDescriber
from rig.views.empty_table import empty_table_status

SAME_SIMILARITY = 0.97
"""Two images of an object at one angle are more similar; after a shift by a centimetre they are less similar."""


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

    With ``fly`` the views are taken in one revolution without a stop (`rig.plans.fly`). Views that fail or are missing
    are then taken at rest. The default is ``enroll.mode``; "auto" means at rest.

    Every view is described by `rig.views.description.DESCRIPTORS`. Segmentation uses the bench's empty-table image, if
    there is one (`rig.plans.photograph_table`); the enrollment stores it. At the end all views are segmented again,
    together (`Enrollment.revise`).

    Raises
    ------
    ObjectExists, CatalogError, CatalogBusy
        See `Catalog.begin` and `Catalog.resume`.
    CameraSettingsDiffer
        The camera has other settings than at the views to continue.
    RotationDisagreement
        Encoder and gyro differ by more than their uncertainty, or the gyro has no value: no view is stored at an
        uncertain angle.
    NoObject
        The first view shows the empty table: nothing is stored.
    ObjectMoved
        The object is not where it was for the first view of this session: the enrollment is abandoned.
    ViewRejected, LimitExceeded, MotionTimeout, DeviceFault, DeviceSilent
        See `rig.views.capture` and `rig.motion.turntable`; the views stored so far stay.
    """
    limits_deg, sign = bench.config.table.limits_deg, bench.config.table.orientation_sign
    in_motion = takes_in_motion(bench.config, fly)
    if in_motion:
        require_camera_time(bench.config)
    status = empty_table_status(bench)
    provenance = Provenance(
        bench=bench.name,
        devices=bench.devices(),
        conditions={
            **bench.conditions,
            **bench.config.model_dump(mode="json", include={"table", "imu", "camera", "view"}),
            "findings": list(bench.findings),
            "empty_table": status.as_json(),
        },
    )
    # Begin or resume the enrollment in the catalog.
    if resume:
        check_camera(bench, unfinished_camera_settings(catalog, name))
        enrollment = catalog.resume(name, provenance=provenance)
    else:
        enrollment = catalog.begin(
            name,
            planned_azimuth_deg=even_azimuths(views or bench.config.enroll.views, limits_deg, sign),
            provenance=provenance,
            label=label,
            note=note,
            replace=replace,
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
            bench.operator.place(enrollment.object_name)
            empty_table = None if status.table is None else status.table.image_bgr
            if empty_table is not None:
                enrollment.store_empty_table(empty_table)
            describe = ViewDescriber(bench.config.view, DESCRIPTORS, empty_table)
            if in_motion:
                retakes = yield from _fly_and_complete(bench, enrollment, to_go, describe)
            else:
                retakes = yield from _take_views(bench, enrollment, to_go, describe)
        except BaseException:
            if not resume:
                with suppress(RigError):  # it has views to resume
                    enrollment.discard()  # a mistyped name, or a table that did not start, is not left in the catalog
            raise
    # Segment all views together, then let searches use them.
    enrollment.revise()
    enrollment.finish()
    done = Enrolled(enrollment.object_name, views, retakes, seconds_between(started_ns, bench.clock.now_ns()))
    yield done
    return done


def _take_views(
    bench: Bench, enrollment: Enrollment, angles_deg: Mapping[int, float], describe: ViewDescriber
) -> Generator[Event, None, int]:
    """Take and store the views at these table angles, return to 0, and return the number of repeated images."""
    viewer = Viewer(bench.camera, bench.config, encodes=True)
    with Turntable(bench) as table:
        retakes, first, index = yield from _step_views(bench, enrollment, table, viewer, angles_deg, describe)
        # Return to the first view to check that the object was not moved, then to 0 to free the cable: without its
        # supply the servo loses the count of revolutions, and the next enrollment would wind up the cable further.
        if first and first[0] != index:
            yield from _check_not_moved(bench, enrollment, table, viewer, *first)
        if first is None or first[0] == index or first[1] != 0.0:
            yield from announced(index, table, 0.0)
    return retakes


def _fly_and_complete(
    bench: Bench, enrollment: Enrollment, angles_deg: Mapping[int, float], describe: ViewDescriber
) -> Generator[Event, None, int]:
    """Take and store views in one revolution, the others at rest, go to 0; return the number of repeated images."""
    viewer = Viewer(bench.camera, bench.config)
    retakes = 0
    with Turntable(bench) as table:
        stored, start_deg, before, after = yield from fly_views(bench, enrollment, table, viewer, angles_deg, describe)
        require_not_moved(bench, enrollment, 0, start_deg, before, after)
        left = {index: angle for index, angle in angles_deg.items() if index not in stored}
        if left:
            retakes, _, index = yield from _step_views(bench, enrollment, table, viewer, left, describe)
            yield from _check_not_moved(bench, enrollment, table, viewer, 0, start_deg, before)
            if start_deg != 0.0:
                yield from announced(index, table, 0.0)
        else:
            park(table, bench)
    return len(left) + retakes


def _step_views(
    bench: Bench,
    enrollment: Enrollment,
    table: Turntable,
    viewer: Viewer,
    angles_deg: Mapping[int, float],
    describe: ViewDescriber,
) -> Generator[Event, None, tuple[int, tuple[int, float, NDArray[np.uint8]] | None, int]]:
    """Take and store the views at these table angles at rest.

    Returns the number of repeated images, index, angle and image of the first view, and the index of the last one.
    """
    sign = bench.config.table.orientation_sign
    retakes = 0
    imu = _ImuAngle()
    first: tuple[int, float, NDArray[np.uint8]] | None = None
    for index, angle_deg in angles_deg.items():
        move = yield from announced(index, table, angle_deg)
        yield moved(index, move)
        if move.agreement is None or not move.agreement.agrees:
            disagreement = _disagreement(move)
            if move.agreement is not None:
                bench.safety.latch(disagreement)  # a platter that has slipped once will slip again
            raise disagreement
        imu.add(move)
        attempt = yield from capture(index, viewer, table, move.settled_ns)
        retakes += attempt.number - 1
        if first is None:
            check_object(bench, attempt.image_bgr, describe.empty_table)
        described = describe(attempt.image_bgr)
        record = ViewRecord(
            index=index,
            commanded_deg=move.commanded_deg,
            encoder_deg=move.encoder_deg,
            azimuth_deg=float(wrap360(sign * (imu.angle_deg if move.by_gyro else move.encoder_deg))),
            descriptors=described.levels,
            captured_ns=attempt.evidence.exposed_ns,
            imu_deg=imu.angle_deg,
            imu_sigma_deg=imu.sigma_deg,
            evidence=plain(attempt.evidence),
            region=bench.config.view.roi,
            segmentation=described.segmentation,
        )
        enrollment.add(record, attempt.image_bgr, attempt.encoded, described.segmented)
        yield Accepted(index, record.azimuth_deg, attempt.evidence, attempt.image_bgr, described.segmentation)
        yield from warn_of_table(bench, index, described)
        first = first or (index, angle_deg, attempt.image_bgr)
    return retakes, first, index


def _check_not_moved(
    bench: Bench,
    enrollment: Enrollment,
    table: Turntable,
    viewer: Viewer,
    index: int,
    angle_deg: float,
    image_bgr: NDArray[np.uint8],
) -> Generator[Event, None, None]:
    """Return to the angle of view ``index`` and check that the object is still where it was.

    Raises
    ------
    ObjectMoved
        It was moved between any two views, so all views of this session are abandoned.
    """
    move = yield from announced(index, table, angle_deg)
    again = yield from capture(index, viewer, table, move.settled_ns)
    require_not_moved(bench, enrollment, index, angle_deg, image_bgr, again.image_bgr)


def require_not_moved(
    bench: Bench,
    enrollment: Enrollment,
    index: int,
    angle_deg: float,
    image_bgr: NDArray[np.uint8],
    again_bgr: NDArray[np.uint8],
) -> None:
    """Compare two frames of view ``index``; abandon the enrollment and raise `ObjectMoved` if the object moved."""
    alike = image_similarity(image_bgr, again_bgr, bench.config.view)
    if alike < SAME_SIMILARITY:
        enrollment.abandon()
        raise ObjectMoved(
            f"{enrollment.object_name} is not where it was for view {index + 1}: it fell, was pushed, or slid on the "
            "platter. The views of this session are abandoned.",
            next_step="Put the object back on its mark, fasten it, and enroll it again with --replace.",
            evidence={"similarity": round(alike, 3), "smallest_similarity": SAME_SIMILARITY, "table_deg": angle_deg},
        )


class _ImuAngle:
    """The table angle by the gyro alone, from the first angle of the encoder."""

    def __init__(self) -> None:
        self.angle_deg = 0.0
        self.sigma_deg = 0.0
        self._begun = False

    def add(self, move: Move) -> None:
        if self._begun:
            self.angle_deg += move.gyro.angle_deg
            self.sigma_deg += move.gyro.sigma_deg  # added linearly: all moves share the same bias and scale error
        else:
            self._begun = True
            self.angle_deg = move.commanded_deg if move.by_gyro else move.encoder_deg


def _disagreement(move: Move) -> RotationDisagreement:
    if move.agreement is None:
        return RotationDisagreement(
            "It is not known whether the platter followed the servo's rotation of "
            f"{angle_words(move.rotation_encoder_deg, 2)}: {move.gyro.reason}.",
            next_step="If nothing hit the table, continue with --resume. Otherwise enroll the object again with "
            "--replace.",
            evidence={"table_deg": round(move.encoder_deg, 2)},
        )
    return RotationDisagreement(
        f"The servo rotated {angle_words(move.rotation_encoder_deg, 2)}, but the platter "
        f"{angle_words(move.gyro.angle_deg, 2)}.",
        next_step="Tighten the platter.",
        afterwards="Enroll the object again with --replace: views from before and after a slip do not fit together.",
        evidence={
            "difference_deg": round(move.agreement.difference_deg, 3),
            "bound_deg": round(move.agreement.bound_deg, 3),
            "table_deg": round(move.encoder_deg, 2),
        },
    )
