"""Check whether a catalog is as it was stored. Only digests are compared: everything that is stored has one.

Decision: docs/decisions/0009.
"""

from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import Any, Final, NamedTuple

from sqlalchemy import and_, func, select
from sqlalchemy.orm import Session as Transaction

from rig.catalog import describing, log, state
from rig.catalog.catalog import Catalog
from rig.catalog.facts import Derived, Enrollment, Entry, View
from rig.catalog.images import Images, path_of
from rig.catalog.jobs import JobProgress, portions, processes
from rig.catalog.state import Ended, Named
from rig.catalog.upkeep import NAMED_IMAGES
from rig.core.errors import CatalogDamaged
from rig.core.processes import map_in_processes
from rig.views import image_files as files

_ENROLLMENTS: Final = 10
"""Enrollments in a portion: few rows are in memory at once."""
_IMAGE: Final = NAMED_IMAGES.c
_OWNS: Final = and_(Named.object_id == Enrollment.object_id, state.IS_STATE)


class CatalogProblem(StrEnum):
    """Kind of a problem."""

    DAMAGED_DATABASE = "database damaged"
    LOG_CHANGED = "log changed"
    ENROLLMENT_CHANGED = "enrollment changed"
    MISSING_ENROLLMENT = "enrollment missing"
    MISSING_IMAGE = "image missing"
    CHANGED_IMAGE = "image changed"
    DESCRIPTION_DAMAGED = "description damaged"


_BACKUP: Final = "restore it from a backup"
_IMAGE_BACKUP: Final = f"{_BACKUP}, or enroll the object again"
_ENROLLMENT_BACKUP: Final = "restore the catalog from a backup, or delete the object and enroll it again"
_WORDS: Final = {
    CatalogProblem.DAMAGED_DATABASE: ("{message}", _BACKUP),
    CatalogProblem.LOG_CHANGED: ("entry {entry_id} is not the one that was written, or one before is missing", _BACKUP),
    CatalogProblem.ENROLLMENT_CHANGED: ("something in enrollment {enrollment_id} changed", _ENROLLMENT_BACKUP),
    CatalogProblem.MISSING_ENROLLMENT: ("this program did not remove enrollment {enrollment_id}", _ENROLLMENT_BACKUP),
    CatalogProblem.MISSING_IMAGE: ("{reason}", _IMAGE_BACKUP),
    CatalogProblem.CHANGED_IMAGE: ("{bytes} bytes now, {stored_bytes} when it was stored", _IMAGE_BACKUP),
    CatalogProblem.DESCRIPTION_DAMAGED: (
        "the stored {descriptor} is not the one that was computed",
        "it is computed again when it is needed",
    ),
}
"""The evidence, with the keys of `CatalogFinding.details`, and what to do."""


@dataclass(frozen=True, slots=True)
class CatalogFinding:
    """A problem of a catalog, the object and the file that it concerns, and its evidence."""

    problem: CatalogProblem
    object_name: str | None = None
    view_id: int | None = None
    path: str | None = None
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """The finding in one line: the problem, the object and the file, the evidence, and what to do."""
        place = ": ".join(filter(None, (self.object_name and repr(self.object_name), self.path)))
        evidence, fix = _WORDS[self.problem]
        return "; ".join((": ".join(filter(None, (self.problem, place))), evidence.format_map(self.details), fix))


@dataclass(frozen=True, slots=True)
class CatalogVerification:
    """Numbers of what was checked, and everything that was found."""

    objects: int
    views: int
    results: int
    image_bytes: int
    findings: tuple[CatalogFinding, ...]


class _RequiredImage(NamedTuple):
    """An image that must exist. That of a session or a result belongs to no view, that of a result to no object."""

    object_name: str | None
    view_id: int | None
    name: str
    stored_bytes: int


