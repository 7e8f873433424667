"""Reading a catalog: from rows to records."""

import json
from collections import defaultdict
from difflib import get_close_matches
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import ColumnElement, Connection, Row, Text, and_, cast, func, select

import hbr
from hbr.descriptors import Descriptor, descriptor
from rig.calibrations.store import CALIBRATIONS
from rig.catalog.describing import region_of
from rig.catalog.records import (
    EnrollmentStatus,
    EnrollmentSummary,
    ObjectSummary,
    Provenance,
    Region,
    Sitting,
    StoredView,
    ViewRecord,
    clean_name,
)
from rig.catalog.schema import DESCRIPTOR, descriptors, enrollments, objects, sittings, views
from rig.core.errors import DescriptorOutdated, ObjectExists, ObjectNotFound


class EnrolledBefore(NamedTuple):
    """What stood behind the enrolled objects.

    ``pictured`` and ``unpictured`` are the objects that were enrolled with a picture of the empty table and without;
    ``newest`` is the last of the pictures: its place in the catalog and its digest.
    """

    pictured: tuple[str, ...]
    unpictured: tuple[str, ...]
    newest: tuple[str, str] | None


def in_use(name: str) -> ColumnElement[bool]:
    """The condition that an object has a name and is not deleted."""
    return and_(objects.c.name == name, objects.c.deleted_utc.is_(None))


def find(connection: Connection, name: str, *, deleted: bool = False) -> tuple[int, str]:
    """Return the id and the name of an object in use, or of the last one ``deleted``.

    Raises
    ------
    ObjectNotFound
        There is none; the next step names those that are spelled alike.
    """
    name = clean_name(name)
    among = objects.c.deleted_utc.is_not(None) if deleted else objects.c.deleted_utc.is_(None)
    object_id = connection.scalar(
        select(objects.c.id).where(objects.c.name == name, among).order_by(objects.c.deleted_utc.desc()).limit(1)
    )
    if object_id is not None:
        return object_id, name
    by_folded = {known.casefold(): known for known in connection.scalars(select(objects.c.name).where(among))}
    near = [by_folded[folded] for folded in get_close_matches(name.casefold(), by_folded)]
    state = "deleted object" if deleted else "object"
    raise ObjectNotFound(
        f"there is no {state} {name!r} in the catalog",
        next_step=f"did you mean {' or '.join(map(repr, near))}?"
        if near
        else f"list the {state}s: rig catalog list{' --deleted' if deleted else ''}",
        evidence={"near": near},
    )


def check_free(connection: Connection, name: str) -> None:
    """Refuse a name that an object in use has, with `ObjectExists`."""
    if connection.scalar(select(objects.c.id).where(in_use(name))) is not None:
        raise ObjectExists(
            f"there is another object {name!r} in the catalog",
            next_step="choose another name, or rename that one: rig catalog rename",
        )


def object_summaries(connection: Connection, where: ColumnElement[bool]) -> list[ObjectSummary]:
    """Return the objects, in the order in which they came into the catalog."""
    count = (
        select(func.count()).where(views.c.enrollment_id == enrollments.c.id).correlate(enrollments).scalar_subquery()
    )
    current = {
        (object_id, status): (finished_utc, view_count)
        for object_id, status, finished_utc, view_count in connection.execute(
            select(enrollments.c.object_id, enrollments.c.status, enrollments.c.finished_utc, count)
            .join(objects)
            .where(enrollments.c.status.in_([EnrollmentStatus.COMPLETE, EnrollmentStatus.IN_PROGRESS]), where)
        )
    }
    summaries = []
    for row in connection.execute(select(objects).where(where).order_by(objects.c.id)):
        enrolled_utc, view_count = current.get((row.id, EnrollmentStatus.COMPLETE), (None, 0))
        _, unfinished_views = current.get((row.id, EnrollmentStatus.IN_PROGRESS), (None, None))
        summaries.append(
            ObjectSummary(
                name=row.name,
                label=row.label,
                note=row.note,
                created_utc=row.created_utc,
                enrolled_utc=enrolled_utc,
                views=view_count,
                unfinished_views=unfinished_views,
                deleted_utc=row.deleted_utc,
            )
        )
    return summaries


