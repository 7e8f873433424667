"""Copy a whole catalog to another place, between SQLite and PostgreSQL, and check the copy by its digests.

Every row keeps its id and its digest. The rows are copied in one transaction, after the images.
"""

from collections.abc import Generator
from typing import NamedTuple

from sqlalchemy import func, insert, select, text, update
from sqlalchemy.orm import Session as Transaction

from rig.catalog import log, state
from rig.catalog.catalog import Catalog
from rig.catalog.columns import damaged
from rig.catalog.facts import Action, Derived, Enrollment, Entry, Property, Session, View
from rig.catalog.jobs import JobProgress
from rig.catalog.upkeep import NAMED_IMAGES
from rig.core.errors import CatalogError
from rig.core.next_steps import Do


class Copied(NamedTuple):
    """What was copied."""

    objects: int
    views: int
    results: int
    images: int
    image_bytes: int


def copy_catalog(source: Catalog, target: Catalog) -> Generator[JobProgress, None, Copied]:
    """Copy everything from a catalog into an empty one. The target stays empty if the call does not end.

    Every row keeps its id and its digest. An interrupted copy can be repeated.

    Raises
    ------
    CatalogError, CatalogBusy
        The target is not empty, or one of them cannot be used.
    CatalogDamaged
        Something in the source is not as it was stored.
    """
    with source.database.read() as reading:
        _check_all(reading)
        with target.database.read() as transaction:
            _check_empty(transaction, target)
        size = 0
        wanted = sorted(_images(reading))
        for done, name in enumerate(wanted):
            if done % 50 == 0:
                yield JobProgress(done, len(wanted))
            with source.database.catalog_errors():
                content = source.database.images.content(name)
            size += len(content)
            with target.database.catalog_errors():
                target.database.images.put(content, settled=False)
        yield JobProgress(len(wanted), len(wanted))
        with target.database.catalog_errors():
            target.database.images.settle(wanted)
        with target.database.write() as writing:
            _check_empty(writing, target)
            for table in (Entry, Enrollment, Session, View, Derived):
                for part in reading.execute(select(table.__table__)).mappings().partitions(500):
                    writing.execute(insert(table.__table__), list(map(dict, part)))  # type: ignore[arg-type]
            head = reading.scalar(select(Property.value).where(Property.key == "head"))
            writing.execute(update(Property).where(Property.key == "head").values(value=head))
            _set_last_ids(writing)
            _check_all(writing)
            results = writing.scalar(select(func.count()).where(Entry.action == Action.IDENTIFIED)) or 0
        objects = len(target.objects())
        views = reading.scalar(select(func.count()).select_from(View)) or 0
    copied = Copied(objects, views, results, len(wanted), size)
    target.note(Action.COPIED, origin=str(source.place), **copied._asdict())
    return copied


def _check_all(transaction: Transaction) -> None:
    """Raise `CatalogDamaged` if a line of the log or a row of an enrollment is not as it was written."""
    state.check(transaction)
    wrong = next(log.wrong_lines(transaction), None)
    if wrong is not None:
        raise damaged("its log", f"wrong at line {wrong}")


def _check_empty(transaction: Transaction, target: Catalog) -> None:
    if log.head(transaction)[0] or transaction.scalar(select(Enrollment.id).limit(1)) is not None:
        raise CatalogError(
            f"The catalog {target.place} is not empty.",
            next_step=("Give a new place, or", Do.MERGE()),
        )


def _images(transaction: Transaction) -> set[str]:
    """Return the names of all images that rows or answers name."""
    return {image for image in transaction.scalars(select(NAMED_IMAGES.c.image)) if image is not None}


def _set_last_ids(transaction: Transaction) -> None:
    """Let the next enrollment and the next view have new ids: an id that was given once must not be given again."""
    enrollment = transaction.scalar(select(func.max(Entry.enrollment_id))) or 0
    for table, last in (("enrollments", enrollment), ("views", transaction.scalar(select(func.max(View.id))) or 0)):
        values = {"name": table, "last": last}
        if last and transaction.get_bind().dialect.name == "postgresql":
            transaction.execute(text(f"SELECT setval('{table}_id_seq', :last)"), values)
        elif last:
            transaction.execute(text("DELETE FROM sqlite_sequence WHERE name = :name"), values)
            transaction.execute(text("INSERT INTO sqlite_sequence (name, seq) VALUES (:name, :last)"), values)
