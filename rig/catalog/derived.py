"""What searches need of a catalog: descriptors and silhouettes of the enrolled views, and how they were taken.

The views of an enrollment are segmented and described together, once, when it ends, as a search segments its views. The
result is kept in the catalog's table ``derived``. It names the enrollment by its seal, and the versions that made it. A
missing, old or damaged result is computed again, so the table can be emptied at any time.

Decision: docs/decisions/0010.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from sqlalchemy import select

import hbr
from hbr.dense.pixel_fit import LocalView
from hbr.dense.session import near
from rig.calibrations.store import CALIBRATIONS
from rig.catalog import state
from rig.catalog.catalog import Catalog
from rig.catalog.columns import damaged
from rig.catalog.describing import (
    describe_one,
    described,
    known_descriptor,
    records_of,
    segmented_again,
    store,
    stored_contents,
)
from rig.catalog.facts import Enrollment, Session, View, seal_of
from rig.catalog.jobs import JobProgress, processes
from rig.catalog.records import JsonObject, Region
from rig.core.errors import CatalogError
from rig.core.next_steps import Do
from rig.core.processes import map_in_processes
from rig.views.description import BENCH_DESCRIPTOR, DESCRIPTORS, PAPER_DESCRIPTOR


def views(
    catalog: Catalog, descriptor: str = PAPER_DESCRIPTOR, progress: Callable[[JobProgress], None] | None = None
) -> hbr.Views:
    """Return the views of every complete enrollment of the objects in use, by object and index.

    ``progress`` is called with the number of enrollments while it describes those that are not described yet.

    Raises `UsageError`: there is no such descriptor. `CatalogError`: a view that is not described yet cannot be
    described.
    """
    kind = known_descriptor(descriptor)
    # The descriptors of every enrolled view are computed from one segmentation.
    together = DESCRIPTORS if kind.name in DESCRIPTORS and not kind.whole_image else (kind.name,)
    with catalog.reading() as now:
        wanted = now.used(checked=True)
        found = stored_contents(now.transaction, [one.seal for one in wanted], (kind.name,))[kind.name]
        missing = []
        for one in wanted:
            if one.seal not in found:
                (known,) = now.enrollments(Enrollment.id == one.enrollment_id)
                missing.append((one.name, known.enrollment))
    report = progress or (lambda _: None)
    if missing:
        report(JobProgress(0, len(missing)))
    count = sum(len(enrollment.views) for _, enrollment in missing)
    work = partial(describe_one, catalog.database.images, together)
    failed = ""
    for done, ((name, enrollment), contents) in enumerate(map_in_processes(work, missing, processes(None, count)), 1):
        if isinstance(contents, str):
            failed = failed or f"{name!r} cannot be described: {contents}."
        else:
            seal = seal_of(enrollment)
            store(catalog.database, seal, contents)
            found[seal] = contents[kind.name]
        report(JobProgress(done, len(missing)))
    if failed:
        raise CatalogError(failed, next_step=Do.VERIFY_CATALOG())
    if not wanted:
        return hbr.Views.empty(kind.name)
    in_order = [found[one.seal] for one in wanted]
    records = records_of(kind, b"".join(in_order))
    azimuth_deg = np.ascontiguousarray(records["azimuth_deg"])
    if not ((azimuth_deg >= 0) & (azimuth_deg < 360)).all():
        raise damaged("an azimuth of a stored description", azimuth_deg.min())
    return hbr.PackedViews(
        records["packed"],
        azimuth_deg,
        np.repeat(np.arange(len(wanted)), [len(content) // records.itemsize for content in in_order]),
        tuple(one.name for one in wanted),
        kind.name,
    )


def local_views(catalog: Catalog, name: str, azimuths_deg: Sequence[float]) -> list[LocalView]:
    """Return the enrolled views of an object that are nearest to each of these azimuths, by azimuth.

    They are cut out as at the enrollment. Which these are, `hbr.dense.session.near` decides for the bench and for the
    evaluation.

    Raises `ObjectNotFound`, `CatalogError`: there is no such object, or an image is missing or is not the stored one.
    """
    enrollment = catalog.object(name).complete
    if enrollment is None:
        return []
    evidence = described(catalog.database, enrollment, name, BENCH_DESCRIPTOR).segmentation
    cut_out = []
    for place in near([view.azimuth_deg for view in enrollment.views], azimuths_deg):
        view = enrollment.views[place]
        with catalog.database.catalog_errors():
            session = enrollment.sessions[view.session]
            _, cut = segmented_again(catalog.database.images, view, session, evidence[place])
        cut_out.append(LocalView(cut.crop, cut.mask, view.azimuth_deg))
    return cut_out


def described_regions(catalog: Catalog, bench: str) -> set[tuple[Region | None, tuple[str, ...]]]:
    """Return the regions that the views of a bench are described within; None is the whole image.

    Each region comes with the ids of the calibration results in force when its views were taken.
    """
    sessions, found = Session.__table__.c, set()
    with catalog.reading() as now:
        ids = {one.enrollment_id for one in now.used()}
        rows = now.transaction.execute(
            select(sessions.enrollment_id, sessions.conditions, View.region)
            .join(View, (View.enrollment_id == sessions.enrollment_id) & (View.session == sessions.number))
            .where(sessions.bench == bench, View.index == 0)
        ).all()
        for enrollment_id, conditions, region in rows:
            if enrollment_id in ids:
                found.add((region, tuple(map(str, conditions.get(CALIBRATIONS) or ()))))
    return found


# How the views were taken


class EmptyTables(NamedTuple):
    """Names of the objects that were enrolled with an empty-table image and without, and the newest of these images."""

    with_image: tuple[str, ...]
    without_image: tuple[str, ...]
    newest: str | None


def empty_tables(catalog: Catalog) -> EmptyTables:
    """Return which of the objects in use were enrolled with an empty-table image."""
    newest: tuple[int, int] | None = None
    with_image: dict[str, bool] = {}
    with catalog.reading() as now:
        owner = {one.enrollment_id: one.name for one in now.used()}
        rows = now.transaction.execute(
            select(Session.enrollment_id, Session.number, Session.empty_table).order_by(Session.started_utc)
        )
        for enrollment_id, number, image in rows:
            if (name := owner.get(enrollment_id)) is not None:
                with_image[name] = with_image.get(name, False) or image is not None
                newest = newest if image is None else (enrollment_id, number)
        image = None if newest is None else state.session(now.transaction, *newest).empty_table
    with_one = tuple(name for name in owner.values() if with_image.get(name))
    return EmptyTables(with_one, tuple(name for name in owner.values() if not with_image.get(name)), image)


def camera_settings(catalog: Catalog) -> list[dict[str, Any]]:
    """Return the camera's settings (`rig.devices.camera.CameraLocks`) of the objects in use, each combination once."""
    with catalog.reading() as now:
        shown = _settings((view.id, view.evidence) for view in now.first_views(View.id, View.evidence))
        for view_id, _ in shown:
            state.view(now.transaction, view_id)  # of an edited one nothing is used
    return [settings for _, settings in shown]


def camera_settings_of(views: Iterable[View]) -> list[dict[str, Any]]:
    """Return the camera's settings of some views, each combination once."""
    return [settings for _, settings in _settings((view.id, view.evidence) for view in views)]


def _settings(evidence: Iterable[tuple[int, JsonObject | None]]) -> list[tuple[int, dict[str, Any]]]:
    """Return each combination of the camera's settings once, with the first view that has it."""
    found: list[tuple[int, dict[str, Any]]] = []
    for view_id, one in evidence:
        if one is None:
            raise damaged("the evidence of a view", None)
        locks = one.get("locks")
        if isinstance(locks, dict) and all(locks != known for _, known in found):
            found.append((view_id, locks))
    return found
