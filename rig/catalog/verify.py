"""Check whether a catalog is as it was stored: rows, images and descriptors. Repair it on request."""

import json
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from sqlalchemy import Connection, Table, delete, func, select, update

from rig.catalog import audit
from rig.catalog.catalog import Catalog
from rig.catalog.jobs import JobProgress, portions, processes
from rig.catalog.schema import audit as audit_log
from rig.catalog.schema import corrections, descriptors, enrollments, objects, results, sessions, views
from rig.catalog.seal import appended_digests, changing_enrollments, enrollment_digests, object_digests
from rig.catalog.unfinished import UnfinishedJob
from rig.catalog.verify_images import (
    Checked,
    Described,
    Finding,
    Item,
    Problem,
    Repair,
    check_key,
    check_portion,
    stored_images,
    with_descriptions,
)
from rig.core.errors import CatalogDamaged
from rig.core.processes import Jobs, map_in_processes
from rig.views import image_files as images


@dataclass(frozen=True, slots=True)
class Verification:
    """Numbers of what was checked, and everything that was found."""

    objects: int
    views: int
    results: int
    image_bytes: int
    findings: tuple[Finding, ...]

    @property
    def unrepaired(self) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if finding.repair is None)


@dataclass
class _State:
    catalog: Catalog
    repair: bool
    findings: list[Finding] = field(default_factory=list)
    copies: dict[str, str] = field(default_factory=dict)
    """The name of a file for each SHA-256."""
    results: int = 0


def verify(
    catalog: Catalog,
    *,
    repair: bool = False,
    quick: bool = False,
    jobs: Jobs | None = None,
    unfinished: UnfinishedJob | None = None,
) -> Generator[JobProgress, None, Verification]:
    """Check every row, image and descriptor.

    Parameters
    ----------
    repair
        Repair what can be repaired, without deleting anything: restore an image whose content is found under another
        name, compute descriptors from intact images, record orphaned rows in the audit log, and move orphaned files to
        ``lost+found``.
    quick
        Compare the hashes of the files only; do not describe the images again.
    jobs
        Number of processes, or a cluster; None for one process per core.
    unfinished
        Stores which images were right. Images that it has stored are not checked again, unless their records in the
        catalog have changed.

    Raises
    ------
    CatalogError, CatalogBusy
        The catalog cannot be read, or cannot be written for a repair.
    """
    state = _State(catalog, repair)
    # The files are listed before the rows: an image whose row is committed in the meantime is not an orphan.
    with catalog.database.catalog_errors():
        files = catalog.database.images.names()
    items, object_count = stored_images(catalog)
    for item in items:  # before anything is repaired
        catalog.database.images.check(item.image)
    if _check_rows(state):
        items, object_count = stored_images(catalog)

    yield JobProgress(0, len(items))
    checked: dict[Item, Checked] = {}
    work = partial(check_portion, catalog.database.images, quick)
    remaining = with_descriptions(catalog, items)
    if unfinished is not None and unfinished.found:
        remaining = _without_known(remaining, unfinished, quick, checked)
    for portion, found in map_in_processes(work, portions(remaining), processes(jobs, len(items))):
        checked.update(zip((item for item, _ in portion), found, strict=True))
        if unfinished is not None:
            unfinished.store(_right(portion, found, quick))
        yield JobProgress(len(checked), len(items))
    checked = {item: checked[item] for item in items}  # in the order of the catalog, not of the processes

    with catalog.database.read() as connection:
        orphans = sorted(files - _referenced(connection))
    _find_copies(state, checked, orphans)
    _report_images(state, checked)
    _report_sizes(state, checked)
    _report_descriptors(state, checked)
    _report_orphans(state, orphans)
    _report_digests(state)
    if repair and state.findings:
        repaired = [f"{one.problem}: {one.path}, {one.repair}" for one in state.findings if one.repair is not None]
        catalog.note(audit.Action.REPAIRED, found=len(state.findings), repaired=repaired)
    return Verification(
        object_count,
        sum(item.view_id is not None for item in items),
        state.results,
        sum(item.file_bytes for item in items),
        tuple(state.findings),
    )


