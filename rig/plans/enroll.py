"""The plan that enrolls an object: one revolution, with a checked view at every step.

Each view is stored before the table rotates to the next one.

Decision: docs/decisions/0002.
"""

from collections.abc import Generator
from contextlib import suppress

from rig.bench import Bench
from rig.catalog import Catalog, Provenance
from rig.catalog.derived import unfinished_camera_settings
from rig.core.clock import seconds_between
from rig.core.errors import RigError
from rig.events.events import Enrolled, Event, Started
from rig.motion.scan_speed import require_camera_time, takes_in_motion
from rig.motion.turntable import Turntable
from rig.plans.capture import check_camera
from rig.plans.enroll_views import EnrollmentViews
from rig.plans.estimate import even_azimuths, table_angles
from rig.views.capture import Viewer
from rig.views.description import ViewDescriber
from rig.views.empty_table import empty_table_status


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

    With ``fly`` the views are taken in one revolution without a stop (`rig.plans.enroll_views`). Views that fail or are
    missing are then taken at rest. The default is ``enroll.mode``; "auto" means at rest.

    Every view is segmented for its checks and its event, with the bench's empty-table image if there is one
    (`rig.plans.photograph_table`); the enrollment stores it. At the end all views are segmented and described together
    (`OpenEnrollment.finish`).

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
    empty_table = None if status.table is None else status.table.image_bgr
    if resume:
        check_camera(bench, unfinished_camera_settings(catalog, name))
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
            segment = ViewDescriber(bench.config.view, empty_table=empty_table)
            viewer = Viewer(bench.camera, bench.config, encodes=not in_motion)
            with Turntable(bench) as table:
                taking = EnrollmentViews(bench, enrollment, segment, table, viewer)
                yield from taking.take(to_go, in_motion=in_motion)
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
