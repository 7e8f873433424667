"""The stored views of an enrollment, segmented and described together, as a search segments its views.

Decision: docs/decisions/0053.
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from itertools import groupby
from threading import RLock
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, and_, bindparam, delete, insert, or_, select, update

from hbr.descriptors import descriptor
from hbr.segmentation import Method
from hbr.segmentation.stored import TOGETHER
from rig.catalog.describing import EmptyTable, is_current, pack, region_of
from rig.catalog.image_store import ImageStore
from rig.catalog.queries import packed_descriptors
from rig.catalog.records import JsonObject, PackedDescriptor, Region
from rig.catalog.schema import descriptors, sessions, views
from rig.config import ViewConfig
from rig.core.errors import CatalogError, UsageError
from rig.views.description import DescribedAlone, EnrollmentDescriber, Segmented, describe_alone

FEWEST_VIEWS: Final = 4
"""A session with fewer views, after an interruption, learns its background from all views of the enrollment."""

MOST_HELD_BYTES: Final = 256_000_000
"""Pixels of one enrollment that are held in memory: 277 views of 640x480."""


class StoredImage(NamedTuple):
    """The image of a view, with its SHA-256, its session, its region and its descriptors."""

    view_id: int
    image: str
    sha256: str
    session_id: int
    region: Region | None
    empty_table: EmptyTable | None


class Described(NamedTuple):
    """The packed levels of a view and its segmentation, or the reason why it cannot be described."""

    view_id: int
    packed: tuple[PackedDescriptor, ...] = ()
    segmentation: JsonObject | None = None
    reason: str = ""


def needs_segmentation(segmentation: JsonObject | None) -> bool:
    """Return whether a view has no segmentation, or one by a guess from this view alone."""
    if segmentation is None:
        return True
    return TOGETHER not in segmentation and segmentation.get("method") in (Method.GUESS, Method.NONE)


class HeldImages:
    """Pixels of stored images, held up to `MOST_HELD_BYTES`, because decoding takes longer than describing."""

    def __init__(self, store: ImageStore) -> None:
        self._store = store
        self._pixels: dict[str, NDArray[np.uint8]] = {}
        self._bytes = 0
        self._lock = RLock()

    def hold(self, image: str, pixels: NDArray[np.uint8]) -> None:
        """Hold the pixels of an image, uint8 (H, W, 3) BGR, if there is room. The caller does not change them."""
        with self._lock:
            if image not in self._pixels and self._bytes + pixels.nbytes <= MOST_HELD_BYTES:
                self._pixels[image] = pixels
                self._bytes += pixels.nbytes

    def pixels(self, image: str, sha256: str) -> NDArray[np.uint8]:
        """Return the pixels of an image; errors as `ImageStore.pixels`. Threads that call it wait for each other."""
        with self._lock:
            if image not in self._pixels:
                pixels = self._store.pixels(image, sha256)
                self.hold(image, pixels)
                return pixels
            return self._pixels[image]


class DescribedMeanwhile:
    """Views of one session that are described in a thread while the table rotates to the next one.

    These are the views that were segmented with the empty-table image, because no other view changes their
    segmentation. At the end of an enrollment only the other views must be described.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "describer")
        self._found: dict[Hashable, Future[DescribedAlone]] = {}
        self._small: dict[Hashable, NDArray[np.uint8]] = {}

    def begin(
        self, image: str, names: tuple[str, ...], region: Region | None, table: EmptyTable, segmented: Segmented
    ) -> None:
        """Begin to describe a view by descriptors of the object. Its first description is by this table and region."""
        self._found[image, names, region, table] = self._thread.submit(describe_alone, segmented, names)
        self._small[image, region] = segmented.frame.small

    def small(self, item: StoredImage) -> NDArray[np.uint8] | None:
        """Return the small image (`hbr.segmentation.background.shrunk`) of a view's region, if it is known."""
        return self._small.get((item.image, item.region))

    def result(self, item: StoredImage, names: tuple[str, ...]) -> DescribedAlone | None:
        """Return the description of a view by these descriptors, when it is ready; None if it was not begun.

        Raises what `EnrollmentDescriber.describe` does.
        """
        found = self._found.get((item.image, names, item.region, item.empty_table))
        return None if found is None else found.result()


