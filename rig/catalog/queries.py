"""Queries of a catalog, which return its rows as records."""

from collections import defaultdict
from collections.abc import Collection, Sequence
from difflib import get_close_matches
from hashlib import sha256
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import ColumnElement, Connection, Row, Select, Table, and_, func, select

import hbr
from hbr.descriptors import Descriptor
from rig.catalog.columns import damaged
from rig.catalog.describing import is_current, region_of, unpack
from rig.catalog.records import (
    EnrollmentStatus,
    EnrollmentSummary,
    ObjectSummary,
    PackedDescriptor,
    Provenance,
    Region,
    Session,
    StoredView,
    ViewRecord,
    clean_name,
)
from rig.catalog.rows import measured, of_status
from rig.catalog.schema import descriptors, enrollments, objects, sessions, views
from rig.catalog.seal import check_loaded
from rig.core.errors import CatalogError, DescriptorOutdated, ObjectExists, ObjectNotFound
from rig.core.next_steps import Do
from rig.views.description import PAPER_DESCRIPTOR


class ModelSet(NamedTuple):
    """The views that searches use, and the id of each view, int64 (n,), for `Catalog.view`."""

    views: hbr.Views
    view_ids: NDArray[np.int64]


def in_use(name: str) -> ColumnElement[bool]:
    """Return the condition that an object has a name and is not deleted."""
    return and_(objects.c.name == name, objects.c.deleted_utc.is_(None))


