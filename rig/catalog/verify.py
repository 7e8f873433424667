"""Whether a catalog is as it was stored: rows, images and descriptors; what can be mended is mended when asked."""

import json
from collections.abc import Generator, Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, delete, null, select, update

from hbr.descriptors import PAPERS, Descriptor, descriptor, names
from rig.catalog import audit
from rig.catalog.catalog import Catalog
from rig.catalog.describing import Reference, region_of, stored_describer
from rig.catalog.jobs import Progressed, portions, processes
from rig.catalog.schema import descriptors, enrollments, objects, sittings, views
from rig.catalog.upkeep import LOST
from rig.core.errors import CatalogError, UsageError
from rig.core.files import make_folder, write
from rig.core.processes import map_in_processes
from rig.views import image_files as images

ROUNDED: Final = 0.02
"""Share of a view's levels that may be rounded the other way."""


class Problem(StrEnum):
    """What `verify` finds."""

    DAMAGED_DATABASE = "database damaged"
    ORPHANED_ROW = "orphaned row"
    MISSING_IMAGE = "image missing"
    CHANGED_IMAGE = "image changed"
    UNREADABLE_IMAGE = "image unreadable"
    SIZES_DIFFER = "sizes differ"
    NOT_DESCRIBED = "not described"
    DESCRIPTOR_DIFFERS = "descriptor differs"
    ORPHANED_FILE = "orphaned file"


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that is not as it was stored; ``mended`` says what was done about it, None if nothing was."""

    problem: Problem
    what: str
    object_name: str | None = None
    view_id: int | None = None
    path: str | None = None
    mended: str | None = None


@dataclass(frozen=True, slots=True)
class Verification:
    """What was looked at, and everything that was found."""

    objects: int
    views: int
    image_bytes: int
    findings: tuple[Finding, ...]

    @property
    def unmended(self) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if finding.mended is None)


class _Item(NamedTuple):
    """An image that must be there; ``described`` holds name, version, settings as JSON and packed levels."""

    view_id: int | None
    sitting_id: int | None
    object_name: str
    enrollment_id: int
    image: str
    sha256: str
    file_bytes: int
    reference: Reference | None = None
    described: tuple[tuple[str, int, str, bytes], ...] = ()


class _Looked(NamedTuple):
    """What became of an item: the SHA-256 of the file that is there, and its pixels' width and height.

    ``different`` holds name and version of descriptors that do not match, and what they should be, if that is known.
    """

    sha256: str | None
    size: tuple[int, int] | None = None
    reason: str = ""
    different: tuple[tuple[str, int, bytes | None], ...] = ()


@dataclass
class _State:
    catalog: Catalog
    repair: bool
    findings: list[Finding] = field(default_factory=list)
    elsewhere: dict[str, Path] = field(default_factory=dict)
    """Files that are no view's own, by the SHA-256 of what is in them."""


def verify(
    catalog: Catalog, *, repair: bool = False, quick: bool = False, jobs: int | None = None
) -> Generator[Progressed, None, Verification]:
    """Look at every row, image and descriptor.

    Parameters
    ----------
    repair
        Mend what can be mended: an image whose bytes are found under another name is put back, descriptors are computed
        from images that are whole, orphaned rows go into the audit log, orphaned files into ``lost+found``. Nothing is
        thrown away.
    quick
        Compare the files' hashes, but do not describe the images again.
    jobs
        Processes; one for each core otherwise.

    Raises
    ------
    CatalogError, CatalogBusy
        The catalog cannot be read, or cannot be written for a repair.
    """
    state = _State(catalog, repair)
    with catalog.database.in_words():
        files = _files(catalog.path)
    _check_rows(state)
    items, object_count = _items(catalog)
    yield Progressed(0, len(items))
    looked: dict[_Item, _Looked] = {}
    done = 0
    work = partial(_look, catalog.path, quick)
    for portion, found in map_in_processes(work, portions(items), processes(jobs, len(items))):
        looked.update(zip(portion, found, strict=True))
        done += len(portion)
        yield Progressed(done, len(items))
    looked = {item: looked[item] for item in items}
    orphans = _orphans(catalog, files)
    _collect_elsewhere(state, looked, orphans)
    _judge_images(state, looked)
    _judge_sizes(state, looked)
    _judge_descriptors(state, looked)
    _judge_orphans(state, orphans)
    if repair and state.findings:
        mended = [finding for finding in state.findings if finding.mended]
        catalog.note(
            "verified and repaired",
            found=len(state.findings),
            mended=[f"{finding.problem}: {finding.what} {finding.mended}" for finding in mended],
        )
    return Verification(
        object_count,
        sum(item.view_id is not None for item in items),
        sum(item.file_bytes for item in items),
        tuple(state.findings),
    )


