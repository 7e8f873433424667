"""Check whether a catalog is as it was stored: the log, the enrollments, the images, and what is computed from them."""

from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from hashlib import sha256
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import and_, func, select
from sqlalchemy.orm import Session as Transaction
from sqlalchemy.orm import selectinload

from rig.catalog import derived, describing, digests, log, state
from rig.catalog.catalog import Catalog
from rig.catalog.enrolling import MOST_HELD_BYTES
from rig.catalog.facts import Action, Enrollment, Entry, Session, View
from rig.catalog.images import Images, path_of
from rig.catalog.jobs import PORTION, JobProgress, processes
from rig.catalog.unfinished import UnfinishedJob
from rig.catalog.upkeep import COLLECTED
from rig.core.errors import CatalogDamaged, CatalogError
from rig.core.processes import Jobs, map_in_processes
from rig.views import image_files as files

_AT_ONCE: Final = 20
"""Enrollments whose rows are read at once."""


class Problem(StrEnum):
    """Kind of a problem, with the keys of `Finding.details`."""

    DAMAGED_DATABASE = "database damaged"
    """``message`` of the database, or of the program that cannot read a row."""
    LOG_CHANGED = "log changed"
    """Entry ``entry_id`` of the log is not the one that was written, or entries before it are missing."""
    ENROLLMENT_CHANGED = "enrollment changed"
    """A value or a view of ``enrollment_id`` is not the stored one, or the log does not know the enrollment."""
    MISSING_ENROLLMENT = "enrollment missing"
    """``enrollment_id`` is in the log, and was not removed by this program."""
    MISSING_IMAGE = "image missing"
    """``reason`` of the system."""
    CHANGED_IMAGE = "image changed"
    """``bytes`` found and ``stored_bytes``."""
    UNREADABLE_IMAGE = "image unreadable"
    """``reason`` of the decoder."""
    SIZES_DIFFER = "sizes differ"
    """``size_px`` of the image and of the first view of its enrollment, ``first_size_px``."""
    DESCRIPTION_DAMAGED = "description damaged"
    """The stored ``descriptor`` is not used, because its digest is wrong."""
    DESCRIPTION_DIFFERS = "description differs"
    """The stored ``descriptor`` is not that of the images."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A problem of a catalog, the object and the file that it concerns, and its evidence."""

    problem: Problem
    object_name: str | None = None
    view_id: int | None = None
    path: str | None = None
    details: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Verification:
    """Numbers of what was checked, and everything that was found."""

    objects: int
    views: int
    results: int
    image_bytes: int
    findings: tuple[Finding, ...]


class _Image(NamedTuple):
    """An image that must exist; the empty-table image of a session and the image of a result belong to no view."""

    name: str
    stored_bytes: int
    view_id: int | None = None


class _Group(NamedTuple):
    """What is checked at once: the images of an enrollment with its descriptions, or the images of some results.

    ``stored`` are the digests of the stored descriptions; those that are ``damaged`` are not compared, and ``task``
    computes the others again.
    """

    object_name: str | None
    images: tuple[_Image, ...]
    stored: tuple[str, ...] = ()
    damaged: tuple[str, ...] = ()
    task: describing.Task | None = None
    number: int = 0

    def finding(self, problem: Problem, image: _Image | None = None, **details: Any) -> Finding:
        view_id, path = (None, None) if image is None else (image.view_id, path_of(image.name))
        return Finding(problem, self.object_name, view_id, path, details)

    def key(self, quick: bool) -> str:
        """Return a digest of everything that the check of this group depends on."""
        return sha256(ascii((quick, *self[:-1])).encode()).hexdigest()


@dataclass(eq=False)
class _Rows:
    """What the check of the rows found, and what is to be checked further: the intact enrollments and answers."""

    findings: list[Finding] = field(default_factory=list)
    objects: int = 0
    views: int = 0
    results: int = 0
    images: int = 0
    owners: dict[int, str | None] = field(default_factory=dict)
    """The name of the object of each intact enrollment, by id."""
    answers: list[int] = field(default_factory=list)
    """The intact lines of the log with answers."""


