"""All checks of a bench, in their order; and those of its stored data: the catalog and the calibrations."""

from collections.abc import Iterable, Iterator

from sqlalchemy import select

from rig.calibrations import CalibrationStatus, CalibrationStore, apparatus, apply_results
from rig.calibrations.store import BenchCalibration
from rig.catalog import Catalog
from rig.catalog.facts import View
from rig.core.errors import CatalogError
from rig.core.next_steps import Do
from rig.doctor import computer
from rig.doctor.camera import camera
from rig.doctor.context import DoctorContext
from rig.doctor.examination import Check
from rig.doctor.finding import Finding, FindingCode, graded, of_error
from rig.doctor.imu import imu
from rig.doctor.servo import servo
from rig.views.stream import exposed_before_stamp_ns

IMAGES = 24  # number of images that are verified; `rig catalog verify` verifies all

WANTED = {"imu.scale": "the gyro's scale may be off by a percent"}
"""Calibrations that every bench should have, and the consequence of a missing one."""


def catalog(context: DoctorContext) -> Iterator[Finding]:
    """Check that the catalog can be opened, and that its database and some of its images are undamaged."""
    place = context.config.catalog_place(context.bench)
    path = place if place.url is not None else place.path
    if not place.may_exist():
        yield FindingCode.NO_CATALOG(path=path)
        return
    with Catalog.open(place, clock=context.computer.clock, read_only=True) as opened:
        with opened.database.read() as transaction:
            checked = opened.database.damage(transaction)
        if checked:
            yield FindingCode.DATABASE_DAMAGED(path=path, damage=checked)
        if (changed := opened.damage()) is not None:
            raise changed
        objects, chosen = opened.objects(), _some_images(opened)
        broken = []
        for image in chosen:
            try:
                opened.read_image(image)
            except CatalogError as error:
                broken.append(error)
        if broken:
            found = {"broken": len(broken), "images": len(chosen), "first": broken[0].what}
            yield FindingCode.IMAGES_DAMAGED(**found)
        unfinished = [item.name for item in objects if item.unfinished_views is not None]
        if unfinished:
            yield FindingCode.UNFINISHED(Do.CONTINUE_ENROLLMENT(name=unfinished[0]), objects=unfinished)
        if not checked and not broken:
            counts = {"objects": len(objects), "views": sum(item.views for item in objects), "images": len(chosen)}
            yield FindingCode.CATALOG(path=path, **counts)


def _some_images(opened: Catalog) -> list[str]:
    """Return the names of images of views, spread over the catalog."""
    with opened.database.read() as transaction:
        ids = transaction.scalars(select(View.id).order_by(View.id)).all()
        chosen = ids[:: max(len(ids) // IMAGES, 1)][:IMAGES]
        return list(transaction.scalars(select(View.image).where(View.id.in_(chosen)).order_by(View.id)))


def calibrations(context: DoctorContext) -> Iterator[Finding]:
    """Check that calibrations of this bench's devices exist and have not expired."""
    store = CalibrationStore(context.config.calibration_path(context.bench))
    device = apparatus(context.bench, context.identities, context.config, {})
    calibrations = store.on_bench(device, context.computer.clock.utc())
    for error in store.unreadable:
        yield of_error(error)
    for calibration in calibrations:
        found = {
            "calibration": calibration,
            "name": calibration.result.name,
            "status": calibration.status,
            "id": calibration.result.id,
        }
        level = graded(bad=False, warning=calibration.status is not CalibrationStatus.IN_FORCE)
        yield FindingCode.CALIBRATION(calibration.repetition, level, **found)
    yield _camera_delay(context, calibrations)
    for name, without in WANTED.items():
        if name not in {calibration.result.name for calibration in calibrations} and not _configured(context, name):
            fix = Do.CALIBRATE(name=name.partition(".")[0])
            yield FindingCode.NEVER_CALIBRATED(fix, name=name, consequence=without)


def _camera_delay(context: DoctorContext, calibrations: Iterable[BenchCalibration]) -> Finding:
    """Return the time that views wait for a delay inside the camera, which its time stamps do not show."""
    in_force = (one.result for one in calibrations if one.status is CalibrationStatus.IN_FORCE)
    config, _ = apply_results(context.config, in_force)
    if config.camera_time.offset_ms is None:
        return FindingCode.CAMERA_DELAY_UNKNOWN()
    delay_ms = exposed_before_stamp_ns(config) * 1e-6
    found = config.camera_time.model_dump()
    return FindingCode.CAMERA_DELAY(delay_ms=delay_ms, **found)


def _configured(context: DoctorContext, key: str) -> bool:
    section, _, name = key.partition(".")
    return name in getattr(context.config, section).model_fields_set


CHECKS = (
    Check("bench", computer.bench_state, exit_code=5),
    Check("port", computer.ports),
    # Between two findings it may scan eight baud rates; a broadcast at 9,600 baud takes four seconds.
    Check("servo", servo, deadline_s=60.0, opens=True),
    Check("imu", imu, opens=True),
    Check("camera", camera, deadline_s=20.0, opens=True),
    Check("disk", computer.disk, exit_code=7),
    Check("clock", computer.clock, exit_code=1),
    Check("catalog", catalog, deadline_s=30.0, exit_code=7),
    Check("calibration", calibrations),
)
"""The devices are checked before their calibrations, which are bound to the devices found."""
