"""The journal of a bench: enrollments go into a catalog of this computer first, and are delivered to the server.

So an enrollment needs no server while it takes its views. A server that answers reserves the name at the start. Each
enrollment has a key; the server stores it with the delivery, in the transaction of the delivery, so that nothing is
delivered twice. What cannot be delivered because of its name stays in the journal until a person decides.

Decision: docs/decisions/0052.
"""

import secrets
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Self

from sqlalchemy import Connection, insert, select

from rig.catalog import audit
from rig.catalog.catalog import Catalog
from rig.catalog.database import given_id, insert_row
from rig.catalog.edit import delete
from rig.catalog.enrollment import Enrollment
from rig.catalog.queries import in_use
from rig.catalog.records import (
    EnrollmentStatus,
    EnrollmentSummary,
    ImageFile,
    ObjectDetails,
    PackedDescriptor,
    Provenance,
)
from rig.catalog.rows import (
    NewView,
    abandon_unfinished,
    empty_table_columns,
    insert_views,
    measured,
    supersede,
    unfinished_and_complete,
)
from rig.catalog.schema import audit as log
from rig.catalog.schema import descriptors, enrollments, objects, results, sessions, views
from rig.catalog.seal import changing_enrollments, seal_appended, seal_enrollments, seal_objects
from rig.catalog.upkeep import collect_garbage
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock
from rig.core.errors import CatalogUnavailable, ObjectExists, RigError
from rig.core.files import read, write
from rig.views import image_files as images

FOLDER: Final = "journal"
KEY: Final = "delivery"
"""Key of an enrollment, in the conditions of its sessions and in the log of the server."""
REPLACE: Final = "delivery_replaces"
BENCH: Final = "delivery_from"
_DELIVERED: Final = "delivered-results"
_BENCH_ID: Final = "bench-id"


@dataclass(frozen=True, slots=True)
class Delivery:
    """What became of an object of the journal: ``conflict`` is None if the server has it now."""

    name: str
    views: int
    conflict: RigError | None = None


def journal_folder(place: CatalogPlace) -> Path:
    """Return the folder of the journal for a catalog on a server."""
    return place.path / FOLDER


class Journal(Catalog):
    """The journal, used as the catalog of an enrollment.

    Attributes
    ----------
    server
        Where the catalog is that gets the enrollments.
    unreachable
        Why the last name could not be reserved; None if it was.
    """

    server: CatalogPlace
    unreachable: CatalogUnavailable | None = None

    @classmethod
    def of(cls, server: CatalogPlace, clock: Clock) -> Self:
        """Open the journal of this computer for a catalog on a server; it is created if there is none."""
        journal = cls.open(journal_folder(server), clock=clock)
        journal.server = CatalogPlace.of(server)
        return journal

    def begin(
        self,
        name: str,
        *,
        planned_azimuth_deg: Sequence[float],
        provenance: Provenance,
        label: str | None = None,
        note: str | None = None,
        replace: bool = False,
    ) -> Enrollment:
        """Start to enroll an object; reserve its name if the server answers. Errors as for `Catalog.begin`."""
        options = {"planned_azimuth_deg": planned_azimuth_deg, "label": label, "note": note}
        super().check_enrollable(name, label=label, note=note, replace=replace)
        more: dict[str, Any] = {KEY: secrets.token_hex(16), BENCH: _bench_id(self)}
        keyed = _with_conditions(provenance, {**more, REPLACE: True} if replace else more)
        try:
            with Catalog.open(self.server, clock=self.clock) as server:
                server.begin(name, provenance=keyed, replace=replace, **options)  # type: ignore[arg-type]
            self.unreachable = None
        except CatalogUnavailable as error:
            self.unreachable = error
        return super().begin(name, provenance=keyed, replace=replace, **options)  # type: ignore[arg-type]

    def resume(self, name: str, *, provenance: Provenance) -> Enrollment:
        """Continue an unfinished enrollment of the journal. Errors as for `Catalog.resume`."""
        unfinished = self.resumable(name)
        before = unfinished.sessions[0].provenance.conditions if unfinished is not None else {}
        kept = {name: before[name] for name in (KEY, BENCH, REPLACE) if name in before}
        return super().resume(name, provenance=_with_conditions(provenance, kept))