def verify(catalog: Catalog, *, jobs: int | None = None) -> Generator[JobProgress, None, CatalogVerification]:
    """Compare every row and every image with its digest; change nothing. ``jobs`` None is one process per core."""
    findings, of_images = list[CatalogFinding](), list[CatalogFinding]()
    with catalog.database.read() as transaction:
        objects = transaction.scalar(select(func.count(Enrollment.object_id.distinct()))) or 0
        views = transaction.scalar(select(func.count(View.id))) or 0
        results = transaction.scalar(select(func.max(Entry.result))) or 0
        images = transaction.scalar(select(func.count(_IMAGE.image))) or 0
        damages = dict.fromkeys(catalog.database.damage(transaction))  # in their order, each once
        ids = transaction.scalars(select(Enrollment.id).order_by(Enrollment.id)).all()
        checks: list[Callable[[Transaction], Iterator[CatalogFinding]]] = [_lines, _missing]
        checks += [partial(_enrollments, part) for part in portions(ids, _ENROLLMENTS)]
        for check in (*checks, _derived):
            try:
                findings += check(transaction)
            except CatalogDamaged as damage:  # a row that cannot be read
                damages[damage.what] = None
    changed = {one.details["enrollment_id"] for one in findings if one.problem is CatalogProblem.ENROLLMENT_CHANGED}
    yield JobProgress(0, images)
    done, image_bytes, work = 0, 0, partial(_check_images, catalog.database.images)
    try:
        for portion, found in map_in_processes(work, portions(_images(catalog, changed)), processes(jobs, images)):
            of_images += found
            image_bytes += sum(image.stored_bytes for image in portion)
            yield JobProgress(done := done + len(portion), images)
    except CatalogDamaged as damage:
        damages[damage.what] = None
    damaged = [CatalogFinding(CatalogProblem.DAMAGED_DATABASE, details={"message": message}) for message in damages]
    of_images.sort(key=lambda one: (one.view_id is None, one.view_id or 0, one.path))
    return CatalogVerification(objects, views, results, image_bytes, (*damaged, *findings, *of_images))


def _lines(transaction: Transaction) -> Iterator[CatalogFinding]:
    for number in log.wrong_lines(transaction):
        name = None
        with suppress(CatalogDamaged):  # the name itself may be damaged
            name = transaction.scalar(select(Entry.object_name).where(Entry.id == number))
        yield CatalogFinding(CatalogProblem.LOG_CHANGED, name, details={"entry_id": number})
    log.check_complete(transaction)  # its error is one more finding


def _missing(transaction: Transaction) -> Iterator[CatalogFinding]:
    for number, name in state.missing_enrollments(transaction).items():
        yield CatalogFinding(CatalogProblem.MISSING_ENROLLMENT, name, details={"enrollment_id": number})


def _enrollments(ids: Sequence[int], transaction: Transaction) -> Iterator[CatalogFinding]:
    for number, name in state.damaged_enrollments(transaction, ids).items():
        yield CatalogFinding(CatalogProblem.ENROLLMENT_CHANGED, name, details={"enrollment_id": number})


def _derived(transaction: Transaction) -> Iterator[CatalogFinding]:
    columns = select(Derived.seal, Derived.what, Derived.made_by, Derived.content, Derived.sha256)
    rows = transaction.execute(columns.order_by(Derived.seal, Derived.what).execution_options(yield_per=100))
    wrong = [row[:2] for row in rows if None in row or describing.digest_of(*row[:4]) != row[4]]
    owners = select(Ended.seal, Named.object_name).join(Named, Named.object_id == Ended.object_id)
    names = dict(transaction.execute(owners.where(state.IS_STATUS, state.IS_STATE)).all()) if wrong else {}
    for seal, what in sorted(wrong, key=lambda one: names.get(one[0]) or ""):
        yield CatalogFinding(CatalogProblem.DESCRIPTION_DAMAGED, names.get(seal), details={"descriptor": what})


def _images(catalog: Catalog, changed: Collection[int]) -> Iterator[_RequiredImage]:
    """Yield the images of the enrollments that are not ``changed``, and of the results."""
    with catalog.database.read() as transaction:
        ids = transaction.scalars(select(Enrollment.id).order_by(Enrollment.id)).all()
    named = select(Named.object_name, _IMAGE.view_id, _IMAGE.image, _IMAGE.image_bytes).select_from(NAMED_IMAGES)
    named = named.outerjoin(Enrollment, Enrollment.id == _IMAGE.enrollment_id).outerjoin(Named, _OWNS)
    for part in (*portions([one for one in ids if one not in changed], _ENROLLMENTS), None):
        of_these = _IMAGE.enrollment_id.is_(None) if part is None else _IMAGE.enrollment_id.in_(part)
        with catalog.database.read() as transaction:
            found = transaction.execute(named.where(of_these, _IMAGE.image.is_not(None))).all()
        yield from (_RequiredImage(*one) for one in found)


def _check_images(store: Images, portion: Sequence[_RequiredImage]) -> list[CatalogFinding]:
    findings = []
    for name, view_id, image, stored_bytes in portion:
        found = partial(CatalogFinding, object_name=name, view_id=view_id, path=path_of(image))
        try:
            content = store.read(image)
        except (OSError, CatalogDamaged) as error:
            reason = error.what if isinstance(error, CatalogDamaged) else error.strerror or str(error)
            findings.append(found(CatalogProblem.MISSING_IMAGE, details={"reason": reason}))
        else:
            if not image.startswith(files.digest(content)):
                sizes = {"bytes": len(content), "stored_bytes": stored_bytes}
                findings.append(found(CatalogProblem.CHANGED_IMAGE, details=sizes))
    return findings