def _files(root: Path) -> set[str]:
    folder = root / images.IMAGE_FOLDER
    return {path.relative_to(root).as_posix() for path in folder.rglob("*") if not path.is_dir() or path.is_symlink()}


def _check_rows(state: _State) -> None:
    with state.catalog.database.read() as connection:
        told = connection.exec_driver_sql("PRAGMA quick_check(20)").scalars().all()
    if told != ["ok"]:
        state.findings += [
            Finding(Problem.DAMAGED_DATABASE, f"SQLite says: {line}; restore it from a backup") for line in told
        ]
    transaction = state.catalog.database.write if state.repair else state.catalog.database.read
    with transaction() as connection:
        connection.exec_driver_sql("PRAGMA defer_foreign_keys = ON")
        # the deletion of an orphan may make others
        while broken := connection.exec_driver_sql("PRAGMA foreign_key_check").all():
            for table, rowid, parent, _ in broken:
                kept = _row(connection, table, rowid)
                finding = Finding(
                    Problem.ORPHANED_ROW, f"a row of {table} refers to one of {parent} that is gone: {kept}"
                )
                if state.repair:
                    if kept and "id" in kept:
                        connection.exec_driver_sql(f"DELETE FROM {table} WHERE rowid = ?", (rowid,))
                    audit.append(connection, state.catalog.clock, "took out an orphan", table=table, row=kept)
                    finding = replace(finding, mended="it was taken out and is kept in the log")
                state.findings.append(finding)
            if not state.repair:
                return
            if any(rowid is None for _, rowid, _, _ in broken):
                connection.execute(delete(descriptors).where(descriptors.c.view_id.not_in(select(views.c.id))))


def _row(connection: Connection, table: str, rowid: int | None) -> dict[str, Any]:
    if rowid is None:
        return {}
    row = connection.exec_driver_sql(f"SELECT * FROM {table} WHERE rowid = ?", (rowid,)).first()
    return json.loads(json.dumps(dict(row._mapping), default=str)) if row is not None else {}


def _items(catalog: Catalog) -> tuple[list[_Item], int]:
    with catalog.database.read() as connection:
        count = len(connection.execute(select(objects.c.id)).all())
        described: dict[int, list[tuple[str, int, str, bytes]]] = {}
        for row in connection.execute(select(descriptors)):
            described.setdefault(row.view_id, []).append(
                (row.name, row.version, json.dumps(row.settings, sort_keys=True), row.packed)
            )
        items = [
            _Item._make(
                (
                    *row[:7],
                    Reference.of(row.reference_image, row.reference_image_sha256),
                    tuple(described.get(row.id, ())),
                )
            )
            for row in connection.execute(
                select(
                    views.c.id,
                    null(),
                    objects.c.name,
                    enrollments.c.id,
                    views.c.image,
                    views.c.image_sha256,
                    views.c.image_bytes,
                    sittings.c.reference_image,
                    sittings.c.reference_image_sha256,
                )
                .select_from(objects)
                .join(enrollments)
                .join(views, views.c.enrollment_id == enrollments.c.id)
                .join(sittings, views.c.sitting_id == sittings.c.id)
                .order_by(views.c.id)
            )
        ]
        items += [
            _Item(*row)
            for row in connection.execute(
                select(
                    null(),
                    sittings.c.id,
                    objects.c.name,
                    enrollments.c.id,
                    sittings.c.reference_image,
                    sittings.c.reference_image_sha256,
                    sittings.c.reference_image_bytes,
                )
                .select_from(objects)
                .join(enrollments)
                .join(sittings, sittings.c.enrollment_id == enrollments.c.id)
                .where(sittings.c.reference_image.is_not(None))
            )
        ]
    return items, count


