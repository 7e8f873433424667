"""Deliver the journal of a bench to the server, each object and each answer exactly once.

The server stores the key of an enrollment in its log, in the transaction of the delivery, so that nothing is delivered
twice. If the name of an object is taken, the object stays in the journal until the operator decides.

Decision: docs/decisions/0051.
"""

import fcntl
import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sqlalchemy import Connection, insert, select

from rig.catalog import audit
from rig.catalog.catalog import Catalog
from rig.catalog.database import given_id, insert_row
from rig.catalog.edit import delete_in
from rig.catalog.journal import DELIVERED, KEY, REPLACE, bench_id, release, waiting_results, with_conditions
from rig.catalog.queries import find, in_use
from rig.catalog.records import EnrollmentStatus, EnrollmentSummary, ImageFile, ObjectDetails, PackedDescriptor
from rig.catalog.rows import (
    NewView,
    abandon_unfinished,
    empty_table_columns,
    insert_views,
    measured,
    of_status,
    supersede,
    unfinished_and_complete,
)
from rig.catalog.schema import audit as log
from rig.catalog.schema import descriptors, enrollments, objects, results, sessions, views
from rig.catalog.seal import changing_enrollments, seal_appended, seal_enrollments, seal_objects
from rig.catalog.upkeep import collect_garbage
from rig.core.errors import CatalogBusy, CatalogDamaged, ObjectExists, RigError
from rig.core.files import no_follow, write
from rig.core.next_steps import Do
from rig.views import image_files as images

_LOCK: Final = "delivering"


@dataclass(frozen=True, slots=True)
class Delivery:
    """The outcome for an object of the journal: ``conflict`` is None if the server has it now."""

    name: str
    views: int
    conflict: RigError | None = None


def deliver(journal: Catalog, server: Catalog, *, replacing: Collection[str] = ()) -> list[Delivery]:
    """Deliver the complete enrollments and the results of the journal, each exactly once.

    A call that is killed at any point is continued by the next one.

    Parameters
    ----------
    replacing
        Names of objects that replace those of the server.

    Raises
    ------
    CatalogUnavailable
        The server stopped answering; what was not delivered stays in the journal.
    CatalogBusy
        Another program delivers this journal.
    """
    with _only_delivery(journal):
        return _deliver_all(journal, server, replacing)


