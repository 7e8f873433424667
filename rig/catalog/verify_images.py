"""The images that a catalog must have, and the check of each: its file, its pixels, its descriptors."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from hashlib import sha256
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import func, null, select

from hbr.descriptors import descriptor
from rig.catalog.catalog import Catalog
from rig.catalog.describing import EmptyTable, is_current, matches, region_of, stored_describer
from rig.catalog.image_store import ImageStore
from rig.catalog.queries import of_views, packed_descriptors
from rig.catalog.schema import enrollments, objects, results, sessions, views
from rig.core.errors import CatalogError, UsageError
from rig.views import image_files as images

_READ_AT_ONCE: Final = 1024
"""Views whose descriptions are read from the catalog at once."""


class Problem(StrEnum):
    """Kind of a problem, with the keys of `Finding.details`."""

    DAMAGED_DATABASE = "database damaged"
    """``message`` of SQLite."""
    ORPHANED_ROW = "orphaned row"
    """``row`` of ``table`` refers to a missing row of ``parent``."""
    MISSING_IMAGE = "image missing"
    """``reason`` of the system; ``copy``: path of a file with the stored content, or None."""
    CHANGED_IMAGE = "image changed"
    """``bytes`` found and ``stored_bytes``; ``copy``: as above."""
    UNREADABLE_IMAGE = "image unreadable"
    """``reason`` of the decoder."""
    SIZES_DIFFER = "sizes differ"
    """``size_px`` of the image and of the first view of its enrollment, ``first_size_px``."""
    NOT_DESCRIBED = "not described"
    DESCRIPTOR_DIFFERS = "descriptor differs"
    """The stored levels of ``descriptor`` are not those of the image."""
    OBJECT_CHANGED = "object changed"
    """Its name, label, note or dates are not those that were stored."""
    ENROLLMENT_CHANGED = "enrollment changed"
    """A value of a session, a view or a descriptor of ``enrollment_id`` is not the stored one."""
    LOG_CHANGED = "log changed"
    """Entry ``entry_id`` of the audit log is not the one that was written, or entries before it are missing."""
    RESULT_CHANGED = "result changed"
    """Row ``entry_id`` of ``table`` (results or corrections) is not the one that was written, or rows are missing."""
    SETTING_CHANGED = "setting changed"
    """``setting`` of the database is ``found``, not ``stored``."""
    ORPHANED_FILE = "orphaned file"
    """``moved_to``: path after a repair, or None."""


class Repair(StrEnum):
    """What was done about a problem."""

    RESTORED = "restored from a copy"
    DESCRIBED = "described again"
    REMOVED = "removed and recorded in the log"
    MOVED = "moved to lost+found"


@dataclass(frozen=True, slots=True)
class Finding:
    """A problem of a catalog, and how it was repaired; None if it was not."""

    problem: Problem
    object_name: str | None = None
    view_id: int | None = None
    path: str | None = None
    details: Mapping[str, Any] = field(default_factory=dict)
    repair: Repair | None = None


class Item(NamedTuple):
    """An image that must exist.

    The image of a result has no object, and the negative number of the result instead of an enrollment.
    """

    view_id: int | None
    session_id: int | None
    object_name: str
    enrollment_id: int
    image: str
    sha256: str
    file_bytes: int
    empty_table: EmptyTable | None = None

    def finding(self, problem: Problem, repair: Repair | None = None, **details: Any) -> Finding:
        return Finding(problem, self.object_name, self.view_id, self.image, details, repair)


class StoredDescription(NamedTuple):
    """The stored description of a view: name, version, settings as JSON, and packed levels of each descriptor.

    ``segmentation`` is the stored evidence as JSON.
    """

    descriptors: tuple[tuple[str, int, str, bytes], ...] = ()
    segmentation: str = "null"


Described = tuple[Item, StoredDescription | None]
"""An item and its stored description; None if it is not the image of a view, or the view is gone."""


class Checked(NamedTuple):
    """The result for an item: SHA-256 and size of its file, and width and height of the image.

    ``is_described`` is false for a view without descriptors. ``different`` holds name and version of each descriptor
    with wrong levels, and the right levels if known.
    """

    sha256: str | None
    file_bytes: int = 0
    size_px: tuple[int, int] | None = None
    reason: str = ""
    different: tuple[tuple[str, int, bytes | None], ...] = ()
    is_described: bool = True


def stored_images(catalog: Catalog) -> tuple[list[Item], int]:
    """Return an item for each view and each empty-table image, and the number of objects."""
    with catalog.database.read() as connection:
        count = len(connection.execute(select(objects.c.id)).all())
        empty_table = (sessions.c.empty_table_image, sessions.c.empty_table_image_sha256)
        owner = (objects.c.name, enrollments.c.id)
        rows = connection.execute(
            of_views(
                views.c.id,
                null(),
                *owner,
                views.c.image,
                views.c.image_sha256,
                views.c.image_bytes,
                *empty_table,
            )
            .join(sessions, views.c.session_id == sessions.c.id)
            .order_by(views.c.id)
        ).all()
        items = [Item(*row[:7])._replace(empty_table=None if row[7] is None else (row[7], row[8])) for row in rows]
        items += [
            Item(*row)
            for row in connection.execute(
                select(
                    null(), sessions.c.id, *owner, *empty_table, func.coalesce(sessions.c.empty_table_image_bytes, 0)
                )
                .select_from(objects)
                .join(enrollments)
                .join(sessions, sessions.c.enrollment_id == enrollments.c.id)
                .where(sessions.c.empty_table_image.is_not(None))
            )
        ]
        image = (results.c.image, results.c.image_sha256, func.coalesce(results.c.image_bytes, 0))
        recorded = select(-results.c.id, *image).where(results.c.image.is_not(None))
        items += [Item(None, None, "", *row) for row in connection.execute(recorded)]
    return items, count


def check_key(item: Item, stored: StoredDescription | None, quick: bool) -> str:
    """Return a digest of everything that a check of an item compares with its image."""
    compared = [] if stored is None else [is_current(name, version) for name, version, *_ in stored.descriptors]
    return sha256(ascii((tuple(item), stored, quick, compared)).encode()).hexdigest()


def with_descriptions(catalog: Catalog, items: Sequence[Item]) -> Iterator[Described]:
    """Yield each item with its stored description.

    The descriptions of a large catalog need gigabytes: they are read some views at a time.
    """
    for start in range(0, len(items), _READ_AT_ONCE):
        some = items[start : start + _READ_AT_ONCE]
        is_one = views.c.id.in_([item.view_id for item in some if item.view_id is not None])
        with catalog.database.read() as connection:
            described = packed_descriptors(connection, is_one)
            evidence = dict(connection.execute(select(views.c.id, views.c.segmentation).where(is_one)).all())
        for item in some:
            if item.view_id is None or item.view_id not in evidence:
                yield item, None
                continue
            packed = (
                (one.name, one.version, json.dumps(one.settings, sort_keys=True), one.packed)
                for one in described.get(item.view_id, ())
            )
            yield item, StoredDescription(tuple(packed), json.dumps(evidence[item.view_id]))


def check_portion(store: ImageStore, quick: bool, portion: tuple[Described, ...]) -> list[Checked]:
    return [
        _check(store, item, StoredDescription() if stored is None else stored, quick)._replace(
            is_described=stored is None or bool(stored.descriptors)
        )
        for item, stored in portion
    ]


def _check(store: ImageStore, item: Item, stored: StoredDescription, quick: bool) -> Checked:
    try:
        content = store.read(item.image)
    except OSError as error:
        return Checked(None, reason=error.strerror or str(error))
    sha256 = images.digest(content)
    if quick or sha256 != item.sha256:
        return Checked(sha256, len(content))
    try:
        image = images.decode(content)
    except images.BadImage as error:
        return Checked(sha256, len(content), reason=str(error))
    different: list[tuple[str, int, bytes | None]] = []
    for name, version, settings, packed in stored.descriptors:
        if not is_current(name, version):
            continue
        kind = descriptor(name)
        try:
            region = region_of(json.loads(settings))
        except CatalogError:
            different.append((name, version, None))
            continue
        try:
            describe = stored_describer(store, (name,), region, item.empty_table)
        except CatalogError:
            continue  # the empty-table image is damaged: it is another item
        levels: NDArray[np.uint8] | None = None
        with suppress(UsageError, KeyError, ValueError):
            levels = describe(image, json.loads(stored.segmentation)).levels[name]
        if levels is None or not matches(kind, packed, levels):
            different.append((name, version, None if levels is None else kind.pack(levels)))
    return Checked(sha256, len(content), (image.shape[1], image.shape[0]), different=tuple(different))
