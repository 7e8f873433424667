"""What the bench keeps: its catalog and its calibrations."""

from collections.abc import Iterator

from rig.calibrations import CalibrationStore, State, apparatus
from rig.catalog import Catalog
from rig.core.errors import CatalogError
from rig.doctor.case import Case
from rig.doctor.finding import Finding, bad, fine, of_error, warning

IMAGES = 24
"""Images that are compared with what was stored; `rig catalog verify` looks at all of them."""

WANTED = {"imu.scale": "the gyro's scale may be off by a percent"}
"""Calibrations that every bench should have, and what is the matter without them."""


def catalog(case: Case) -> Iterator[Finding]:
    """The catalog can be opened, its database is whole, and so are some of its images."""
    path = case.catalog_path
    if not (path / "catalog.sqlite").exists():
        yield fine("catalog", f"none yet in {path}; the first enrollment makes it")
        return
    with Catalog.open(path, clock=case.computer.clock, read_only=True) as opened:
        with opened.database.in_words(), opened.database.read() as connection:
            said = connection.exec_driver_sql("PRAGMA quick_check(5)").scalars().all()
            orphans = len(connection.exec_driver_sql("PRAGMA foreign_key_check").all())
        if said != ["ok"] or orphans:
            text = f"{path}: the database is damaged: {'; '.join(map(str, said))}, {orphans} orphaned rows"
            yield bad("catalog", text, case.rig("catalog verify --repair"), exit_code=7)
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
            text = f"{len(broken)} of {len(chosen)} images that were looked at: {broken[0].what}"
            yield bad("catalog", text, case.rig("catalog verify --repair"), exit_code=7, broken=len(broken))
        unfinished = [item.name for item in objects if item.unfinished_views is not None]
        if unfinished:
            mend = case.rig(f"enroll {unfinished[0]} --resume")
            yield warning("catalog", f"enrollments that were broken off: {', '.join(unfinished)}", mend)
        if said == ["ok"] and not orphans and not broken:
            text = f"{path}: {len(objects)} objects, {len(ids)} views; database whole, {len(chosen)} images whole"
            yield fine("catalog", text, objects=len(objects), views=len(ids))


def calibrations(case: Case) -> Iterator[Finding]:
    """Calibrations are there, of this bench's devices, and not too old."""
    store = CalibrationStore(case.config.calibration_path(case.bench))
    device = apparatus(case.bench, case.identities, case.config, {})
    standings = store.standings(device, case.computer.clock.utc())
    for error in store.unreadable:
        yield of_error("calibration", error)
    for standing in standings:
        if standing.state is State.IN_FORCE:
            yield fine("calibration", standing.words, id=standing.fact.id)
        else:
            yield warning("calibration", standing.words, case.rig(standing.command.removeprefix("rig ")))
    for name, without in WANTED.items():
        if name not in {standing.fact.name for standing in standings} and not _configured(case, name):
            mend = case.rig(f"calibrate {name.partition('.')[0]}")
            yield warning("calibration", f"{name} was never calibrated: {without}", mend)


def _configured(case: Case, key: str) -> bool:
    """Return whether a person set the key in the configuration."""
    section, _, name = key.partition(".")
    return name in getattr(case.config, section).model_fields_set