def _look(root: Path, quick: bool, portion: tuple[_Item, ...]) -> list[_Looked]:
    return [_look_at(root, item, quick) for item in portion]


def _look_at(root: Path, item: _Item, quick: bool) -> _Looked:
    try:
        content = (root / item.image).read_bytes()
    except OSError as error:
        return _Looked(None, reason=error.strerror or str(error))
    sha256 = images.digest(content)
    if sha256 != item.sha256:
        return _Looked(sha256, reason=f"{len(content)} bytes, {item.file_bytes} were stored")
    if quick:
        return _Looked(sha256)
    try:
        image = images.decode(content)
    except images.BadImage as error:
        return _Looked(sha256, reason=str(error))
    different: list[tuple[str, int, bytes | None]] = []
    for name, version, settings, packed in item.described:
        if name not in names() or descriptor(name).version != version:
            continue  # of another program
        kind = descriptor(name)
        right: NDArray[np.uint8] | None = None
        try:
            region = region_of(json.loads(settings))
        except CatalogError:
            different.append((name, version, None))
            continue
        try:
            describe = stored_describer(root, (name,), region, item.reference)
        except CatalogError:
            continue  # the picture of the empty table is damaged, which is told by itself
        with suppress(UsageError, ValueError):
            right = describe(image).levels[name]
        if right is None or not _as_stored(kind, packed, right):
            different.append((name, version, None if right is None else kind.pack(right)))
    return _Looked(sha256, (image.shape[1], image.shape[0]), different=tuple(different))


def _as_stored(kind: Descriptor, packed: bytes, right: NDArray[np.uint8]) -> bool:
    """Whether stored levels are those of the image: to the bit, or of a descriptor that rounds, nearly so.

    Another computer's arithmetic may have rounded a level the other way.
    """
    if kind.pack(right) == packed:
        return True
    if kind.name in PAPERS or len(packed) != kind.size_bytes:
        return False
    off = np.abs(kind.unpack(packed).astype(np.int16) - right)
    return int(off.max()) <= 1 and float((off > 0).mean()) <= ROUNDED


def _orphans(catalog: Catalog, files: Iterable[str]) -> list[str]:
    # The files were listed before: an image whose row is committed in the meantime is none.
    with catalog.database.read() as connection:
        return sorted(set(files) - _wanted(connection))


def _wanted(connection: Connection) -> set[str]:
    return {
        *connection.scalars(select(views.c.image)),
        *connection.scalars(select(sittings.c.reference_image).where(sittings.c.reference_image.is_not(None))),
    }


def _collect_elsewhere(state: _State, looked: dict[_Item, _Looked], orphans: Iterable[str]) -> None:
    root = state.catalog.path
    if not any(found.sha256 != item.sha256 for item, found in looked.items()):
        return
    for item, found in looked.items():
        if found.sha256 is not None:
            state.elsewhere.setdefault(found.sha256, root / item.image)
    lost = [path for path in (root / LOST).rglob("*") if path.is_file()]
    for path in [*(root / name for name in orphans), *lost]:
        if path.is_file() and not path.is_symlink():
            state.elsewhere.setdefault(images.digest(path.read_bytes()), path)


