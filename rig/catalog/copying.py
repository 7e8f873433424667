"""The local copy of a catalog on a server, which searches read while the server does not answer.

It has the log without answers, the enrollments that searches use, and their descriptions.

Decision: docs/decisions/0011.
"""

import json
import shutil
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from sqlalchemy import ColumnElement, Table, delete, insert, select
from sqlalchemy.orm import Session as Transaction

from rig.catalog import log, sessions, state
from rig.catalog.catalog import Catalog
from rig.catalog.database import properties
from rig.catalog.facts import Derived, Enrollment, Entry, Property, Row, Session, View
from rig.catalog.jobs import portions
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock
from rig.core.errors import CatalogDamaged, CatalogError, CatalogUnavailable
from rig.core.files import json_values
from rig.core.next_steps import Do

_COPY: Final = "copy"
"""Property of a local copy: of which catalog, up to which line of its log, and when."""
_PATIENCE: Final = 20  # a server that is away costs one wait in twenty-one times that long
_AT_ONCE: Final = 100
"""Enrollments, and lines of the log, that are read from the server at once."""


def _copy_rows(reading: Transaction, writing: Transaction, table: type[Row], *wanted: ColumnElement[bool]) -> None:
    columns = table.__table__
    assert isinstance(columns, Table)
    for part in reading.execute(select(columns).where(*wanted)).mappings().partitions(500):
        writing.execute(insert(columns), list(map(dict, part)))


class Attempts:
    """Attempts to open catalogs, with pauses, so that the operator does not wait repeatedly for a server that is down.

    An attempt that failed after a time t is repeated after 20 t: a host that rejects a connection takes milliseconds,
    a network that drops packets takes seconds. Until then the same error is raised at once.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._not_before_ns = clock.now_ns()
        self._error: CatalogUnavailable | None = None

    def open(self, place: CatalogPlace, *, create: bool = False) -> Catalog:
        """Open a catalog, for reading only unless it is created if there is none; errors as `Catalog.open`."""
        begun_ns = self._clock.now_ns()
        if self._error is not None and begun_ns < self._not_before_ns:
            raise self._error.with_traceback(None)  # a traceback grows each time that an error is raised
        try:
            return Catalog.open(place, clock=self._clock, create=create, read_only=not create)
        except CatalogUnavailable as error:
            now_ns = self._clock.now_ns()
            self._error, self._not_before_ns = error, now_ns + _PATIENCE * (now_ns - begun_ns)
            raise


def open_copy(place: CatalogPlace, clock: Clock) -> Catalog:
    """Return the local copy, open for reading; `Catalog.copied_utc` says when it was made.

    Raises `CatalogUnavailable`: there is no copy of this catalog.
    """
    with suppress(CatalogError):
        copy = Catalog.open(place.copy_folder, clock=clock, create=False, read_only=True)
        with copy.database.read() as transaction:
            made = _copied(transaction)
        if made.get("catalog") == str(place):
            copy.copied_utc, copy.copy_of = datetime.fromisoformat(made["copied_utc"]), place
            return copy
        copy.close()
    raise CatalogUnavailable(
        f"This computer has no copy of the catalog {place}.",
        next_step="Search once while the server answers: the search makes the copy.",
    )


def open_or_copy(
    place: CatalogPlace, clock: Clock, *, create: bool = False, attempts: Attempts | None = None
) -> Catalog:
    """Return a catalog, open for reading; its local copy while its server or its store does not answer.

    With ``create`` the catalog is created if there is none, and is open for writing. ``attempts`` are those of a
    program that opens the catalog often.

    Raises `CatalogUnavailable`: there is no copy either.
    """
    try:
        return (attempts or Attempts(clock)).open(place, create=create)
    except CatalogUnavailable as error:
        try:
            return open_copy(place, clock)
        except CatalogUnavailable as missing:
            raise CatalogUnavailable(
                f"{error.what} {missing.what}",
                next_step=(*error.steps, *missing.steps),
                evidence=error.evidence,
            ) from error


def _copied(transaction: Transaction) -> dict[str, Any]:
    """Return what a local copy has: place and id of the catalog, last line of its log with its digest, and the time."""
    stored = transaction.scalar(select(Property.value).where(Property.key == _COPY))
    with suppress(ValueError, TypeError):
        return dict(json_values((stored or "").encode()))
    return {}


def update_copy(catalog: Catalog) -> bool:
    """Bring the local copy up to date; return whether anything had changed. Only what is new is read.

    A copy that is damaged, or of another catalog, is made again.

    Raises `CatalogDamaged`: the catalog is not as it was stored; the copy stays as it is. `CatalogError`,
    `CatalogBusy`: one of them cannot be used, or another program updates the copy.
    """
    folder = catalog.place.copy_folder
    try:
        changed = _update(catalog, folder)
    except CatalogDamaged:
        made = folder.with_name(f"{folder.name}.new")
        shutil.rmtree(made, ignore_errors=True)
        changed = _update(catalog, made)
        shutil.rmtree(folder, ignore_errors=True)
        made.rename(folder)
    return changed


def _update(catalog: Catalog, folder: Path) -> bool:
    with Catalog.open(folder, clock=catalog.clock) as copy:
        with catalog.database.read() as reading, copy.database.write() as writing:
            before = _copied(writing)
            line, digest = log.head(reading)
            own = {"catalog": str(catalog.place), "id": properties(reading)["id"]}
            now = {**own, "line": line, "digest": digest, "copied_utc": catalog.clock.utc().isoformat()}
            known = reading.scalar(select(Entry.digest).where(Entry.id == before.get("line"))) or ""
            if {**before, **own, "digest": known} != before and log.head(writing)[0]:
                raise CatalogDamaged("The local copy is one of another catalog.", next_step=Do.RUN_AGAIN())
            _copy_log(reading, writing, after=before.get("line", 0))
            _copy_enrollments(reading, writing)
            _copy_derived(reading, writing)
            writing.merge(Property(key=_COPY, value=json.dumps(now)))
        newest = sessions.empty_tables(copy).newest
        store = copy.database.images
        with copy.database.catalog_errors():
            if newest is not None and not store.size(newest):
                with suppress(CatalogError):  # rig catalog verify reports it
                    store.put(catalog.database.images.content(newest))
            store.remove(store.names() - {newest})
    return bool(before.get("line") != line)


def _copy_log(reading: Transaction, writing: Transaction, *, after: int) -> None:
    """Add the new lines of the catalog's log to that of the copy, without answers: so it has the same state."""
    new = select(Entry).where(Entry.result.is_(None)).order_by(Entry.id).limit(_AT_ONCE)
    while part := reading.scalars(new.where(Entry.id > after)).all():
        state.check_lines(reading, [one.id for one in part])
        log.add(writing, *map(log.same, part))
        after = part[-1].id
        reading.expunge_all()


