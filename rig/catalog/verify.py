"""Check whether a catalog is as it was stored. Only digests are compared: everything that is stored has one.

Decision: docs/decisions/0009.
"""

from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import Any, Final, NamedTuple

from sqlalchemy import func, or_, select

from rig.catalog import describing, digests, log
from rig.catalog.catalog import Catalog
from rig.catalog.facts import Derived, Enrollment, Entry, View
from rig.catalog.images import Images, path_of
from rig.catalog.jobs import JobProgress, portions, processes
from rig.catalog.state import State
from rig.catalog.upkeep import NAMED_IMAGES
from rig.core.errors import CatalogDamaged
from rig.core.processes import map_in_processes
from rig.views import image_files as files

_IMAGE: Final = NAMED_IMAGES.c


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
    findings, of_images, required = list[CatalogFinding](), list[CatalogFinding](), list[_RequiredImage]()
    with catalog.reading() as state:
        transaction = state.transaction
        objects = transaction.scalar(select(func.count(Enrollment.object_id.distinct()))) or 0
        views = transaction.scalar(select(func.count(View.id))) or 0
        results = transaction.scalar(select(func.max(Entry.result))) or 0
        damages = dict.fromkeys(catalog.database.damage(transaction))  # in their order, each once
        for check in (_lines, _enrollments, _derived):
            try:
                findings += check(state)
            except CatalogDamaged as damage:  # a row that cannot be read
                damages[damage.what] = None
        changed = {one.details["enrollment_id"] for one in findings if one.problem is CatalogProblem.ENROLLMENT_CHANGED}
        try:
            required = _images(state, changed)
        except CatalogDamaged as damage:
            damages[damage.what] = None
    yield JobProgress(0, len(required))
    done, work = 0, partial(_check_images, catalog.database.images)
    for portion, found in map_in_processes(work, portions(required), processes(jobs, len(required))):
        of_images += found
        yield JobProgress(done := done + len(portion), len(required))
    damaged = [CatalogFinding(CatalogProblem.DAMAGED_DATABASE, details={"message": message}) for message in damages]
    of_images.sort(key=lambda one: (one.view_id is None, one.view_id or 0, one.path))
    image_bytes = sum(image.stored_bytes for image in required)
    return CatalogVerification(objects, views, results, image_bytes, (*damaged, *findings, *of_images))


def _lines(state: State) -> Iterator[CatalogFinding]:
    for number in [*digests.damaged_lines(state.transaction, *log.head(state.transaction))]:
        name = None
        with suppress(CatalogDamaged):  # the name itself may be damaged
            name = state.transaction.scalar(select(Entry.object_name).where(Entry.id == number))
        yield CatalogFinding(CatalogProblem.LOG_CHANGED, name, details={"entry_id": number})
    log.check_complete(state.transaction)  # its error is one more finding


def _enrollments(state: State) -> Iterator[CatalogFinding]:
    for number, name in state.missing_enrollments().items():
        yield CatalogFinding(CatalogProblem.MISSING_ENROLLMENT, name, details={"enrollment_id": number})
    for number, name in state.damaged_enrollments().items():
        yield CatalogFinding(CatalogProblem.ENROLLMENT_CHANGED, name, details={"enrollment_id": number})


def _derived(state: State) -> Iterator[CatalogFinding]:
    columns = select(Derived.seal, Derived.what, Derived.made_by, Derived.content, Derived.sha256)
    rows = state.transaction.execute(columns.order_by(Derived.seal, Derived.what).execution_options(yield_per=100))
    wrong = [row[:2] for row in rows if None in row or describing.digest_of(*row[:4]) != row[4]]
    owners = {line.seal: state.objects.get(line.object_id) for line in state.statuses.values()}
    names = {seal: owner.object_name for seal, owner in owners.items() if owner is not None}
    for seal, what in sorted(wrong, key=lambda one: names.get(one[0]) or ""):
        yield CatalogFinding(CatalogProblem.DESCRIPTION_DAMAGED, names.get(seal), details={"descriptor": what})


def _images(state: State, changed: Collection[int]) -> list[_RequiredImage]:
    """Return the images of the enrollments that are not ``changed``, and of the results."""
    owners = dict(state.transaction.execute(select(Enrollment.id, Enrollment.object_id)).all())
    named = select(_IMAGE.enrollment_id, _IMAGE.view_id, _IMAGE.image, _IMAGE.image_bytes).where(
        _IMAGE.image.is_not(None), or_(_IMAGE.enrollment_id.is_(None), _IMAGE.enrollment_id.not_in(changed))
    )
    names: dict[int | None, str | None] = {}
    with suppress(CatalogDamaged):  # if a line of the log cannot be read, no image has the name of its object
        names = {number: line.object_name for number, line in state.objects.items()}
    return [
        _RequiredImage(names.get(owners.get(enrollment_id)), *image)
        for enrollment_id, *image in state.transaction.execute(named)
    ]


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