def verify(
    catalog: Catalog, *, quick: bool = False, jobs: Jobs | None = None, unfinished: UnfinishedJob | None = None
) -> Generator[JobProgress, None, Verification]:
    """Check every row and every image, and describe the images again; change nothing.

    Parameters
    ----------
    quick
        Compare digests only: do not decode the images, and do not describe them.
    jobs
        Number of processes, or a cluster; None for one process per core.
    unfinished
        Stores what was right. It is not checked again, unless its rows in the catalog have changed.

    Raises
    ------
    CatalogError, CatalogBusy
        The catalog cannot be read.
    """
    rows, found = _Rows(), dict[int, list[Finding]]()
    image_bytes = done = 0

    def unknown() -> Iterator[_Group]:
        nonlocal image_bytes, done
        for number, group in enumerate(_groups(catalog, rows, quick)):
            image_bytes += sum(image.stored_bytes for image in group.images)
            if unfinished is not None and group.key(quick) in unfinished.found:
                done += len(group.images)
            else:
                yield group._replace(number=number)

    try:
        with catalog.database.read() as transaction:
            _check_rows(catalog, transaction, rows)
        yield JobProgress(0, rows.images)
        work = partial(_check, catalog.database.images, quick)
        for group, (problems, contents) in map_in_processes(work, unknown(), processes(jobs, rows.images)):
            found[group.number] = [*problems, *_check_descriptions(catalog, group, contents)]
            if unfinished is not None and not found[group.number]:
                unfinished.store({group.key(quick): len(group.images)})
            done += len(group.images)
            yield JobProgress(done, rows.images)
    except CatalogDamaged as damage:  # a row that cannot be read ends the check
        rows.findings.append(Finding(Problem.DAMAGED_DATABASE, details={"message": damage.what}))
    in_order = [finding for number in sorted(found) for finding in found[number]]
    return Verification(rows.objects, rows.views, rows.results, image_bytes, (*rows.findings, *in_order))


def missing_enrollments(transaction: Transaction) -> list[Finding]:
    """Return the enrollments that are in the log and not in the catalog, although this program did not remove them."""
    lines = transaction.execute(select(Entry.enrollment_id, Entry.object_name).where(Entry.status.is_not(None)))
    names = {number: name for number, name in lines if number is not None}
    removals = (Action.ENROLLMENT_DISCARDED, Action.GARBAGE_COLLECTED)
    removed = set(transaction.scalars(select(Enrollment.id)))
    for line in transaction.scalars(select(Entry).where(Entry.action.in_(removals))):
        collected = (line.record or {}).get(COLLECTED)
        removed |= {one for one in collected if isinstance(one, int)} if isinstance(collected, list) else set()
        if line.enrollment_id is not None:
            removed.add(line.enrollment_id)
    return [
        Finding(Problem.MISSING_ENROLLMENT, names[number], details={"enrollment_id": number})
        for number in sorted(names.keys() - removed)
    ]


