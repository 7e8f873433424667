"""The final removal of deleted data from a catalog.

Decision: docs/decisions/0009.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

from sqlalchemy import delete, func, null, select, union_all
from sqlalchemy.orm import Session as Transaction

from rig.catalog.catalog import Catalog
from rig.catalog.facts import Action, Derived, Enrollment, Entry, Session, View
from rig.catalog.jobs import portions
from rig.catalog.records import EnrollmentStatus
from rig.catalog.state import COLLECTED, ObjectLine, State
from rig.core.errors import CatalogBusy
from rig.core.next_steps import Do

_AT_ONCE: Final = 200
"""Images that are removed in one transaction: other benches wait for it."""

YOUNG_S: Final = 86_400
"""An image that no row names is kept for this time: another process may be about to name it."""

_OLD: Final = (EnrollmentStatus.SUPERSEDED, EnrollmentStatus.ABANDONED)


@dataclass(frozen=True, slots=True)
class GarbageReport:
    """What `collect_garbage` removed."""

    objects: tuple[str, ...]
    enrollments: int
    views: int
    files: int
    bytes: int


def collect_garbage(catalog: Catalog, *, old: bool = False, dry_run: bool = False) -> GarbageReport:
    """Remove deleted objects, and images that no row names any more.

    The rows are removed first, in one transaction. After a crash the next call removes the images. An image that never
    had a row, for example after a crash or by an interrupted import, is kept for `YOUNG_S`.

    ``old`` also removes the superseded and abandoned enrollments of objects in use. ``dry_run`` changes nothing.
    """
    database, store = catalog.database, catalog.database.images
    # An object store may need minutes: its files are listed outside of a transaction, so that no bench waits. They are
    # listed before the rows: an image whose row is committed in the meantime is named.
    with database.catalog_errors():
        listed = store.names(before_s=catalog.clock.utc().timestamp() - YOUNG_S)
    with catalog.reading() as state:
        unused = _unused(state, old=old)
        images = state.transaction.execute(select(NAMED_IMAGES)).all()
    ids = unused.keys()
    deleted = tuple({owner.id: str(owner.object_name) for owner in unused.values() if owner.deleted}.values())
    named = {row.image for row in images if row.enrollment_id not in ids}
    lost = (listed | {row.image for row in images if row.enrollment_id in ids}) - named
    with database.catalog_errors():
        # a program that is killed as it begins to write leaves an empty file
        sizes = {name: size for name in sorted(lost) if (size := store.size(name)) or name in listed}
    views = sum(row.view_id is not None for row in images if row.enrollment_id in ids)
    collected = GarbageReport(deleted, len(ids), views, len(sizes), sum(sizes.values()))
    if dry_run or not (ids or sizes):
        return collected
    with catalog.writing() as state:
        if not ids <= _unused(state, old=old).keys():
            raise CatalogBusy(
                "Another process restored a deleted object meanwhile. Nothing was removed.", next_step=Do.RUN_AGAIN()
            )
        _remove_rows(state.transaction, ids)
        state.append(
            Action.GARBAGE_COLLECTED,
            details={
                "objects": list(deleted),
                "enrollments": len(ids),
                "views": views,
                "freed_bytes": collected.bytes,
            },
            record={COLLECTED: sorted(ids)},
        )
    # What another process names meanwhile stays. One that names an image later looks for it, and stores it again.
    for part in portions(sorted(sizes), _AT_ONCE):
        with database.write() as transaction:
            kept = transaction.scalars(select(NAMED_IMAGES.c.image).where(NAMED_IMAGES.c.image.in_(part)))
            store.remove(set(part) - set(kept))
    return collected


NAMED_IMAGES: Final = union_all(
    select(View.enrollment_id, View.id.label("view_id"), View.image, View.image_bytes),
    select(Session.enrollment_id, null(), Session.empty_table, func.coalesce(Session.empty_table_bytes, 0)).where(
        Session.empty_table.is_not(None)
    ),
    select(
        null(),
        null(),
        Entry.record["image"].as_string(),
        func.coalesce(Entry.record["image_bytes"].as_integer(), 0),
    ).where(Entry.action == Action.IDENTIFIED),
).subquery()
"""Every image that a row names, with its enrollment, view and size. A result may have none."""


def _unused(state: State, *, old: bool) -> dict[int, ObjectLine]:
    """Return the states of the objects of enrollments that can be removed, by the ids of the enrollments."""
    unused = {}
    rows = select(Enrollment.id, Enrollment.object_id).order_by(Enrollment.object_id)
    for number, object_id in state.transaction.execute(rows):
        owner, ended = state.objects.get(object_id), state.statuses.get(number)
        if owner and ended and (owner.deleted or (old and ended.status in _OLD)):
            unused[number] = owner
    return unused


def _remove_rows(transaction: Transaction, ids: Collection[int]) -> None:
    """Remove enrollments, and what was computed from enrollments that are no longer there."""
    for part in portions(sorted(ids), 500):
        for table in (View, Session):
            transaction.execute(delete(table).where(table.enrollment_id.in_(part)))
        transaction.execute(delete(Enrollment).where(Enrollment.id.in_(part)))
    present = select(Entry.seal).join(Enrollment, Enrollment.id == Entry.enrollment_id)
    transaction.execute(delete(Derived).where(Derived.seal.not_in(present.where(Entry.seal.is_not(None)))))