def find(connection: Connection, name: str, *, deleted: bool = False) -> tuple[int, str]:
    """Return the id and the name of an object in use, or of the last ``deleted`` one.

    Raises
    ------
    ObjectNotFound
        There is no such object. The next step lists similar names.
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
        f"There is no {state} {name!r} in the catalog.",
        next_step=f"Did you mean {' or '.join(map(repr, near))}?" if near else Do.LIST_OBJECTS(deleted=deleted),
        evidence={"near": near},
    )


def check_free(connection: Connection, name: str) -> None:
    """Raise `ObjectExists` if an object in use has this name."""
    if connection.scalar(select(objects.c.id).where(in_use(name))) is not None:
        raise ObjectExists(
            f"There is another object {name!r} in the catalog.",
            next_step=("Choose another name, or", Do.RENAME(name=name)),
        )


def object_summaries(connection: Connection, where: ColumnElement[bool]) -> list[ObjectSummary]:
    """Return objects, in the order in which they were added to the catalog."""
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
        check_complete(row, objects)
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
    taken = defaultdict(list)
    for row in connection.execute(select(sessions).join(enrollments).where(where).order_by(sessions.c.id)):
        taken[row.enrollment_id].append(_session(row))
    found = connection.execute(select(enrollments).where(where).order_by(enrollments.c.id.desc())).all()
    for row in found:
        check_complete(row, enrollments)
    return [
        EnrollmentSummary(
            id=row.id,
            status=EnrollmentStatus(row.status),
            started_utc=row.started_utc,
            finished_utc=row.finished_utc,
            planned_azimuth_deg=tuple(row.planned_azimuth_deg),
            present=tuple(present[row.id]),
            sessions=tuple(taken[row.id]),
        )
        for row in found
    ]


def unfinished(connection: Connection, object_id: int, name: str) -> Row[Any]:
    """Return the unfinished enrollment of an object; a `CatalogError` if there is none."""
    found = connection.execute(select(enrollments).where(of_status(object_id, EnrollmentStatus.IN_PROGRESS))).first()
    if found is None:
        raise CatalogError(f"{name!r} has no unfinished enrollment.", next_step=Do.ENROLL(name=name))
    return found


def check_not_enrolled(connection: Connection, object_id: int, name: str) -> None:
    """Raise an error if an object is enrolled, or its enrollment has begun."""
    for enrollment in enrollment_summaries(connection, enrollments.c.object_id == object_id):
        if enrollment.status == EnrollmentStatus.IN_PROGRESS:
            raise CatalogError(
                f"The enrollment of {name!r} is unfinished, with {len(enrollment.present)} of "
                f"{len(enrollment.planned_azimuth_deg)} views.",
                next_step=(Do.CONTINUE_ENROLLMENT(name=name), "Or", Do.ENROLL_AGAIN(name=name)),
            )
        if enrollment.status == EnrollmentStatus.COMPLETE:
            raise ObjectExists(
                f"{name!r} is enrolled already, with {len(enrollment.present)} views.",
                next_step=(
                    "Choose another name, or",
                    Do.ENROLL_AGAIN(name=name),
                    "The old views stay in use until the new ones are complete.",
                ),
            )


def stored_views(connection: Connection, where: ColumnElement[bool]) -> list[StoredView]:
    """Return views, by enrollment and index, with the descriptors that this program computes."""
    rows = connection.execute(
        select(views, objects.c.name.label("object_name"))
        .join(enrollments, views.c.enrollment_id == enrollments.c.id)
        .join(objects)
        .where(where)
        .order_by(views.c.enrollment_id, views.c.view_index)
    ).all()
    session_ids = {row.session_id for row in rows}
    taken = {
        row.id: _session(row) for row in connection.execute(select(sessions).where(sessions.c.id.in_(session_ids)))
    }
    packed = packed_descriptors(connection, where)
    for row in rows:
        check_complete(row, views)
        if row.session_id not in taken:
            raise damaged("the session of a view", row.session_id)
    return [
        StoredView(
            id=row.id,
            object_name=row.object_name,
            enrollment_id=row.enrollment_id,
            session=taken[row.session_id],
            record=ViewRecord(
                index=row.view_index,
                **measured(row),
                descriptors=unpack(packed[row.id]),
                region=_region(packed[row.id]),
            ),
            captured_utc=row.captured_utc,
            image=row.image,
            image_sha256=row.image_sha256,
            image_bytes=row.image_bytes,
        )
        for row in rows
    ]


def packed_descriptors(connection: Connection, where: ColumnElement[bool]) -> dict[int, list[PackedDescriptor]]:
    """Return the descriptors of views by their id, in the order of names and versions; empty for a view without any."""
    found: dict[int, list[PackedDescriptor]] = defaultdict(list)
    for view_id, *columns in connection.execute(
        select(descriptors)
        .select_from(descriptors)
        .join(views, descriptors.c.view_id == views.c.id)
        .join(enrollments, views.c.enrollment_id == enrollments.c.id)
        .join(objects)
        .where(where)
        .order_by(descriptors.c.view_id, descriptors.c.name, descriptors.c.version)
    ):
        found[view_id].append(PackedDescriptor(*columns))
    return found


def _region(packed: Sequence[PackedDescriptor]) -> Region | None:
    """The region of the paper's descriptor, or of the first other one."""
    current = [one for one in packed if is_current(one.name, one.version)]
    chosen = next((one for one in current if one.name == PAPER_DESCRIPTOR), next(iter(current), None))
    return None if chosen is None else region_of(chosen.settings)


def described_by(kind: Descriptor) -> ColumnElement[bool]:
    """Return the condition that a row of `descriptors` describes a view in the version that this program computes."""
    return and_(
        descriptors.c.view_id == views.c.id, descriptors.c.name == kind.name, descriptors.c.version == kind.version
    )


def retrieved() -> ColumnElement[bool]:
    """Return the condition that searches use an enrollment: it is complete, and its object is in use."""
    return and_(enrollments.c.status == EnrollmentStatus.COMPLETE, objects.c.deleted_utc.is_(None))


def of_views(*columns: Any) -> Select[Any]:
    """Return a query of columns of views and of their enrollments and objects."""
    in_enrollment = views.c.enrollment_id == enrollments.c.id
    return select(*columns).select_from(objects).join(enrollments).join(views, in_enrollment)