def enrollment_summaries(connection: Connection, where: ColumnElement[bool]) -> list[EnrollmentSummary]:
    """Return enrollments, newest first."""
    present = defaultdict(list)
    for enrollment_id, index in connection.execute(
        select(views.c.enrollment_id, views.c.view_index)
        .join(enrollments)
        .where(where)
        .order_by(views.c.enrollment_id, views.c.view_index)
    ):
        present[enrollment_id].append(index)
    sat = defaultdict(list)
    for row in connection.execute(select(sittings).join(enrollments).where(where).order_by(sittings.c.id)):
        sat[row.enrollment_id].append(_sitting(row))
    return [
        EnrollmentSummary(
            id=row.id,
            status=EnrollmentStatus(row.status),
            started_utc=row.started_utc,
            finished_utc=row.finished_utc,
            planned_azimuth_deg=tuple(row.planned_azimuth_deg),
            present=tuple(present[row.id]),
            sittings=tuple(sat[row.id]),
        )
        for row in connection.execute(select(enrollments).where(where).order_by(enrollments.c.id.desc()))
    ]


def stored_views(connection: Connection, where: ColumnElement[bool]) -> list[StoredView]:
    """Return views, by enrollment and index."""
    cedd = descriptor(DESCRIPTOR)
    rows = connection.execute(
        select(views, objects.c.name.label("object_name"), descriptors.c.packed, descriptors.c.settings)
        .join(enrollments, views.c.enrollment_id == enrollments.c.id)
        .join(objects)
        .outerjoin(descriptors, described_by(cedd))
        .where(where)
        .order_by(views.c.enrollment_id, views.c.view_index)
    ).all()
    sitting_ids = {row.sitting_id for row in rows}
    sat = {row.id: _sitting(row) for row in connection.execute(select(sittings).where(sittings.c.id.in_(sitting_ids)))}
    return [
        StoredView(
            id=row.id,
            object_name=row.object_name,
            enrollment_id=row.enrollment_id,
            sitting=sat[row.sitting_id],
            record=ViewRecord(
                index=row.view_index,
                commanded_deg=row.commanded_deg,
                encoder_deg=row.encoder_deg,
                azimuth_deg=row.azimuth_deg,
                descriptor=None if row.packed is None else cedd.unpack(row.packed),
                captured_ns=row.captured_ns,
                imu_deg=row.imu_deg,
                imu_sigma_deg=row.imu_sigma_deg,
                evidence=row.evidence,
                region=None if row.packed is None else region_of(row.settings),
                segmentation=row.segmentation,
            ),
            captured_utc=row.captured_utc,
            image=row.image,
            image_sha256=row.image_sha256,
            image_bytes=row.image_bytes,
        )
        for row in rows
    ]


def described_by(kind: Descriptor) -> ColumnElement[bool]:
    """The condition that a row of `descriptors` is of a view and comparable to what this program computes."""
    return and_(
        descriptors.c.view_id == views.c.id, descriptors.c.name == kind.name, descriptors.c.version == kind.version
    )


def retrieved() -> ColumnElement[bool]:
    """The condition that an object is retrieved through an enrollment."""
    return and_(enrollments.c.status == EnrollmentStatus.COMPLETE, objects.c.deleted_utc.is_(None))


