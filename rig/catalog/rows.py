"""Insert sessions and views into the tables. Enrolled and imported views take the same path."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any, Final

from sqlalchemy import (
    JSON,
    ColumnElement,
    Connection,
    Row,
    Table,
    Text,
    and_,
    bindparam,
    cast,
    insert,
    select,
    type_coerce,
    update,
)

from rig.catalog.columns import JsonText
from rig.catalog.database import insert_row
from rig.catalog.records import EnrollmentStatus, ImageFile, PackedDescriptor, Provenance
from rig.catalog.schema import descriptors, enrollments, sessions, views

MEASURED: Final = (
    *("azimuth_deg", "commanded_deg", "encoder_deg", "imu_deg", "imu_sigma_deg"),
    *("captured_ns", "evidence", "segmentation"),
)
"""Columns of a view that `ViewRecord` and the views of a bundle have under the same names."""


def measured(view: object) -> dict[str, Any]:
    """Return the columns `MEASURED` of a view, from its attributes of these names."""
    return {name: getattr(view, name) for name in MEASURED}


@dataclass(frozen=True, slots=True)
class NewView:
    """A view to be inserted; `measured` holds the columns of `MEASURED`. Its image file is in its place already."""

    index: int
    measured: Mapping[str, Any]
    session_id: int
    captured_utc: datetime | None
    image: ImageFile
    descriptors: Sequence[PackedDescriptor]


def insert_session(
    connection: Connection,
    enrollment_id: int,
    started_utc: datetime,
    provenance: Provenance,
    empty_table: ImageFile | None = None,
) -> int:
    """Insert a session and return its id."""
    columns = {**asdict(provenance), **empty_table_columns(empty_table)}
    return insert_row(connection, sessions, enrollment_id=enrollment_id, started_utc=started_utc, **columns)


def empty_table_columns(image: ImageFile | None) -> dict[str, Any]:
    """Return the columns of a session that its empty-table image takes."""
    path, sha256, size = image or (None, None, None)
    return {"empty_table_image": path, "empty_table_image_sha256": sha256, "empty_table_image_bytes": size}


def insert_views(connection: Connection, enrollment_id: int, new: Sequence[NewView]) -> list[int]:
    """Insert views of an enrollment with their descriptors, and return their ids in the same order."""
    if not new:
        return []
    connection.execute(
        insert(views),
        [
            {
                **one.measured,
                "enrollment_id": enrollment_id,
                "view_index": one.index,
                "session_id": one.session_id,
                "captured_utc": one.captured_utc,
                "image": one.image.path,
                "image_sha256": one.image.sha256,
                "image_bytes": one.image.size,
            }
            for one in new
        ],
    )
    stored = select(views.c.view_index, views.c.id).where(views.c.enrollment_id == enrollment_id)
    by_index = {row.view_index: row.id for row in connection.execute(stored)}
    ids = [by_index[one.index] for one in new]
    connection.execute(
        insert(descriptors),
        [
            {"view_id": view_id, **packed._asdict()}
            for view_id, one in zip(ids, new, strict=True)
            for packed in one.descriptors
        ],
    )
    return ids


def copied_columns(connection: Connection, table: Table) -> list[ColumnElement[Any]]:
    """Return the columns of a table for `insert_copies`: JSON as the stored text, because digests are over the text."""
    as_text = cast if connection.dialect.name == "postgresql" else type_coerce
    return [
        as_text(column, Text).label(column.name) if isinstance(column.type, JsonText) else column
        for column in table.columns
    ]


def insert_copies(connection: Connection, table: Table, rows: Iterable[Row[Any]]) -> None:
    """Insert rows that were read by `copied_columns`, from either engine."""
    values: dict[str, Any] = {}
    for column in table.columns:
        values[column.name] = bindparam(column.name, type_=Text if isinstance(column.type, JsonText) else column.type)
        if isinstance(column.type, JsonText) and connection.dialect.name == "postgresql":
            values[column.name] = cast(values[column.name], JSON)
    if copies := [dict(row._mapping) for row in rows]:
        connection.execute(insert(table).values(values), copies)


def of_status(object_id: int, status: EnrollmentStatus) -> ColumnElement[bool]:
    """Return the condition that an enrollment of an object has a status."""
    return and_(enrollments.c.object_id == object_id, enrollments.c.status == status)


def unfinished_and_complete(connection: Connection, object_id: int) -> list[int]:
    """Return the ids of the enrollments of an object whose status can change."""
    changing = (EnrollmentStatus.COMPLETE, EnrollmentStatus.IN_PROGRESS)
    wanted = and_(enrollments.c.object_id == object_id, enrollments.c.status.in_(changing))
    return list(connection.scalars(select(enrollments.c.id).where(wanted)))


def supersede(connection: Connection, object_id: int) -> None:
    """Mark the complete enrollment of an object as superseded, if there is one."""
    connection.execute(
        update(enrollments)
        .where(of_status(object_id, EnrollmentStatus.COMPLETE))
        .values(status=EnrollmentStatus.SUPERSEDED)
    )


def abandon_unfinished(connection: Connection, object_id: int, now: datetime) -> None:
    """Mark the unfinished enrollment of an object as abandoned, if there is one."""
    connection.execute(
        update(enrollments)
        .where(of_status(object_id, EnrollmentStatus.IN_PROGRESS))
        .values(status=EnrollmentStatus.ABANDONED, finished_utc=now)
    )