def _judge_images(state: _State, looked: dict[_Item, _Looked]) -> None:
    root = state.catalog.path
    wrong = {item: found for item, found in looked.items() if found.sha256 != item.sha256}
    copies = {item: state.elsewhere[item.sha256] for item in wrong if item.sha256 in state.elsewhere}
    # all are read before any is written: two images may have changed places
    contents = {item: path.read_bytes() for item, path in copies.items()} if state.repair else {}
    for item, found in looked.items():
        if item in wrong:
            missing = found.sha256 is None
            problem = Problem.MISSING_IMAGE if missing else Problem.CHANGED_IMAGE
            state_of_it = "is missing" if missing else "is not what was stored"
            what = f"{item.object_name!r}: {item.image} {state_of_it} ({found.reason})"
            mended = None
            if item in contents:
                make_folder((root / item.image).parent, within=root)
                if not missing and found.sha256 not in {other.sha256 for other in wrong}:
                    _set_aside(root, item.image)
                write(root / item.image, contents[item])
                mended = f"it was put back from {copies[item].relative_to(root)}"
            elif item in copies:
                what += f"; {copies[item].relative_to(root)} has it: --repair puts it back"
            else:
                what += "; restore it from a backup, or enroll the object again with --replace"
            state.findings.append(_finding(problem, what, item, mended))
        elif found.reason:
            what = f"{item.object_name!r}: {item.image} cannot be decoded: {found.reason}"
            state.findings.append(_finding(Problem.UNREADABLE_IMAGE, what, item))


def _judge_sizes(state: _State, looked: dict[_Item, _Looked]) -> None:
    first: dict[int, tuple[int, int]] = {}
    for item, found in looked.items():
        if found.size is None:
            continue
        size = first.setdefault(item.enrollment_id, found.size)
        if found.size != size:
            what = (
                f"{item.object_name!r}: {item.image} has {found.size[0]}x{found.size[1]} pixels, the first view of its "
                f"enrollment {size[0]}x{size[1]}; enroll the object again with --replace"
            )
            state.findings.append(_finding(Problem.SIZES_DIFFER, what, item))


def _judge_descriptors(state: _State, looked: dict[_Item, _Looked]) -> None:
    for item, found in looked.items():
        for name, version, packed in found.different:
            mended = None
            if state.repair and packed is not None:
                with state.catalog.database.write() as connection:
                    connection.execute(
                        update(descriptors)
                        .where(
                            descriptors.c.view_id == item.view_id,
                            descriptors.c.name == name,
                            descriptors.c.version == version,
                        )
                        .values(packed=packed)
                    )
                mended = "it was described anew"
            what = f"{item.object_name!r}: what {name} says of {item.image} is not what it shows"
            state.findings.append(_finding(Problem.DESCRIPTOR_DIFFERS, what, item, mended))
        if item.view_id is not None and not item.described:
            what = f"{item.object_name!r}: {item.image} is not described: rig catalog redescribe"
            state.findings.append(_finding(Problem.NOT_DESCRIBED, what, item))


def _judge_orphans(state: _State, orphans: Iterable[str]) -> None:
    root = state.catalog.path
    for name in orphans:
        mended = None
        if state.repair:
            with state.catalog.database.write() as connection:
                if name in _wanted(connection) or not (root / name).is_file():
                    continue
                mended = f"it was moved to {_set_aside(root, name)}"
        what = f"{name} belongs to no view"
        state.findings.append(Finding(Problem.ORPHANED_FILE, what, path=name, mended=mended))


def _set_aside(root: Path, name: str) -> str:
    target = root / LOST / name
    make_folder(target.parent, within=root)
    number = 1
    while target.exists():
        target = target.with_name(f"{Path(name).stem}-{number}{Path(name).suffix}")
        number += 1
    (root / name).rename(target)
    return target.relative_to(root).as_posix()


def _finding(problem: Problem, what: str, item: _Item, mended: str | None = None) -> Finding:
    return Finding(problem, what, item.object_name, item.view_id, item.image, mended)
