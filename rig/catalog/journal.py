"""The journal of a bench: enrollments go into a catalog of this computer first, and are delivered to the server.

Therefore an enrollment needs no server while it takes its views. A server that answers reserves the name at the start.
Each enrollment has a key. With it the delivery (`rig.catalog.delivery`) finds out whether the server has the enrollment
already.

Decision: docs/decisions/0051.
"""

import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Self

from sqlalchemy import select

from rig.catalog.catalog import Catalog
from rig.catalog.edit import delete
from rig.catalog.enrollment import Enrollment
from rig.catalog.local_copy import open_or_copy
from rig.catalog.records import EnrollmentStatus, ObjectSummary, Provenance
from rig.catalog.schema import enrollments, objects, results, sessions
from rig.catalog.upkeep import collect_garbage
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock
from rig.core.errors import CatalogError, CatalogUnavailable
from rig.core.files import read, write

FOLDER: Final = "journal"
KEY: Final = "delivery"
"""Key of an enrollment, in the conditions of its sessions and in the log of the server."""
REPLACE: Final = "delivery_replaces"
BENCH: Final = "delivery_from"
DELIVERED: Final = "delivered-results"
"""File with the id of the last result that was delivered."""
_BENCH_ID: Final = "bench-id"


def journal_folder(place: CatalogPlace) -> Path:
    """Return the folder of the journal for a catalog on a server."""
    return place.path / FOLDER


class Journal(Catalog):
    """The journal, used as the catalog of an enrollment.

    Attributes
    ----------
    server
        Place of the catalog that gets the enrollments.
    unreachable
        The reason why the last name could not be reserved; None if it was.
    """

    server: CatalogPlace
    unreachable: CatalogUnavailable | None = None

    @classmethod
    def of(cls, server: CatalogPlace, clock: Clock) -> Self:
        """Open the journal of this computer for a catalog on a server; it is created if there is none."""
        journal = cls.open(journal_folder(server), clock=clock)
        journal.server = CatalogPlace.of(server)
        return journal

    def known_objects(self) -> list[ObjectSummary]:
        """Return the objects of the journal, and those that the server has, by its local copy if it does not answer."""
        own = self.objects()
        names = {one.name for one in own}
        try:
            with open_or_copy(self.server, self.clock, create=True) as shared:
                others = [one for one in shared.objects() if one.enrolled_utc is not None]
        except CatalogUnavailable:
            others = []
        return [*own, *(one for one in others if one.name not in names)]

    def _check_elsewhere(self, name: str, *, replace: bool) -> None:
        """Reject a name that the server has, or the local copy while the server does not answer."""
        with suppress(CatalogUnavailable), open_or_copy(self.server, self.clock, create=True) as shared:
            if shared.copied_utc is None:
                release(self, shared)
            shared.check_enrollable(name, replace=replace)

    @contextmanager
    def _reached(self) -> Iterator[Catalog]:
        """Open the catalog of the server, and release the names that this bench reserved there and did not use."""
        with Catalog.open(self.server, clock=self.clock) as server:
            release(self, server)
            yield server

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
        self._check_here(name, label, note, resume=False, replace=replace)
        more: dict[str, Any] = {KEY: secrets.token_hex(16), BENCH: bench_id(self)}
        keyed = with_conditions(provenance, {**more, REPLACE: True} if replace else more)
        try:
            with self._reached() as server:
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
        return super().resume(name, provenance=with_conditions(provenance, kept))


def waiting(place: CatalogPlace, clock: Clock) -> int:
    """Return how many objects and results of the journal wait for the server."""
    if place.url is None or not CatalogPlace(journal_folder(place)).database_file.exists():
        return 0
    with Catalog.open(journal_folder(place), clock=clock, read_only=True) as journal:
        return sum(one.enrolled_utc is not None for one in journal.objects()) + len(waiting_results(journal))


def discard(journal: Catalog, name: str) -> None:
    """Remove an object from the journal without delivering it. Errors as for `rig.catalog.edit.delete`."""
    delete(journal, name)
    collect_garbage(journal)


def with_conditions(provenance: Provenance, more: dict[str, Any]) -> Provenance:
    return replace(provenance, conditions={**provenance.conditions, **more})


def release(journal: Catalog, server: Catalog) -> None:
    """Release names that this bench reserved for enrollments that it discarded."""
    bench = bench_id(journal)
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
            try:
                server.resume(name, provenance=Provenance("", {}, conditions)).discard()
            except CatalogUnavailable:
                raise
            except CatalogError:
                continue  # another program has ended it meanwhile


def bench_id(journal: Catalog) -> str:
    """Return the id of this journal; it is made once."""
    file = journal.path / _BENCH_ID
    try:
        return read(file, max_bytes=100).decode()
    except FileNotFoundError:
        write(file, secrets.token_hex(8).encode(), mode=0o600)
        return read(file, max_bytes=100).decode()


def waiting_results(journal: Catalog) -> list[Any]:
    last = _last_result(journal)
    with journal.database.read() as connection:
        return list(connection.execute(select(results).where(results.c.id > last).order_by(results.c.id)).all())


def _last_result(journal: Catalog) -> int:
    try:
        return int(read(journal.path / DELIVERED, max_bytes=100))
    except (OSError, ValueError):
        return 0
