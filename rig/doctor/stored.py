"""Check the stored data of the bench: its catalog and its calibrations."""

from collections.abc import Iterator

from rig.calibrations import CalibrationStatus, CalibrationStore, apparatus
from rig.catalog import Catalog
from rig.core.errors import CatalogError
from rig.doctor.context import DoctorContext
from rig.doctor.finding import Finding, bad, fine, of_error, warning

IMAGES = 24  # number of images that are verified; `rig catalog verify` verifies all

WANTED = {"imu.scale": "the gyro's scale may be off by a percent"}
"""Calibrations that every bench should have, and the consequence of a missing one."""


def catalog(context: DoctorContext) -> Iterator[Finding]:
    """Check that the catalog can be opened, and that its database and some of its images are undamaged."""
    path = context.catalog_path
    if not (path / "catalog.sqlite").exists():
        yield fine("catalog", f"none yet in {path}; the first enrollment creates it")
        return
    with Catalog.open(path, clock=context.computer.clock, read_only=True) as opened:
        with opened.database.catalog_errors(), opened.database.read() as connection:
            checked = connection.exec_driver_sql("PRAGMA quick_check(5)").scalars().all()
            orphans = len(connection.exec_driver_sql("PRAGMA foreign_key_check").all())
        if checked != ["ok"] or orphans:
            text = f"{path}: the database is damaged: {'; '.join(map(str, checked))}, {orphans} orphaned rows"
            yield bad("catalog", text, context.rig("catalog verify --repair"), exit_code=7)
        objects = opened.objects()
        ids = opened.views().view_ids.tolist()
        chosen = ids[:: max(len(ids) // IMAGES, 1)][:IMAGES]
        broken = []
        for view_id in chosen:
            try:
                opened.read_image(opened.view(view_id))
            except CatalogError as error:
                broken.append(error)
        if broken:
            text = f"{len(broken)} of {len(chosen)} verified images are damaged: {broken[0].what}"
            yield bad("catalog", text, context.rig("catalog verify --repair"), exit_code=7, broken=len(broken))
        unfinished = [item.name for item in objects if item.unfinished_views is not None]
        if unfinished:
            fix = context.rig(f"enroll {unfinished[0]} --resume")
            yield warning("catalog", f"unfinished enrollments: {', '.join(unfinished)}", fix)
        if checked == ["ok"] and not orphans and not broken:
            text = (
                f"{path}: {len(objects)} objects, {len(ids)} views; database undamaged, {len(chosen)} images verified"
            )
            yield fine("catalog", text, objects=len(objects), views=len(ids))


def calibrations(context: DoctorContext) -> Iterator[Finding]:
    """Check that calibrations of this bench's devices exist and have not expired."""
    store = CalibrationStore(context.config.calibration_path(context.bench))
    device = apparatus(context.bench, context.identities, context.config, {})
    standings = store.standings(device, context.computer.clock.utc())
    for error in store.unreadable:
        yield of_error("calibration", error)
    for standing in standings:
        if standing.status is CalibrationStatus.IN_FORCE:
            yield fine("calibration", standing.text, id=standing.result.id)
        else:
            yield warning("calibration", standing.text, context.rig(standing.command.removeprefix("rig ")))
    for name, without in WANTED.items():
        if name not in {standing.result.name for standing in standings} and not _configured(context, name):
            fix = context.rig(f"calibrate {name.partition('.')[0]}")
            yield warning("calibration", f"{name} was never calibrated: {without}", fix)


def _configured(context: DoctorContext, key: str) -> bool:
    """Return whether the configuration sets the key."""
    section, _, name = key.partition(".")
    return name in getattr(context.config, section).model_fields_set
