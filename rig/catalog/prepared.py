"""Prepared views: the packed descriptors of a large catalog in a file that searches map into memory.

Reading a million views from the database and checking the digests of their rows takes minutes. The file beside the
database contains the values after such a check. It has an entry for each object: the digest of its enrollment at that
time, and a digest of its part of the file. At each start the program compares the first digest with the database and
the second one with the file. An object that was added or changed since then is read from the database and appended; a
damaged file is made again. The file is never used without both checks.

Decision: docs/decisions/0042.
"""

import fcntl
import json
import mmap
import os
import secrets
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select

import hbr
from hbr.descriptors import Descriptor
from rig.catalog.catalog import Catalog
from rig.catalog.describing import known_descriptor
from rig.catalog.jobs import JobProgress, finished
from rig.catalog.places import PREPARED, file_mode, make_folder_within
from rig.catalog.queries import model_set, retrieved
from rig.catalog.schema import enrollments, objects
from rig.catalog.seal import check_loaded
from rig.core.errors import CatalogError, DescriptorOutdated
from rig.core.files import json_values, no_follow, open_new, read, write
from rig.core.next_steps import Do
from rig.views.description import BENCH_DESCRIPTOR, PAPER_DESCRIPTOR

FORMAT: Final = "hbr-rig prepared views"
VERSION: Final = 1
FEWEST_OBJECTS: Final = 50
"""Smallest number of views for the file. A smaller catalog is read from its database, which is checked completely."""
MAX_ENTRIES_BYTES: Final = 500_000_000
_AT_ONCE: Final = 250
"""Objects that are read from the database before they are stored: after Ctrl+C the next start continues there."""
_MOST_UNUSED: Final = 0.25
"""Share of the file that may belong to objects that are deleted or were enrolled again."""


class _Wanted(NamedTuple):
    """A complete enrollment of an object in use."""

    object_id: int
    name: str
    enrollment_id: int
    digest: str | None


class _Entry(NamedTuple):
    """A part of the file: the views of an enrollment that had this digest. `sha256` is of its bytes."""

    enrollment_id: int
    digest: str
    views: int
    sha256: str


class _File(NamedTuple):
    """The file with its entries, which lie one after the other from its beginning; or records in memory."""

    path: Path | None
    entries: list[_Entry]
    records: NDArray[np.void]


def load_views(catalog: Catalog, descriptor: str) -> Generator[JobProgress, None, hbr.Views]:
    """Return the views of every complete enrollment, like `Catalog.views`, for a large catalog from the prepared file.

    It yields its progress in objects while it reads the database. The file is written for a catalog that is open for
    reading, too: it has no records of its own. A catalog in a folder that cannot be written is read each time.

    Raises
    ------
    UsageError, DescriptorOutdated, CatalogDamaged
        As for `Catalog.views`; damage of the rows of views that the prepared file has does not matter.
    """
    kind = known_descriptor(descriptor)
    wanted = _wanted(catalog)
    if len(wanted) < FEWEST_OBJECTS:
        return catalog.views(descriptor).views
    folder = catalog.path / PREPARED
    known = _opened(folder, kind)
    have = {} if known is None else {(one.enrollment_id, one.digest) for one in known.entries}
    missing = [one for one in wanted if (one.enrollment_id, one.digest) not in have]
    if known is not None and _unused(known, wanted) > _MOST_UNUSED * len(known.records):
        known, missing = None, wanted
    done = len(wanted) - len(missing)
    if missing:
        yield JobProgress(done, len(wanted))
    for start in range(0, len(missing), _AT_ONCE):
        part = missing[start : start + _AT_ONCE]
        records, counts = _read(catalog, kind, part)
        entries = [
            _Entry(one.enrollment_id, str(one.digest), len(own), sha256(own.data).hexdigest())
            for one, own in zip(part, np.split(records, np.cumsum(counts)[:-1]), strict=True)
        ]
        known = _appended(catalog, folder, kind, known, entries, records)
        yield JobProgress(done + start + len(part), len(wanted))
    assert known is not None
    return _views(kind, known, wanted)


