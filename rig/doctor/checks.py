"""All checks of a bench, in their order; and those of its stored data: the catalog and the calibrations."""

from collections.abc import Iterator
from typing import Any

from sqlalchemy import select

from rig.calibrations import CalibrationStatus, CalibrationStore, apparatus
from rig.catalog import Catalog
from rig.catalog.facts import View
from rig.core.errors import CatalogError
from rig.core.next_steps import Do
from rig.doctor import computer
from rig.doctor.camera import camera
from rig.doctor.examination import Check, DoctorContext
from rig.doctor.finding import Finding, bad, fine, graded, of_error, warning
from rig.doctor.imu import imu
from rig.doctor.servo import servo

IMAGES = 24  # number of images that are verified; `rig catalog verify` verifies all


def catalog(context: DoctorContext) -> Iterator[Finding]:
    """Check that the catalog can be opened, and that its database and some of its images are undamaged."""
    place = context.config.catalog_place(context.bench)
    path = place if place.url is not None else place.path
    if not place.may_exist():
        yield fine("no_catalog", "none yet in {path}; the first enrollment creates it", path=path)
        return
    with Catalog.open(place, clock=context.computer.clock, read_only=True) as opened:
        # The database: its own check, then the digests of the objects.
        with opened.database.read() as transaction:
            damage = opened.database.damage(transaction)
        if damage:
            text = "{path}: the database is damaged: {damage}"
            yield bad("database_damaged", text, Do.VERIFY_CATALOG(), path=path, damage=damage)
        if (changed := opened.damage()) is not None:
            raise changed
        with opened.database.read() as transaction:
            stored = transaction.scalars(select(View.image).order_by(View.id)).all()
        chosen = stored[:: max(len(stored) // IMAGES, 1)][:IMAGES]  # spread over the catalog
        broken = []
        for image in chosen:
            try:
                opened.read_image(image)
            except CatalogError as error:
                broken.append(error.what)
        if broken:
            text = "{broken} of {images} verified images are damaged: {first}"
            found: dict[str, Any] = {"broken": len(broken), "images": len(chosen), "first": broken[0]}
            yield bad("images_damaged", text, Do.VERIFY_CATALOG(), **found)
        objects = opened.objects()
        unfinished = [item.name for item in objects if item.unfinished_views is not None]
        if unfinished:
            fix = Do.CONTINUE_ENROLLMENT(name=unfinished[0])
            yield warning("unfinished", "unfinished enrollments: {objects}", fix, objects=unfinished)
        if not damage and not broken:
            text = "{path}: {objects} objects, {views} views; database undamaged, {images} images verified"
            found = {"objects": len(objects), "views": sum(item.views for item in objects), "images": len(chosen)}
            yield fine("catalog", text, path=path, **found)


def calibrations(context: DoctorContext) -> Iterator[Finding]:
    """Check that calibrations of this bench's devices exist and have not expired."""
    config = context.config
    store = CalibrationStore(config.calibration_path(context.bench))
    known = store.on_bench(apparatus(context.bench, context.identities, config, {}), context.computer.clock.utc())
    for error in store.unreadable:
        yield of_error(error)
    in_force = set()
    for one in known:
        found: dict[str, Any] = {"calibration": one, "name": one.result.name, "status": one.status, "id": one.result.id}
        is_in_force = one.status is CalibrationStatus.IN_FORCE
        yield graded("calibration", "{calibration}", one.repetition, is_warning=not is_in_force, **found)
        in_force |= {one.result.name} if is_in_force else set()
    if config.camera_time.offset_ms is None and "camera.time" not in in_force:
        text = (
            "a delay inside the camera does not show in its time stamps; a calibration measures it (the table rotates)"
        )
        yield fine("camera_delay_unknown", text, Do.CALIBRATE(name="camera-time"))
    if "scale" not in config.imu.model_fields_set and not any(one.result.name == "imu.scale" for one in known):
        text = "{name} was never calibrated: the gyro's scale may be off by a percent"
        yield warning("never_calibrated", text, Do.CALIBRATE(name="imu"), name="imu.scale")


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