def some_images(catalog: Catalog, count: int) -> list[str]:
    """Return the names of at most ``count`` images of views, spread over the catalog."""
    with catalog.database.read() as transaction:
        ids = transaction.scalars(select(View.id).order_by(View.id)).all()
        chosen = ids[:: max(len(ids) // count, 1)][:count]
        return list(transaction.scalars(select(View.image).where(View.id.in_(chosen)).order_by(View.id)))


def _check_rows(catalog: Catalog, transaction: Transaction, rows: _Rows) -> None:
    """Check the structure of the database, the log, and the rows of the enrollments; write the result into ``rows``."""
    # What there is. A damaged table may not be readable further down.
    rows.findings += [
        Finding(Problem.DAMAGED_DATABASE, details={"message": message})
        for message in catalog.database.damage(transaction)
    ]
    rows.objects = transaction.scalar(select(func.count(Enrollment.object_id.distinct()))) or 0
    rows.views = transaction.scalar(select(func.count(View.id))) or 0
    rows.results = transaction.scalar(select(func.max(Entry.result))) or 0
    # The log, from which everything else follows.
    wrong = set(log.wrong_lines(transaction))
    for number in sorted(wrong):
        name = transaction.scalar(select(Entry.object_name).where(Entry.id == number))
        rows.findings.append(Finding(Problem.LOG_CHANGED, name, details={"entry_id": number}))
    try:
        log.check_complete(transaction)
    except CatalogDamaged as damage:
        rows.findings.append(Finding(Problem.DAMAGED_DATABASE, details={"message": damage.what}))
    answers = transaction.scalars(select(Entry.id).where(Entry.action == Action.IDENTIFIED).order_by(Entry.id))
    rows.answers = [line for line in answers if line not in wrong]
    # The enrollments.
    rows.findings += missing_enrollments(transaction)
    wanted = select(Enrollment.id, state.Named.object_name)
    owners = wanted.outerjoin(state.Named, and_(state.Named.object_id == Enrollment.object_id, state.IS_STATE))
    rows.owners = dict(transaction.execute(owners.order_by(Enrollment.id)).all())
    ended = transaction.execute(select(state.Ended.enrollment_id, state.Ended.seal).where(state.IS_STATUS))
    seals = {number: seal for number, seal in ended if number in rows.owners}
    moved = transaction.scalars(
        select(Enrollment.id)
        .join(state.Ended, state.Ended.enrollment_id == Enrollment.id)
        .where(state.IS_STATUS, state.Ended.object_id.is_distinct_from(Enrollment.object_id))
    )
    changed = {*moved, *digests.damaged_enrollments(transaction, seals), *(rows.owners.keys() - seals.keys())}
    for number in sorted(changed):
        name = rows.owners.pop(number)
        rows.findings.append(Finding(Problem.ENROLLMENT_CHANGED, name, details={"enrollment_id": number}))
    tables = transaction.scalar(select(func.count(Session.empty_table))) or 0
    rows.images = rows.views + tables + len(rows.answers)


def _groups(catalog: Catalog, rows: _Rows, quick: bool) -> Iterator[_Group]:
    """Yield what is to be checked further. A large catalog is read in portions."""
    for ids in digests.portions(list(rows.owners), _AT_ONCE):
        with catalog.database.read() as transaction:
            enrollments = transaction.scalars(
                select(Enrollment)
                .where(Enrollment.id.in_(ids))
                .options(selectinload(Enrollment.sessions), selectinload(Enrollment.views))
                .order_by(Enrollment.id)
            )
            groups = [_group(transaction, one, rows.owners[one.id], quick) for one in enrollments]
        yield from groups
    for lines in digests.portions(rows.answers, PORTION):
        image = (Entry.record["image"].as_string(), Entry.record["image_bytes"].as_integer())
        with catalog.database.read() as transaction:
            found = transaction.execute(select(*image).where(Entry.id.in_(lines)).order_by(Entry.id)).all()
        images = tuple(_Image(name, size) for name, size in found if name is not None)
        yield _Group(None, images)


def _group(transaction: Transaction, enrollment: Enrollment, name: str | None, quick: bool) -> _Group:
    images = [_Image(view.image, view.image_bytes, view.id) for view in enrollment.views]
    images += [
        _Image(session.empty_table, session.empty_table_bytes or 0)
        for session in enrollment.sessions
        if session.empty_table is not None
    ]
    stored, damaged, task = derived.to_compare(transaction, enrollment, name or "")
    return _Group(name, tuple(images), stored, damaged, None if quick else task)


def _check(store: Images, quick: bool, group: _Group) -> tuple[list[Finding], dict[str, bytes]]:
    """Check the images of a group; return also how its views are described now, if all images are right."""
    findings, pixels = [], dict[str, NDArray[np.uint8]]()
    first: tuple[int, int] | None = None
    for image in group.images:
        try:
            content = store.read(image.name)
        except (OSError, CatalogDamaged) as error:
            reason = error.what if isinstance(error, CatalogDamaged) else error.strerror or str(error)
            findings.append(group.finding(Problem.MISSING_IMAGE, image, reason=reason))
            continue
        if not image.name.startswith(files.digest(content)):
            sizes = {"bytes": len(content), "stored_bytes": image.stored_bytes}
            findings.append(group.finding(Problem.CHANGED_IMAGE, image, **sizes))
            continue
        if quick:
            continue
        try:
            decoded = files.decode(content)
        except files.BadImage as error:
            findings.append(group.finding(Problem.UNREADABLE_IMAGE, image, reason=str(error)))
            continue
        if group.task is not None and sum(one.nbytes for one in pixels.values()) <= MOST_HELD_BYTES:
            pixels[image.name] = decoded
        size = (decoded.shape[1], decoded.shape[0])
        first = first or size
        if size != first and group.object_name is not None:
            findings.append(group.finding(Problem.SIZES_DIFFER, image, size_px=size, first_size_px=first))
    if group.task is None or findings:
        return findings, {}
    try:
        return [], describing.contents(lambda name: pixels[name] if name in pixels else store.pixels(name), group.task)
    except CatalogError:  # these images cannot have been described so
        return [group.finding(Problem.DESCRIPTION_DIFFERS, descriptor=name) for name in group.task.names], {}


def _check_descriptions(catalog: Catalog, group: _Group, contents: Mapping[str, bytes]) -> Iterator[Finding]:
    for name in group.damaged:
        yield group.finding(Problem.DESCRIPTION_DAMAGED, descriptor=name)
    if group.task is not None and contents:
        with catalog.database.read() as transaction:
            different = derived.differing(transaction, group.task, contents)
        for name in different:
            yield group.finding(Problem.DESCRIPTION_DIFFERS, descriptor=name)