def prepared_views(
    catalog: Catalog, descriptor: str = PAPER_DESCRIPTOR, progress: Callable[[JobProgress], None] | None = None
) -> hbr.Views:
    """Return the views of `load_views`; ``progress`` is called while it reads the database."""

    def show(at: JobProgress) -> None:
        if progress is not None and at.total:
            progress(at)

    return finished(load_views(catalog, descriptor), show)


def searched_views(*catalogs: Catalog, progress: Callable[[JobProgress], None] | None = None) -> list[hbr.Views]:
    """Return the views of catalogs by the bench's own descriptor if all their objects have it, else by the paper's."""
    try:
        return [prepared_views(one, BENCH_DESCRIPTOR, progress) for one in catalogs]
    except DescriptorOutdated:
        return [prepared_views(one, PAPER_DESCRIPTOR, progress) for one in catalogs]


def _wanted(catalog: Catalog) -> list[_Wanted]:
    with catalog.database.read() as connection:
        found = connection.execute(
            select(objects.c.id, objects.c.name, enrollments.c.id, enrollments.c.digest)
            .join(enrollments)
            .where(retrieved())
            .order_by(objects.c.id)
        ).all()
        if len(found) >= FEWEST_OBJECTS:
            check_loaded(connection, {row[0] for row in found}, ())
    return [_Wanted(*row) for row in found]


def _read(catalog: Catalog, kind: Descriptor, part: Sequence[_Wanted]) -> tuple[NDArray[np.void], list[int]]:
    """Return the views of some objects from the database, and how many each has."""
    with catalog.database.read() as connection:
        try:
            views, view_ids = model_set(connection, kind, [one.object_id for one in part])
        except DescriptorOutdated:
            model_set(connection, kind)  # its error is about the whole catalog
            raise
    counts = np.bincount(views.object_index, minlength=len(views.object_names)).tolist()
    if views.object_names != tuple(one.name for one in part):
        raise CatalogError("The catalog was changed while it was read.", next_step=Do.RUN_AGAIN(), evidence={})
    records = np.empty(len(views), _record(kind))
    records["packed"], records["azimuth_deg"], records["view_id"] = views.packed(), views.azimuth_deg, view_ids
    return records, counts


def _record(kind: Descriptor) -> np.dtype[np.void]:
    return np.dtype([("packed", "u1", (kind.size_bytes,)), ("azimuth_deg", "<f8"), ("view_id", "<i8")])


def _views(kind: Descriptor, known: _File, wanted: Sequence[_Wanted]) -> hbr.Views:
    """Return the views of the wanted objects, in the order of the catalog."""
    begins = np.cumsum([0, *(one.views for one in known.entries)]).tolist()
    places = {(one.enrollment_id, one.digest): i for i, one in enumerate(known.entries)}
    chosen = [places[one.enrollment_id, str(one.digest)] for one in wanted]
    counts = np.array([known.entries[i].views for i in chosen])
    records = known.records
    if chosen != list(range(len(known.entries))):
        records = np.concatenate([records[begins[i] : begins[i + 1]] for i in chosen])
    return hbr.PackedViews(
        records["packed"],
        np.ascontiguousarray(records["azimuth_deg"]),
        np.repeat(np.arange(len(wanted)), counts),
        tuple(one.name for one in wanted),
        kind.name,
    )


def _unused(known: _File, wanted: Iterable[_Wanted]) -> int:
    """Return how many views of the file are not searched."""
    used = {(one.enrollment_id, one.digest) for one in wanted}
    return sum(one.views for one in known.entries if (one.enrollment_id, one.digest) not in used)


def _entries_path(folder: Path, kind: Descriptor) -> Path:
    return folder / f"{kind.name.replace(':', '-')}.json"