@contextmanager
def _only_delivery(journal: Catalog) -> Iterator[None]:
    """Prevent a delivery of the journal by another program: each would remove objects that the other one reads."""
    lock = no_follow(str(journal.path / _LOCK), os.O_RDWR | os.O_CREAT, mode=0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the system releases it when the process ends
    except BlockingIOError as error:
        raise CatalogBusy("Another program delivers the journal now.", next_step="Try again later.") from error
    else:
        yield
    finally:
        os.close(lock)


def _deliver_all(journal: Catalog, server: Catalog, replacing: Collection[str]) -> list[Delivery]:
    done = []
    for summary in journal.objects():
        if summary.enrolled_utc is None:
            continue
        try:
            _deliver(journal, server, summary.name, replaces=summary.name in replacing)
            _forget(journal, summary.name)
        except (ObjectExists, CatalogDamaged) as error:
            done.append(Delivery(summary.name, summary.views, error))
            continue
        done.append(Delivery(summary.name, summary.views))
    if any(one.conflict is None for one in done):
        collect_garbage(journal)
    _deliver_results(journal, server)
    release(journal, server)
    return done


def _forget(journal: Catalog, name: str) -> None:
    """Remove a delivered object from the journal, unless it is being enrolled again: the next delivery removes it."""
    with journal.database.write() as connection:
        object_id, name = find(connection, name)
        unfinished = select(enrollments.c.id).where(of_status(object_id, EnrollmentStatus.IN_PROGRESS))
        if connection.execute(unfinished).first() is None:
            delete_in(connection, journal, name)


def _complete(item: ObjectDetails) -> EnrollmentSummary:
    return next(one for one in item.enrollments if one.status is EnrollmentStatus.COMPLETE)


def _delivered(connection: Connection, key: str) -> bool:
    found = select(log.c.id).where(log.c.action == audit.Action.ENROLLED, log.c.details[KEY].as_string() == key)
    return connection.execute(found.limit(1)).first() is not None


def _deliver(journal: Catalog, server: Catalog, name: str, *, replaces: bool) -> None:
    """Deliver one object; an `ObjectExists` if another object of the server has its name.

    A `CatalogDamaged` if a row or an image is not as the journal stored it.
    """
    if (damage := journal.damage(name)) is not None:
        raise damage
    item = journal.object(name)
    enrollment = _complete(item)
    key = str(enrollment.sessions[0].provenance.conditions[KEY])
    replaces = replaces or bool(enrollment.sessions[0].provenance.conditions.get(REPLACE))
    with server.database.read() as connection:
        if _delivered(connection, key):
            return
        _check_name(connection, item.summary.name, key, replaces)
    # The images first: their names have the key, so that a second attempt writes the same files.
    with journal.database.read() as reading:
        packed = _packed(reading, enrollment.id)
        stored = _images(reading, enrollment.id)
    for image, sha256 in stored.items():  # check all images before the first is sent
        _checked(journal, image, sha256)
    moved = {image: _send(journal, server, key, image, sha256) for image, sha256 in stored.items()}
    with server.database.write() as connection:
        if _delivered(connection, key):
            return
        enrollment_id = _place_for(connection, server, item, enrollment, key, replaces)
        session_ids = _insert_sessions(connection, enrollment_id, enrollment, key, moved)
        new = [
            NewView(
                view.record.index,
                measured(view.record),
                session_ids[view.session.id],
                view.captured_utc,
                moved[view.image],
                packed[view.record.index],
            )
            for view in item.views
        ]
        insert_views(connection, enrollment_id, new)
        seal_enrollments(connection, [enrollment_id])
        audit.append(
            connection,
            server.clock,
            audit.Action.ENROLLED,
            item.summary.name,
            **{"enrollment_id": enrollment_id, "views": len(new), KEY: key},
        )


def _images(connection: Connection, enrollment_id: int) -> dict[str, str]:
    """Return the names of the images of an enrollment with their SHA-256."""
    own = select(views.c.image, views.c.image_sha256).where(views.c.enrollment_id == enrollment_id)
    tables = select(sessions.c.empty_table_image, sessions.c.empty_table_image_sha256).where(
        sessions.c.enrollment_id == enrollment_id, sessions.c.empty_table_image.is_not(None)
    )
    return {row[0]: row[1] for row in (*connection.execute(own), *connection.execute(tables))}


def _sent_name(key: str, name: str) -> str:
    return f"{images.IMAGE_FOLDER}/delivered-{key}/{Path(name).name}"


def _send(journal: Catalog, server: Catalog, key: str, name: str, sha256: str) -> ImageFile:
    """Copy an image to the server; errors as for `_checked`."""
    content = _checked(journal, name, sha256)
    with server.database.catalog_errors():
        server.database.images.write(_sent_name(key, name), content)
    return ImageFile(_sent_name(key, name), sha256, len(content))


def _checked(journal: Catalog, name: str, sha256: str) -> bytes:
    """Return the bytes of an image; a `CatalogDamaged` if it is not the one that was stored."""
    content = _content(journal, name)
    if content is None or images.digest(content) != sha256:
        raise CatalogDamaged(
            f"The image {journal.database.images.where(name)} of the journal is not the one that was stored.",
            next_step=("Restore it from a backup, or", Do.DISCARD(), "Then enroll the object again."),
        )
    return content


def _content(journal: Catalog, name: str) -> bytes | None:
    with journal.database.catalog_errors(), suppress(FileNotFoundError):
        return journal.database.images.read(name)
    return None


def _packed(connection: Connection, enrollment_id: int) -> dict[int, list[PackedDescriptor]]:
    found: dict[int, list[PackedDescriptor]] = {}
    rows = select(views.c.view_index, *(column for column in descriptors.c if column.name != "view_id"))
    for index, *columns in connection.execute(
        rows.join(descriptors, descriptors.c.view_id == views.c.id).where(views.c.enrollment_id == enrollment_id)
    ):
        found.setdefault(index, []).append(PackedDescriptor(*columns))
    return found


def _reserved(connection: Connection, object_id: int, key: str) -> int | None:
    """Return the unfinished enrollment that reserves the name of an object for this key."""
    found = connection.execute(
        select(enrollments.c.id, sessions.c.conditions)
        .join(sessions, sessions.c.enrollment_id == enrollments.c.id)
        .where(enrollments.c.object_id == object_id, enrollments.c.status == EnrollmentStatus.IN_PROGRESS)
    )
    return next((row.id for row in found if row.conditions.get(KEY) == key), None)


def _check_name(connection: Connection, name: str, key: str, replaces: bool) -> int | None:
    """Return the object of a name, None if there is none; an `ObjectExists` if it belongs to others."""
    object_id: int | None = connection.scalar(select(objects.c.id).where(in_use(name)))
    if object_id is None or replaces or _reserved(connection, object_id, key) is not None:
        return object_id
    statuses = set(connection.scalars(select(enrollments.c.status).where(enrollments.c.object_id == object_id)))
    if statuses & {EnrollmentStatus.COMPLETE, EnrollmentStatus.IN_PROGRESS}:
        raise ObjectExists(
            f"The journal has {name!r}, and the catalog has another object of that name. Nothing is lost.",
            next_step=(
                Do.DELIVER_RENAMED(name=name),
                "Or",
                Do.DELIVER_REPLACING(name=name),
                "Or",
                Do.DISCARD(name=name),
            ),
        )
    return object_id


def _place_for(
    connection: Connection,
    server: Catalog,
    item: ObjectDetails,
    enrollment: EnrollmentSummary,
    key: str,
    replaces: bool,
) -> int:
    """Return the id of the complete enrollment that gets the views."""
    summary = item.summary
    object_id = _check_name(connection, summary.name, key, replaces)
    columns: dict[str, Any] = {
        "status": EnrollmentStatus.COMPLETE,
        "started_utc": enrollment.started_utc,
        "finished_utc": enrollment.finished_utc,
        "planned_azimuth_deg": enrollment.planned_azimuth_deg,
    }
    if object_id is None:
        texts = {"name": summary.name, "label": summary.label, "note": summary.note}
        object_id = insert_row(connection, objects, **texts, created_utc=summary.created_utc)
        seal_objects(connection, [object_id])
    with changing_enrollments(connection, unfinished_and_complete(connection, object_id)):
        supersede(connection, object_id)
        abandon_unfinished(connection, object_id, server.clock.utc())  # the reservation
    return insert_row(connection, enrollments, object_id=object_id, **columns)


def _insert_sessions(
    connection: Connection, enrollment_id: int, enrollment: EnrollmentSummary, key: str, moved: dict[str, ImageFile]
) -> dict[int, int]:
    ids = {}
    for one in enrollment.sessions:
        provenance = with_conditions(one.provenance, {KEY: key})
        image = None if one.empty_table_image is None else moved[one.empty_table_image]
        ids[one.id] = insert_row(
            connection,
            sessions,
            enrollment_id=enrollment_id,
            started_utc=one.started_utc,
            bench=provenance.bench,
            software=provenance.software,
            devices=provenance.devices,
            conditions=provenance.conditions,
            **empty_table_columns(image),
        )
    return ids


def _deliver_results(journal: Catalog, server: Catalog) -> None:
    """Deliver the answers that were recorded without the server, each exactly once."""
    for row in waiting_results(journal):
        key = f"{bench_id(journal)}-{row.id}"
        image = None
        if row.image is not None:
            # A damaged image is delivered with the right digest, so that rig catalog verify reports it there.
            image = _sent_name(f"result-{key}", row.image)
            if (content := _content(journal, row.image)) is not None:
                with server.database.catalog_errors():
                    server.database.images.write(image, content)
        with server.database.write() as connection:
            known = select(results.c.id).where(results.c.answer[KEY].as_string() == key).limit(1)
            if connection.execute(known).first() is None:
                values = dict(row._mapping) | {"answer": {**row.answer, KEY: key}, "digest": None}
                values["image"] = image
                del values["id"]
                connection.execute(insert(results).values(values | given_id(connection, results)))
                seal_appended(connection, results)
        write(journal.path / DELIVERED, str(row.id).encode(), mode=0o600)