def _without_known(
    items: Iterator[Described], unfinished: UnfinishedJob, quick: bool, checked: dict[Item, Checked]
) -> Iterator[Described]:
    """Yield the items that are not known to be right, and put the others into ``checked``."""
    for item, stored in items:
        match unfinished.found.get(check_key(item, stored, quick), ""):
            case None if quick:
                checked[item] = Checked(item.sha256, item.file_bytes)
            case [int(width), int(height)]:
                checked[item] = Checked(item.sha256, item.file_bytes, (width, height))
            case _:
                yield item, stored


def _right(portion: Sequence[Described], found: Sequence[Checked], quick: bool) -> dict[str, Any]:
    """Return the size of each image of a portion that is right, by its key."""
    return {
        check_key(item, stored, quick): one.size_px
        for (item, stored), one in zip(portion, found, strict=True)
        if one == Checked(item.sha256, item.file_bytes, one.size_px)
    }


def _check_rows(state: _State) -> bool:
    """Check the structure of the database, and return whether rows were removed."""
    removed = False
    with state.catalog.database.read() as connection:
        messages = state.catalog.database.damage(connection)
        orphans = bool(state.catalog.database.orphans(connection))
    state.findings += [Finding(Problem.DAMAGED_DATABASE, details={"message": message}) for message in messages]
    if not orphans:
        return False
    transaction = state.catalog.database.write if state.repair else state.catalog.database.read
    with transaction() as connection:
        connection.exec_driver_sql("PRAGMA defer_foreign_keys = ON")
        # The deletion of an orphan may make other rows orphans.
        while broken := state.catalog.database.orphans(connection):
            for table, rowid, parent in broken:
                row = _row(connection, table, rowid)
                finding = Finding(Problem.ORPHANED_ROW, details={"table": table, "parent": parent, "row": row})
                if state.repair:
                    if row and "id" in row:
                        connection.exec_driver_sql(f"DELETE FROM {table} WHERE rowid = ?", (rowid,))
                    audit.append(connection, state.catalog.clock, audit.Action.ROW_REMOVED, table=table, row=row)
                    finding = replace(finding, repair=Repair.REMOVED)
                state.findings.append(finding)
            if not state.repair:
                return False
            removed = True
            if any(rowid is None for _, rowid, _ in broken):
                connection.execute(delete(descriptors).where(descriptors.c.view_id.not_in(select(views.c.id))))
    return removed


def _row(connection: Connection, table: str, rowid: int | None) -> dict[str, Any]:
    if rowid is None:
        return {}
    row = connection.exec_driver_sql(f"SELECT * FROM {table} WHERE rowid = ?", (rowid,)).first()
    return json.loads(json.dumps(dict(row._mapping), default=str)) if row is not None else {}


def _referenced(connection: Connection) -> set[str]:
    recorded = results.c.image.is_not(None)
    return {
        *connection.scalars(select(results.c.image).where(recorded)),
        *connection.scalars(select(views.c.image)),
        *connection.scalars(select(sessions.c.empty_table_image).where(sessions.c.empty_table_image.is_not(None))),
    }


def _find_copies(state: _State, checked: Mapping[Item, Checked], orphans: Iterable[str]) -> None:
    """Look for the content of missing and changed images under other names."""
    store = state.catalog.database.images
    if all(found.sha256 == item.sha256 for item, found in checked.items()):
        return
    for item, found in checked.items():
        if found.sha256 is not None:
            state.copies.setdefault(found.sha256, item.image)
    for name in [*orphans, *sorted(store.lost())]:
        with suppress(OSError, CatalogDamaged):  # not a regular file, or a link
            state.copies.setdefault(images.digest(store.read(name)), name)


def _report_images(state: _State, checked: Mapping[Item, Checked]) -> None:
    store = state.catalog.database.images
    wrong = {item: found for item, found in checked.items() if found.sha256 != item.sha256}
    copies = {item: state.copies[item.sha256] for item in wrong if item.sha256 in state.copies}
    # Read all before writing any: two images may have been swapped.
    contents = {item: store.read(name) for item, name in copies.items()} if state.repair else {}
    for item, found in checked.items():
        if item not in wrong:
            if found.reason:
                state.findings.append(item.finding(Problem.UNREADABLE_IMAGE, reason=found.reason))
            continue
        repair = None
        if item in contents:
            if found.sha256 is not None and found.sha256 not in {other.sha256 for other in wrong}:
                store.set_aside(item.image)
            store.write(item.image, contents[item])
            repair = Repair.RESTORED
        copy = copies.get(item)
        if found.sha256 is None:
            finding = item.finding(Problem.MISSING_IMAGE, repair, reason=found.reason, copy=copy)
        else:
            sizes = {"bytes": found.file_bytes, "stored_bytes": item.file_bytes}
            finding = item.finding(Problem.CHANGED_IMAGE, repair, **sizes, copy=copy)
        state.findings.append(finding)


