"""The plan that enrolls an object: one turn, a checked view at every step, each durable before the table turns on."""

from collections.abc import Generator, Mapping

import numpy as np
from numpy.typing import NDArray

from hbr.core.angles import wrap360
from rig.bench import Bench
from rig.catalog import Catalog, Enrollment, Provenance, ViewRecord
from rig.core.clock import seconds_between
from rig.core.errors import ObjectMoved, RigError, RotationDisagreement
from rig.events.events import Accepted, Enrolled, Event, Started, Warned, plain
from rig.motion.turntable import Move, Turntable
from rig.plans.capture import announced, capture, moved
from rig.plans.estimate import even_azimuths, table_angles
from rig.views.capture import Viewer, image_similarity
from rig.views.description import DESCRIPTORS, PAPER_DESCRIPTOR, ViewDescriber
from rig.views.empty_table import COMMAND, Drift, EmptyTables

SAME_SIMILARITY = 0.97
"""Two frames of an object at one angle are more alike; one that was shifted by a centimetre, or taken away, is less."""


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
) -> Generator[Event, None, Enrolled]:
    """Enroll the object ``name`` with views at even steps; yields events and returns the last of them.

    The table turns upwards from 0, so that its play is taken up; view k has the azimuth −k·360/views (+ where the servo
    takes the camera around the object). Where the cable does not reach for that, it begins further back; a servo that
    pans over less than a turn takes the views that it reaches. An interrupted enrollment keeps its views: ``resume``
    takes the missing ones, of an object that nobody has moved since. Closing the generator takes the torque off.

    Every view is described by `rig.views.description.DESCRIPTORS`. Segmentation uses the bench's empty-table image, if
    there is one (`rig.plans.photograph_table`); the enrollment stores it.

    Raises
    ------
    ObjectExists, CatalogError, CatalogBusy
        See `Catalog.begin` and `Catalog.resume`.
    RotationDisagreement
        Encoder and gyro differ by more than their uncertainty, or the gyro lost the rotation: no view is stored at an
        angle in doubt.
    ObjectMoved
        The object does not stand as it stood for the first view of this sitting: the enrollment is abandoned.
    ViewRejected, LimitExceeded, MotionTimeout, DeviceFault, DeviceSilent
        See `rig.views.capture` and `rig.motion.turntable`; views stored so far stay.
    """
    limits_deg, sign = bench.config.table.limits_deg, bench.config.table.orientation_sign
    standing = EmptyTables.standing(bench)
    provenance = Provenance(
        bench=bench.name,
        devices=bench.devices(),
        conditions={
            **bench.conditions,
            **bench.config.model_dump(mode="json", include={"table", "imu", "camera", "view"}),
            "findings": list(bench.findings),
            "empty_table": standing.words,
        },
    )
    if resume:
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
        "enroll", enrollment.object_name, len(missing), dict(provenance.conditions), angles_deg=tuple(to_go.values())
    )
    started_ns = bench.clock.now_ns()
    retakes = 0
    if missing:
        try:
            bench.operator.place(enrollment.object_name)
        except RigError:
            if not resume:
                enrollment.discard()  # a mistyped name leaves nothing behind
            raise
        empty_table = None if standing.table is None else standing.table.image_bgr
        if empty_table is not None:
            enrollment.set_reference_image(empty_table)
        retakes = yield from _take_views(
            bench, enrollment, to_go, ViewDescriber(bench.config.view, DESCRIPTORS, empty_table)
        )
    enrollment.finish()
    done = Enrolled(enrollment.object_name, views, retakes, seconds_between(started_ns, bench.clock.now_ns()))
    yield done
    return done