def model_set(connection: Connection, kind: Descriptor, object_ids: Collection[int] | None = None) -> ModelSet:
    """Return the views of all complete enrollments, or of those of some objects, by object and index, and their ids.

    Raises
    ------
    DescriptorOutdated
        Some views are not described by this version of the descriptor and cannot be compared.
    CatalogDamaged
        An object or a view is not as it was stored.
    """
    rows = connection.execute(
        of_views(objects.c.id, objects.c.name, views.c.id, views.c.azimuth_deg, descriptors.c.packed, enrollments.c.id)
        .outerjoin(descriptors, described_by(kind))
        .where(retrieved() if object_ids is None else and_(retrieved(), objects.c.id.in_(object_ids)))
        .order_by(objects.c.id, views.c.view_index)
    ).all()
    if not rows:
        return ModelSet(hbr.Views.empty(kind.name), np.empty(0, np.int64))
    found_ids, names, view_ids, azimuths_deg, packed, enrollment_ids = zip(*rows, strict=True)
    if None in packed:
        raise _outdated(connection, kind, names, [levels is None for levels in packed])
    check_loaded(connection, set(found_ids), set(enrollment_ids))
    if set(map(len, packed)) != {kind.size_bytes}:
        raise damaged("the length of a descriptor", sorted(set(map(len, packed))))
    _, first, object_index = np.unique(np.array(found_ids, np.int64), return_index=True, return_inverse=True)
    loaded = hbr.Views(
        descriptors=kind.unpack_rows(b"".join(packed)),
        azimuth_deg=np.array(azimuths_deg, np.float64),
        object_index=object_index,
        object_names=tuple(names[i] for i in first),
        descriptor=kind.name,
    )
    return ModelSet(loaded, np.array(view_ids, np.int64))


def searched_version(connection: Connection) -> str:
    """Return a SHA-256 over the names of the objects in use and the digests of their complete enrollments."""
    used = select(objects.c.name, enrollments.c.digest).join(enrollments).where(retrieved()).order_by(objects.c.id)
    return sha256(ascii([tuple(row) for row in connection.execute(used)]).encode()).hexdigest()


def _outdated(
    connection: Connection, kind: Descriptor, names: Sequence[str], is_missing: Sequence[bool]
) -> DescriptorOutdated:
    """Return the error that some views, given by their objects, are not described by this version."""
    versions = connection.scalars(
        select(descriptors.c.version).where(descriptors.c.name == kind.name).distinct().order_by(descriptors.c.version)
    ).all()
    lacking = sorted({name for name, missing in zip(names, is_missing, strict=True) if missing})
    shown = ", ".join(map(repr, lacking[:3])) + (f" and {len(lacking) - 3} more" if len(lacking) > 3 else "")
    others = [str(version) for version in versions if version != kind.version]
    also = f" Other views have version {' or '.join(others)}." if others else ""
    views, described = len(names), len(names) - sum(is_missing)
    return DescriptorOutdated(
        f"{described} of {views} views have the descriptor {kind.name} {kind.version}; it is missing for {shown}."
        f"{also}",
        next_step=Do.REDESCRIBE(descriptor=None if kind.name == PAPER_DESCRIPTOR else kind.name),
        evidence={
            "views": views,
            "described": described,
            "objects": len(lacking),
            "versions": list(versions),
            "version": kind.version,
        },
    )


def check_complete(row: Row[Any], table: Table) -> None:
    """Raise `CatalogDamaged` if a row of a table lacks a value."""
    for column in table.columns:
        if not column.nullable and row._mapping[column] is None:
            raise damaged(f"{table.name}.{column.name}", None)


def _session(row: Row[Any]) -> Session:
    check_complete(row, sessions)
    return Session(
        id=row.id,
        started_utc=row.started_utc,
        provenance=Provenance(bench=row.bench, devices=row.devices, conditions=row.conditions, software=row.software),
        empty_table_image=row.empty_table_image,
    )