def model_set(connection: Connection, kind: Descriptor) -> tuple[hbr.Views, NDArray[np.int64]]:
    """Return the views of all complete enrollments, by object and index, and their ids.

    Raises
    ------
    DescriptorOutdated
        Some are not described by this version of the descriptor and cannot be compared.
    """
    rows = connection.execute(
        select(objects.c.id, objects.c.name, views.c.id, views.c.azimuth_deg, descriptors.c.packed)
        .select_from(objects)
        .join(enrollments)
        .join(views, views.c.enrollment_id == enrollments.c.id)
        .outerjoin(descriptors, described_by(kind))
        .where(retrieved())
        .order_by(objects.c.id, views.c.view_index)
    ).all()
    if not rows:
        return hbr.Views.empty(kind.name), np.empty(0, np.int64)
    object_ids, names, view_ids, azimuths_deg, packed = zip(*rows, strict=True)
    if None in packed:
        raise _outdated(connection, kind, {name for name, levels in zip(names, packed, strict=True) if levels is None})
    _, first, object_index = np.unique(np.array(object_ids, np.int64), return_index=True, return_inverse=True)
    loaded = hbr.Views(
        descriptors=kind.unpack_rows(b"".join(packed)),
        azimuth_deg=np.array(azimuths_deg, np.float64),
        object_index=object_index,
        object_names=tuple(names[i] for i in first),
        descriptor=kind.name,
    )
    return loaded, np.array(view_ids, np.int64)


def _outdated(connection: Connection, kind: Descriptor, names: set[str]) -> DescriptorOutdated:
    versions = connection.scalars(
        select(descriptors.c.version).where(descriptors.c.name == kind.name).distinct().order_by(descriptors.c.version)
    ).all()
    found = f"by {kind.name} {', '.join(map(str, versions))}" if versions else f"by no {kind.name} at all"
    shown = ", ".join(map(repr, sorted(names)[:3]))
    option = "" if kind.name == DESCRIPTOR else f" --descriptor {kind.name}"
    return DescriptorOutdated(
        f"{shown}{' and others' if len(names) > 3 else ''} cannot be compared: this program compares {kind.name} "
        f"{kind.version}, the catalog is described {found}",
        next_step=f"describe the stored images anew: rig catalog redescribe{option}",
        evidence={"objects": len(names), "versions": list(versions), "version": kind.version},
    )


def enrolled_before(connection: Connection) -> EnrolledBefore:
    """Return what stood behind the objects that are retrieved."""
    newest = None
    pictured: dict[str, bool] = {}
    for name, image, sha256 in connection.execute(
        select(objects.c.name, sittings.c.reference_image, sittings.c.reference_image_sha256)
        .select_from(objects)
        .join(enrollments)
        .join(sittings, sittings.c.enrollment_id == enrollments.c.id)
        .where(retrieved())
        .order_by(sittings.c.started_utc)
    ):
        pictured[name] = pictured.get(name, False) or image is not None
        newest = newest if image is None else (image, sha256)
    return EnrolledBefore(
        tuple(name for name, so in pictured.items() if so),
        tuple(name for name, so in pictured.items() if not so),
        newest,
    )


def regions(connection: Connection, bench: str) -> set[tuple[Region | None, tuple[str, ...]]]:
    """Return the regions that a bench's retrieved views are described within, and what was calibrated meanwhile."""
    rows = connection.execute(
        select(cast(descriptors.c.settings, Text), cast(sittings.c.conditions, Text))
        .select_from(objects)
        .join(enrollments)
        .join(views, views.c.enrollment_id == enrollments.c.id)
        .join(sittings, views.c.sitting_id == sittings.c.id)
        .join(descriptors, described_by(descriptor(DESCRIPTOR)))
        .where(retrieved(), sittings.c.bench == bench)
        .distinct()
    )
    return {
        (region_of(json.loads(settings)), tuple(json.loads(conditions).get(CALIBRATIONS, ())))
        for settings, conditions in rows
    }


def _sitting(row: Row[Any]) -> Sitting:
    return Sitting(
        id=row.id,
        started_utc=row.started_utc,
        provenance=Provenance(bench=row.bench, devices=row.devices, conditions=row.conditions, software=row.software),
        reference_image=row.reference_image,
    )