def _take_views(
    bench: Bench, enrollment: Enrollment, angles_deg: Mapping[int, float], describe: ViewDescriber
) -> Generator[Event, None, int]:
    """Take and store the views at these table angles, turn back to 0, and return how many frames were taken again."""
    viewer = Viewer(bench.camera, bench.config.view)
    drift = Drift()
    sign = bench.config.table.orientation_sign
    retakes = 0
    imu = _ImuAngle()
    first: tuple[int, float, NDArray[np.uint8]] | None = None
    with Turntable(bench) as table:
        for index, angle_deg in angles_deg.items():
            move = yield from announced(index, table, angle_deg)
            yield moved(index, move)
            if move.agreement is None or not move.agreement.agrees:
                disagreement = _disagreement(move)
                if move.agreement is not None:
                    bench.safety.latch(disagreement)  # a platter that slips once slips again
                raise disagreement
            imu.add(move)
            shot = yield from capture(index, viewer, table, move.settled_ns)
            retakes += shot.number - 1
            described = describe(shot.image_bgr)
            levels = dict(described.levels)
            record = ViewRecord(
                index=index,
                commanded_deg=move.commanded_deg,
                encoder_deg=move.encoder_deg,
                azimuth_deg=float(wrap360(sign * (imu.angle_deg if move.by_gyro else move.encoder_deg))),
                descriptor=levels.pop(PAPER_DESCRIPTOR),
                captured_ns=shot.evidence.exposed_ns,
                imu_deg=imu.angle_deg,
                imu_sigma_deg=imu.sigma_deg,
                evidence=plain(shot.evidence),
                region=bench.config.view.roi,
                segmentation=described.segmentation,
                further=levels,
            )
            enrollment.add(record, shot.image_bgr)
            yield Accepted(index, record.azimuth_deg, shot.evidence, shot.image_bgr, described.segmentation)
            if drifted := drift.look(described.segmentation):
                EmptyTables.doubt(bench, drifted)
                yield Warned(index, drifted, f"Go on, these views do without it; then take a new one: {COMMAND}")
            first = first or (index, angle_deg, shot.image_bgr)
        if first and first[0] != index:
            yield from _look_again(bench, enrollment, table, viewer, *first)
        # The servo forgets whole turns without its supply; a cable left wound up would be wound further the next time.
        if first is None or first[0] == index or first[1] != 0.0:
            yield from announced(index, table, 0.0)
    return retakes


def _look_again(
    bench: Bench,
    enrollment: Enrollment,
    table: Turntable,
    viewer: Viewer,
    index: int,
    angle_deg: float,
    image_bgr: NDArray[np.uint8],
) -> Generator[Event, None, None]:
    """Go back to where view ``index`` was taken, and see that the object stands as it stood.

    Raises
    ------
    ObjectMoved
        It fell, was pushed, or has crept: which views it still stood for, nobody knows, and so they are abandoned.
    """
    move = yield from announced(index, table, angle_deg)
    again = yield from capture(index, viewer, table, move.settled_ns)
    alike = image_similarity(image_bgr, again.image_bgr, bench.config.view)
    if alike < SAME_SIMILARITY:
        enrollment.abandon()
        raise ObjectMoved(
            f"{enrollment.object_name} does not stand as it stood for view {index}: it fell, was pushed, or creeps "
            "on the platter.",
            next_step="Put it back on its mark, with something that holds it, and enroll it anew with --replace; "
            "the views taken are abandoned.",
            evidence={"similarity": round(alike, 3), "smallest_similarity": SAME_SIMILARITY, "table_deg": angle_deg},
        )


class _ImuAngle:
    """The table's angle by the gyro alone, from where the encoder first was."""

    def __init__(self) -> None:
        self.angle_deg = 0.0
        self.sigma_deg = 0.0
        self._begun = False

    def add(self, move: Move) -> None:
        if self._begun:
            self.angle_deg += move.gyro.angle_deg
            self.sigma_deg += move.gyro.sigma_deg  # not in squares: bias and scale errors are common to all moves
        else:
            self._begun = True
            self.angle_deg = move.commanded_deg if move.by_gyro else move.encoder_deg


def _disagreement(move: Move) -> RotationDisagreement:
    if move.agreement is None:
        return RotationDisagreement(
            f"Whether the platter turned {move.rotation_encoder_deg:.2f}° with the servo is unknown: "
            f"{move.gyro.reason}.",
            next_step="If nothing knocked the table, go on with --resume; else enroll the object anew with --replace.",
            evidence={"table_deg": round(move.encoder_deg, 2)},
        )
    return RotationDisagreement(
        f"The servo turned {move.rotation_encoder_deg:.2f}°, the platter {move.gyro.angle_deg:.2f}°.",
        next_step="Tighten the platter, `rig acknowledge`, and enroll the object anew with --replace: "
        "views from before and after a slip do not fit together.",
        evidence={
            "difference_deg": round(move.agreement.difference_deg, 3),
            "bound_deg": round(move.agreement.bound_deg, 3),
            "table_deg": round(move.encoder_deg, 2),
        },
    )