def _report_sizes(state: _State, checked: Mapping[Item, Checked]) -> None:
    first: dict[int, tuple[int, int]] = {}
    for item, found in checked.items():
        if found.size_px is None:
            continue
        first_size = first.setdefault(item.enrollment_id, found.size_px)
        if found.size_px != first_size:
            finding = item.finding(Problem.SIZES_DIFFER, size_px=found.size_px, first_size_px=first_size)
            state.findings.append(finding)


def _report_descriptors(state: _State, checked: Mapping[Item, Checked]) -> None:
    for item, found in checked.items():
        for name, version, packed in found.different:
            repair = None
            if state.repair and packed is not None:
                transaction = state.catalog.database.write()
                with transaction as connection, changing_enrollments(connection, [item.enrollment_id]):
                    connection.execute(
                        update(descriptors)
                        .where(
                            descriptors.c.view_id == item.view_id,
                            descriptors.c.name == name,
                            descriptors.c.version == version,
                        )
                        .values(packed=packed)
                    )
                repair = Repair.DESCRIBED
            state.findings.append(item.finding(Problem.DESCRIPTOR_DIFFERS, repair, descriptor=name))
        if item.view_id is not None and not found.is_described:
            state.findings.append(item.finding(Problem.NOT_DESCRIBED))


def _report_digests(state: _State) -> None:
    """Compare the digests, after the repairs: a repaired row is again the one that was stored."""
    report = state.findings.append
    with state.catalog.database.read() as connection:
        owners = dict(connection.execute(select(enrollments.c.id, objects.c.name).join(objects)).all())
        names = dict(connection.execute(select(objects.c.id, objects.c.name)).all())
        for object_id, sealed, found in object_digests(connection):
            if sealed != found:
                report(Finding(Problem.OBJECT_CHANGED, names.get(object_id)))
        for enrollment_id, sealed, found in enrollment_digests(connection):
            if sealed != found:
                details = {"enrollment_id": enrollment_id}
                report(Finding(Problem.ENROLLMENT_CHANGED, owners.get(enrollment_id), details=details))
        given = state.catalog.database.last_ids(connection)
        state.findings += [
            Finding(Problem.LOG_CHANGED, details={"entry_id": entry_id})
            for entry_id in _changed_rows(connection, audit_log, given)
        ]
        state.results = given.get(results.name, 0)
        for table in (results, corrections):
            state.findings += [
                Finding(Problem.RESULT_CHANGED, details={"table": table.name, "entry_id": entry_id})
                for entry_id in _changed_rows(connection, table, given)
            ]
        for table in (objects, enrollments, sessions, views):
            last = connection.scalar(select(func.max(table.c.id))) or 0
            if table.kwargs.get("sqlite_autoincrement") and last > given.get(table.name, 0):
                report(_changed(f"last id of {table.name}", given.get(table.name), last))
        for setting, found_value, stored in state.catalog.database.settings(connection):
            report(_changed(setting, found_value, stored))


def _changed_rows(connection: Connection, table: Table, given: Mapping[str, int]) -> list[int]:
    """Return the ids of the rows of an append-only table that are not as they were written, or follow missing ones."""
    changed, before = [], 0
    for entry_id, sealed, found in appended_digests(connection, table):
        if sealed != found or entry_id != before + 1:
            changed.append(entry_id)
        before = entry_id
    last = given.get(table.name, 0)
    return changed if last == before else [*changed, last]


def _changed(setting: str, found: object, stored: object) -> Finding:
    return Finding(Problem.SETTING_CHANGED, details={"setting": setting, "found": found, "stored": stored})


def _report_orphans(state: _State, orphans: Iterable[str]) -> None:
    store = state.catalog.database.images
    for name in orphans:
        repair = moved_to = None
        if state.repair:
            with state.catalog.database.write() as connection:
                if name in _referenced(connection) or name not in store.names():
                    continue
                moved_to = store.set_aside(name)
            repair = Repair.MOVED
        state.findings.append(Finding(Problem.ORPHANED_FILE, path=name, details={"moved_to": moved_to}, repair=repair))