def _stored(folder: Path, kind: Descriptor) -> tuple[Path, list[_Entry]] | None:
    """Return the file and its entries as they are stored; None if there are none of this version."""
    try:
        header = json_values(read(_entries_path(folder, kind), max_bytes=MAX_ENTRIES_BYTES))
        expected = {"format": FORMAT, "version": VERSION, "descriptor": kind.name, "descriptor_version": kind.version}
        if {key: header.get(key) for key in expected} != expected or Path(header["rows"]).name != header["rows"]:
            return None
        entries = [_Entry(int(a), str(b), int(c), str(d)) for a, b, c, d in header["entries"]]
        return (folder / header["rows"], entries) if all(one.views > 0 for one in entries) else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _opened(folder: Path, kind: Descriptor) -> _File | None:
    """Return the prepared file, checked; None if there is none, or it is damaged or of another version."""
    found = _stored(folder, kind)
    if found is None:
        return None
    path, entries = found
    try:
        records = _mapped(path, _record(kind), sum(one.views for one in entries))
    except (OSError, ValueError, OverflowError):
        return None
    content = records.view(np.uint8)
    ends = (np.cumsum([0, *(one.views for one in entries)]) * records.itemsize).tolist()
    for one, (begin, end) in zip(entries, pairwise(ends), strict=True):
        if sha256(content[begin:end].data).hexdigest() != one.sha256:
            return None
    azimuth_deg = records["azimuth_deg"]
    return _File(path, entries, records) if ((azimuth_deg >= 0) & (azimuth_deg < 360)).all() else None


def _mapped(path: Path, record: np.dtype[np.void], count: int) -> NDArray[np.void]:
    """Map a file into memory; a `ValueError` if it is too short."""
    descriptor = no_follow(str(path), os.O_RDONLY | os.O_NONBLOCK)
    try:
        content = mmap.mmap(descriptor, count * record.itemsize, access=mmap.ACCESS_READ)
    finally:
        os.close(descriptor)
    return np.frombuffer(content, record)


def _appended(
    catalog: Catalog,
    folder: Path,
    kind: Descriptor,
    known: _File | None,
    entries: list[_Entry],
    records: NDArray[np.void],
) -> _File:
    """Return the prepared file with more objects, stored if that is possible, else in memory."""
    every = ([] if known is None else known.entries) + entries
    may_write = known is None or known.path is not None
    stem = kind.name.replace(":", "-")
    with suppress(OSError):
        if may_write:
            with _locked(catalog, folder, kind, known):
                path = known.path if known is not None else None
                path = path or folder / f"{stem}-{secrets.token_hex(4)}.rows"
                _append(path, known, records, mode=file_mode(catalog.path))
                header = {
                    "format": FORMAT,
                    "version": VERSION,
                    "descriptor": kind.name,
                    "descriptor_version": kind.version,
                    "rows": path.name,
                    "entries": every,
                }
                write(_entries_path(folder, kind), json.dumps(header).encode(), mode=file_mode(catalog.path))
                for old in folder.glob(f"{stem}-*.rows"):
                    if old != path:
                        old.unlink()
            return _File(path, every, _mapped(path, records.dtype, sum(one.views for one in every)))
    return _File(None, every, records if known is None else np.concatenate([known.records, records]))


def _append(path: Path, known: _File | None, records: NDArray[np.void], *, mode: int) -> None:
    """Write records behind the known ones; what an interrupted write left behind is cut off."""
    with open_new(path, mode=mode) if known is None else open(path, "r+b", opener=no_follow) as file:
        file.truncate(0 if known is None else len(known.records) * records.itemsize)
        file.seek(0, os.SEEK_END)
        file.write(records.data)
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def _locked(catalog: Catalog, folder: Path, kind: Descriptor, known: _File | None) -> Iterator[None]:
    """Lock the file; a `BlockingIOError` if another process writes it, or has written it since it was opened."""
    make_folder_within(catalog.path, folder)
    descriptor = no_follow(str(folder / "lock"), os.O_RDWR | os.O_CREAT, mode=file_mode(catalog.path))
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        stored = _stored(folder, kind)
        if known is not None and (stored is None or stored != (known.path, known.entries)):
            raise BlockingIOError(None, "another process has written the file")
        yield
    finally:
        os.close(descriptor)