def waiting(place: CatalogPlace, clock: Clock) -> int:
    """Return how many objects and results of the journal wait for the server."""
    if place.url is None or not CatalogPlace(journal_folder(place)).database_file.exists():
        return 0
    with Catalog.open(journal_folder(place), clock=clock, read_only=True) as journal:
        return sum(one.enrolled_utc is not None for one in journal.objects()) + len(_results(journal))


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
    """
    done = []
    for summary in journal.objects():
        if summary.enrolled_utc is None:
            continue
        item = journal.object(summary.name)
        try:
            _deliver(journal, server, item, replaces=summary.name in replacing)
        except ObjectExists as error:
            done.append(Delivery(summary.name, summary.views, error))
            continue
        delete(journal, summary.name)
        done.append(Delivery(summary.name, summary.views))
    if any(one.conflict is None for one in done):
        collect_garbage(journal)
    _deliver_results(journal, server)
    _release(journal, server)
    return done


def discard(journal: Catalog, name: str) -> None:
    """Remove an object from the journal without delivering it. Errors as for `rig.catalog.edit.delete`."""
    delete(journal, name)
    collect_garbage(journal)


def _with_conditions(provenance: Provenance, more: dict[str, Any]) -> Provenance:
    return replace(provenance, conditions={**provenance.conditions, **more})


def _complete(item: ObjectDetails) -> EnrollmentSummary:
    return next(one for one in item.enrollments if one.status is EnrollmentStatus.COMPLETE)


def _delivered(connection: Connection, key: str) -> bool:
    found = select(log.c.id).where(log.c.action == audit.Action.ENROLLED, log.c.details[KEY].as_string() == key)
    return connection.execute(found.limit(1)).first() is not None


def _deliver(journal: Catalog, server: Catalog, item: ObjectDetails, *, replaces: bool) -> None:
    """Deliver one object; an `ObjectExists` if another object of the server has its name."""
    enrollment = _complete(item)
    key = str(enrollment.sessions[0].provenance.conditions[KEY])
    replaces = replaces or bool(enrollment.sessions[0].provenance.conditions.get(REPLACE))
    with server.database.read() as connection:
        if _delivered(connection, key):
            return
        _check_name(connection, item.summary.name, key, replaces)
    # The images first: their names have the key, so that a second attempt writes the same files.
    moved = {name: _send(journal, server, key, name) for name in _image_names(item, enrollment)}
    with journal.database.read() as reading:
        packed = _packed(reading, enrollment.id)
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


def _image_names(item: ObjectDetails, enrollment: EnrollmentSummary) -> list[str]:
    tables = [one.empty_table_image for one in enrollment.sessions if one.empty_table_image is not None]
    return [*(view.image for view in item.views), *tables]


def _send(journal: Catalog, server: Catalog, key: str, name: str) -> ImageFile:
    with journal.database.catalog_errors():
        content = journal.database.images.read(name)
    target = f"{images.IMAGE_FOLDER}/delivered-{key}/{Path(name).name}"
    with server.database.catalog_errors():
        server.database.images.write(target, content)
    return ImageFile(target, images.digest(content), len(content))


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
            f"the journal has {name!r}, and the catalog has another object of that name; nothing is lost",
            next_step=f"choose: rig catalog deliver --rename {name} NEW-NAME, --replace {name}, or --discard {name}",
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
        provenance = _with_conditions(one.provenance, {KEY: key})
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


def _release(journal: Catalog, server: Catalog) -> None:
    """Release names that this bench reserved for enrollments that it discarded."""
    bench = _bench_id(journal)
    with journal.database.read() as connection:
        kept = {row.get(KEY) for row in connection.scalars(select(sessions.c.conditions))}
    with server.database.read() as connection:
        found = connection.execute(
            select(objects.c.name, sessions.c.conditions)
            .select_from(objects)
            .join(enrollments)
            .join(sessions, sessions.c.enrollment_id == enrollments.c.id)
            .where(enrollments.c.status == EnrollmentStatus.IN_PROGRESS, objects.c.deleted_utc.is_(None))
        ).all()
    for name, conditions in found:
        if conditions.get(BENCH) == bench and conditions.get(KEY) not in kept:
            server.resume(name, provenance=Provenance("", {}, conditions)).discard()


def _bench_id(journal: Catalog) -> str:
    """Return the id of this journal; it is made once."""
    file = journal.path / _BENCH_ID
    try:
        return read(file, max_bytes=100).decode()
    except FileNotFoundError:
        write(file, secrets.token_hex(8).encode(), mode=0o600)
        return read(file, max_bytes=100).decode()


def _results(journal: Catalog) -> list[Any]:
    last = _last_result(journal)
    with journal.database.read() as connection:
        return list(connection.execute(select(results).where(results.c.id > last).order_by(results.c.id)).all())


def _last_result(journal: Catalog) -> int:
    try:
        return int(read(journal.path / _DELIVERED, max_bytes=100))
    except (OSError, ValueError):
        return 0


def _deliver_results(journal: Catalog, server: Catalog) -> None:
    """Deliver the answers that were recorded without the server, each exactly once."""
    for row in _results(journal):
        key = f"{_bench_id(journal)}-{row.id}"
        image = None if row.image is None else _send(journal, server, f"result-{key}", row.image)
        with server.database.write() as connection:
            known = select(results.c.id).where(results.c.answer[KEY].as_string() == key).limit(1)
            if connection.execute(known).first() is None:
                values = dict(row._mapping) | {"answer": {**row.answer, KEY: key}, "digest": None}
                values["image"] = None if image is None else image.path
                del values["id"]
                connection.execute(insert(results).values(values | given_id(connection, results)))
                seal_appended(connection, results)
        write(journal.path / _DELIVERED, str(row.id).encode(), mode=0o600)