def _copy_enrollments(reading: Transaction, writing: Transaction) -> None:
    """Copy the rows of the enrollments that searches use, with their ids, and remove the others."""
    used = {one.enrollment_id for one in state.used(reading)}
    known = set(writing.scalars(select(Enrollment.id)))
    owners: tuple[tuple[type[Row], Any], ...] = (
        (Enrollment, Enrollment.id),
        (Session, Session.enrollment_id),
        (View, View.enrollment_id),
    )
    for part in portions(sorted(known - used), _AT_ONCE):
        for table, owner in reversed(owners):
            writing.execute(delete(table).where(owner.in_(part)))
    for part in portions(sorted(used - known), _AT_ONCE):
        for table, owner in owners:
            _copy_rows(reading, writing, table, owner.in_(part))


def _copy_derived(reading: Transaction, writing: Transaction) -> None:
    """Copy what is computed from these enrollments, if it is new or another program has computed it again."""
    used = {one.seal for one in state.used(writing)}
    columns = select(Derived.seal, Derived.what, Derived.made_by, Derived.sha256)
    there = {tuple(row) for row in reading.execute(columns) if row.seal in used}
    here = {tuple(row) for row in writing.execute(columns)}
    for part in portions(sorted({str(row[0]) for row in there ^ here}), _AT_ONCE):
        writing.execute(delete(Derived).where(Derived.seal.in_(part)))
        _copy_rows(reading, writing, Derived, Derived.seal.in_(used.intersection(part)))
