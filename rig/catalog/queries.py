"""Reading a catalog: from rows to records."""

from collections import defaultdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import ColumnElement, Connection, Row, and_, func, select

import hbr
from rig.catalog.records import (
    EnrollmentStatus,
    EnrollmentSummary,
    ObjectSummary,
    Provenance,
    Sitting,
    StoredView,
    ViewRecord,
)
from rig.catalog.schema import DESCRIPTOR_KIND, DESCRIPTOR_VERSION, enrollments, objects, sittings, views
from rig.errors import CatalogError


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
    rows = connection.execute(
        select(views, objects.c.name.label("object_name"))
        .join(enrollments, views.c.enrollment_id == enrollments.c.id)
        .join(objects)
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
                descriptor=hbr.unpack(row.descriptor),
                captured_ns=row.captured_ns,
                imu_deg=row.imu_deg,
                imu_sigma_deg=row.imu_sigma_deg,
                evidence=row.evidence,
            ),
            captured_utc=row.captured_utc,
            image=row.image,
            image_sha256=row.image_sha256,
            image_bytes=row.image_bytes,
        )
        for row in rows
    ]


def model_set(connection: Connection) -> tuple[hbr.Views, NDArray[np.int64]]:
    """Return the views of all complete enrollments, by object and index, and their ids.

    Raises
    ------
    CatalogError
        Some were described by another version of the descriptor and cannot be compared.
    """
    complete = enrollments.c.status == EnrollmentStatus.COMPLETE
    ours = and_(views.c.descriptor_kind == DESCRIPTOR_KIND, views.c.descriptor_version == DESCRIPTOR_VERSION)
    stranger = connection.execute(
        select(objects.c.name, views.c.descriptor_kind, views.c.descriptor_version)
        .join(enrollments, views.c.enrollment_id == enrollments.c.id)
        .join(objects)
        .where(complete, ~ours)
        .limit(1)
    ).first()
    if stranger is not None:
        raise CatalogError(
            f"{stranger.name!r} is described by {stranger.descriptor_kind} {stranger.descriptor_version}; "
            f"this program compares {DESCRIPTOR_KIND} {DESCRIPTOR_VERSION}",
            next_step="use the program that it was enrolled with, or enroll it again with --replace",
        )
    rows = connection.execute(
        select(enrollments.c.object_id, views.c.id, views.c.azimuth_deg, views.c.descriptor)
        .join(enrollments, views.c.enrollment_id == enrollments.c.id)
        .where(complete)
        .order_by(enrollments.c.object_id, views.c.view_index)
    ).all()
    if not rows:
        return hbr.Views.empty(), np.empty(0, np.int64)
    object_ids, view_ids, azimuths_deg, packed = zip(*rows, strict=True)
    known_ids, object_index = np.unique(np.array(object_ids, np.int64), return_inverse=True)
    names = {row.id: row.name for row in connection.execute(select(objects.c.id, objects.c.name))}
    loaded = hbr.Views(
        descriptors=hbr.unpack_rows(b"".join(packed)),
        azimuth_deg=np.array(azimuths_deg, np.float64),
        object_index=object_index,
        object_names=tuple(names[int(object_id)] for object_id in known_ids),
    )
    return loaded, np.array(view_ids, np.int64)


def _sitting(row: Row[Any]) -> Sitting:
    return Sitting(
        id=row.id,
        started_utc=row.started_utc,
        provenance=Provenance(bench=row.bench, devices=row.devices, conditions=row.conditions, software=row.software),
    )