def describe_together(
    held: HeldImages,
    names: tuple[str, ...],
    items: Sequence[StoredImage],
    *,
    threads: int = 1,
    meanwhile: DescribedMeanwhile | None = None,
) -> list[Described]:
    """Describe the views of one enrollment by these descriptors, in their order, in this number of threads.

    Views that were described ``meanwhile`` are not described again.
    """
    found: dict[int, Described] = {}
    for _, group in groupby(sorted(items, key=_session), _session):
        own = list(group)
        region, empty_table = own[0].region, own[0].empty_table
        learned_from = own if len(own) >= FEWEST_VIEWS else [one for one in items if one.region == region]
        try:
            table = None if empty_table is None else held.pixels(*empty_table)
        except CatalogError as error:
            found |= {one.view_id: Described(one.view_id, reason=error.what.rstrip(".")) for one in own}
            continue
        describer = EnrollmentDescriber(ViewConfig(roi=region), names, table)
        numbers: dict[int, int] = {}
        for one in learned_from:
            try:
                small = None if meanwhile is None else meanwhile.small(one)
                numbers[one.view_id] = describer.learn(held.pixels(one.image, one.sha256), small)
            except (CatalogError, UsageError, ValueError) as error:
                found.setdefault(one.view_id, Described(one.view_id, reason=_reason(error)))
        known = [one for one in own if one.view_id in numbers]
        describe = partial(_described, held, describer, numbers, names, meanwhile)
        if threads == 1:
            found |= {one.view_id: describe(one) for one in known}
        else:
            with ThreadPoolExecutor(threads, "describer") as pool:
                found |= {one.view_id: one for one in pool.map(describe, known)}
    return [found[one.view_id] for one in items]


def _described(
    held: HeldImages,
    describer: EnrollmentDescriber,
    numbers: Mapping[int, int],
    names: tuple[str, ...],
    meanwhile: DescribedMeanwhile | None,
    item: StoredImage,
) -> Described:
    """Return the description of a view that the describer has learned as the view of this number."""
    try:
        alone = None if meanwhile is None else meanwhile.result(item, names)
        described = describer.describe(numbers[item.view_id], held.pixels(item.image, item.sha256), alone)
    except (CatalogError, UsageError, ValueError) as error:
        return Described(item.view_id, reason=_reason(error))
    return Described(item.view_id, tuple(pack(described.levels, item.region)), described.segmentation)


def object_descriptors(connection: Connection, enrollment_id: int) -> tuple[str, ...]:
    """Return the descriptors of the object alone by which views of an enrollment are described, in present versions."""
    rows = connection.execute(
        select(descriptors.c.name, descriptors.c.version)
        .join(views, descriptors.c.view_id == views.c.id)
        .where(views.c.enrollment_id == enrollment_id)
        .distinct()
        .order_by(descriptors.c.name)
    )
    return objects_alone(name for name, version in rows if is_current(name, version))


def objects_alone(names: Iterable[str]) -> tuple[str, ...]:
    """Return the descriptors among these that describe the object alone, in alphabetic order."""
    return tuple(sorted(name for name in names if not descriptor(name).whole_image))


def stored_images(connection: Connection, enrollment_id: int) -> list[StoredImage]:
    """Return the images of an enrollment, with the regions that their descriptors of the object describe."""
    rows = connection.execute(
        select(
            views.c.id,
            views.c.image,
            views.c.image_sha256,
            views.c.session_id,
            sessions.c.empty_table_image,
            sessions.c.empty_table_image_sha256,
        )
        .join(sessions, views.c.session_id == sessions.c.id)
        .where(views.c.enrollment_id == enrollment_id)
        .order_by(views.c.view_index)
    ).all()
    described = packed_descriptors(connection, views.c.enrollment_id == enrollment_id)
    found = []
    for view_id, image, sha256, session_id, table, table_sha256 in rows:
        settings = [one.settings for one in described.get(view_id, ()) if is_current(one.name, one.version)]
        region = region_of(settings[0]) if settings else None
        empty_table = None if table is None else (table, table_sha256)
        found.append(StoredImage(view_id, image, sha256, session_id, region, empty_table))
    return found


def write_described(connection: Connection, found: Iterable[Described]) -> int:
    """Replace levels and segmentations of views that still exist; return their number.

    The caller holds the write lock, within `rig.catalog.seal.changing_enrollments`.
    """
    wanted = [one for one in found if one.packed]
    ids = [one.view_id for one in wanted]
    alive = set(connection.scalars(select(views.c.id).where(views.c.id.in_(ids))))
    wanted = [one for one in wanted if one.view_id in alive]
    rows = [{"view_id": one.view_id, **packed._asdict()} for one in wanted for packed in one.packed]
    kinds = {(row["name"], row["version"]) for row in rows}
    if not rows:
        return 0
    same = or_(*(and_(descriptors.c.name == name, descriptors.c.version == version) for name, version in kinds))
    connection.execute(delete(descriptors).where(and_(descriptors.c.view_id.in_(alive), same)))
    connection.execute(insert(descriptors), rows)
    segmentations: list[dict[str, Any]] = [
        {"of_view": one.view_id, "new": one.segmentation} for one in wanted if one.segmentation is not None
    ]
    if segmentations:
        connection.execute(
            update(views).where(views.c.id == bindparam("of_view")).values(segmentation=bindparam("new")), segmentations
        )
    return len(wanted)


def _session(item: StoredImage) -> tuple[int, str]:
    return item.session_id, repr(item.region)


def _reason(error: Exception) -> str:
    return error.what.rstrip(".") if isinstance(error, CatalogError | UsageError) else str(error)
