"""Segmentation and description of the views of an enrollment, together, and how the result is stored.

Decision: docs/decisions/0010.
"""

import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sqlalchemy import delete, insert, select
from sqlalchemy.orm import Session as Transaction

from hbr.descriptors import Descriptor, descriptor, names
from hbr.descriptors.network import PACKAGE
from hbr.kernels.library import THREADS
from rig.catalog.database import Database
from rig.catalog.facts import Derived, Enrollment, seal_of
from rig.catalog.images import Images
from rig.catalog.opening import open_database
from rig.catalog.records import Region
from rig.config import ViewConfig
from rig.core.errors import CatalogError, ExtraMissing, RigError, UsageError
from rig.core.files import json_values
from rig.core.next_steps import Do
from rig.views.description import DESCRIPTORS, EnrollmentDescriber, check_evidence, within

SEGMENTATION: Final = "segmentation"
"""The kind of the stored silhouettes: a list of the evidence of each view (`hbr.segmentation.segment`)."""
SEGMENTATION_VERSION: Final = 2
"""Increases when the same images give other silhouettes."""
FEWEST_VIEWS: Final = 4
"""A session with fewer views, after an interruption, learns its background from all views of the enrollment."""

MOST_HELD_BYTES: Final = 256_000_000
"""Pixels of one enrollment that are held in memory until it is described: 277 views of 640x480."""

Levels = NDArray[np.uint8]


class _DescribedImage(NamedTuple):
    """The image of a view, its session, and the part of it that is described."""

    image: str
    session: int
    region: Region | None
    azimuth_deg: float


class Task(NamedTuple):
    """An enrollment to be described: by these descriptors, with the empty-table images (a sheet) of each session."""

    seal: str
    name: str
    names: tuple[str, ...]
    views: tuple[_DescribedImage, ...]
    empty_tables: tuple[str | None, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """The levels of the views of an enrollment by each descriptor, uint8 (n, length), and their segmentation."""

    levels: Mapping[str, Levels]
    segmentation: tuple[dict[str, Any], ...]


class _Pixels(Protocol):
    def __call__(self, image: str, /) -> NDArray[np.uint8]: ...


def known_descriptor(name: str) -> Descriptor:
    """Return the descriptor of this name.

    Raises `UsageError`: there is none; it lists the known ones. `ExtraMissing`: its packages are not installed.
    """
    try:
        kind = descriptor(name)
    except ValueError as error:
        raise UsageError(
            f"There is no descriptor {name!r}.",
            next_step=f"Choose one of {', '.join(names())}.",
            evidence={"reason": str(error)},
        ) from error
    if not kind.can_describe:
        raise ExtraMissing.of("network", f"Descriptions by {name}", ImportError(name=PACKAGE))
    return kind


def describe_new(database: Database, enrollment: Enrollment, held: Mapping[str, NDArray[np.uint8]], name: str) -> str:
    """Describe an enrollment that is about to be complete, store the result, and return its seal.

    ``held`` are pixels of images that need not be read again.

    Raises `CatalogError`: an image cannot be read, or a view cannot be segmented.
    """
    images = database.images
    seal = seal_of(enrollment)
    task = task_of(enrollment, seal, name, DESCRIPTORS)

    with database.catalog_errors():
        found = describe(held_pixels(images, held), task, threads=THREADS)
    store(database, [(task, found)])
    return seal


def task_of(enrollment: Enrollment, seal: str, name: str, names: tuple[str, ...]) -> Task:
    """Return the task to describe an enrollment."""
    views = tuple(_DescribedImage(view.image, view.session, view.region, view.azimuth_deg) for view in enrollment.views)
    return Task(seal, name, names, views, tuple(session.empty_table for session in enrollment.sessions))


def held_pixels(images: Images, held: Mapping[str, NDArray[np.uint8]] | None = None) -> _Pixels:
    """Return a function that reads each image once: it holds pixels, ``held`` ones first, up to `MOST_HELD_BYTES`.

    Decoding takes longer than describing, and a view is used several times.
    """
    known = dict(held or {})

    def pixels(image: str) -> NDArray[np.uint8]:
        if image in known:
            return known[image]
        found = images.pixels(image)
        if sum(one.nbytes for one in known.values()) + found.nbytes <= MOST_HELD_BYTES:
            known[image] = found
        return found

    return pixels


def describe_task(images: Images, task: Task) -> Described | str:
    """Describe an enrollment in a worker process; a text says why it cannot be described."""
    try:
        return describe(held_pixels(images), task)
    except (CatalogError, UsageError) as error:
        return error.what.rstrip(".")


def describe(pixels: _Pixels, task: Task, *, threads: int = 1) -> Described:
    """Segment the views of an enrollment together and describe them.

    Raises `CatalogError`: an image cannot be read, or a view cannot be segmented.
    """
    count = len(task.views)
    levels: dict[str, list[Levels]] = {name: [np.empty(0, np.uint8)] * count for name in task.names}
    evidence: list[dict[str, Any]] = [{}] * count
    alone = [name for name in task.names if not descriptor(name).whole_image]

    def whole(place: int) -> None:
        view = task.views[place]
        part = within(pixels(view.image), view.region)
        for name in task.names:
            if name not in alone:
                levels[name][place] = descriptor(name).describe(part)

    def together(place: int, describer: EnrollmentDescriber, number: int) -> None:
        view = task.views[place]
        found = describer.describe(number, pixels(view.image), view.azimuth_deg)
        for name in alone:
            levels[name][place] = found.levels[name]
        evidence[place] = found.segmentation or {}

    # Descriptors of the whole image need no other view.
    steps: list[tuple[int, Callable[[], None]]] = []
    if len(alone) < len(task.names):
        steps += [(place, partial(whole, place)) for place in range(count)]
    # The background is learned from the views of one session; from all of the region if it has too few.
    for session, places in (
        groupby(sorted(range(count), key=partial(_group, task)), partial(_group, task)) if alone else ()
    ):
        own = list(places)
        region = task.views[own[0]].region
        same_region = [place for place in range(count) if task.views[place].region == region]
        learned_from = own if len(own) >= FEWEST_VIEWS else same_region
        table = task.empty_tables[session[0]]
        describer = EnrollmentDescriber(
            ViewConfig(roi=region), tuple(sorted(alone)), None if table is None else pixels(table)
        )
        numbers = {}
        for place in learned_from:
            with _reasons(task, place):
                numbers[place] = describer.learn(pixels(task.views[place].image))
        steps += [(place, partial(together, place, describer, numbers[place])) for place in own]

    def run(step: tuple[int, Callable[[], None]]) -> None:
        with _reasons(task, step[0]):
            step[1]()

    # The steps are independent, so their order and the number of threads do not change the result.
    if threads == 1:
        for step in steps:
            run(step)
    else:
        with ThreadPoolExecutor(threads, "describer") as pool:
            list(pool.map(run, steps))
    return Described({name: np.stack(rows) for name, rows in levels.items()}, tuple(evidence))


def _group(task: Task, place: int) -> tuple[int, str]:
    return task.views[place].session, repr(task.views[place].region)


class _reasons:  # noqa: N801 - used as a function
    """Raise errors about a view as a `CatalogError` that names it."""

    def __init__(self, task: Task, place: int) -> None:
        self._task, self._place = task, place

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, UsageError | ValueError):
            reason = error.what.rstrip(".") if isinstance(error, UsageError) else str(error)
            raise CatalogError(
                f"View {self._place} of {self._task.name!r} cannot be described: {reason}.",
                next_step=("Check the disk.", Do.VERIFY_CATALOG()),
            ) from error


# Store


def made_by_of(what: str) -> str:
    version = SEGMENTATION_VERSION if what == SEGMENTATION else descriptor(what).version
    segmentation = (
        "" if what != SEGMENTATION and descriptor(what).whole_image else f", segmentation {SEGMENTATION_VERSION}"
    )
    return f"{what} {version}{segmentation}"


def record_of(kind: Descriptor) -> np.dtype[np.void]:
    return np.dtype([("packed", "u1", (kind.size_bytes,)), ("azimuth_deg", "<f8")])


def records_of(kind: Descriptor, content: bytes) -> NDArray[np.void]:
    return np.frombuffer(content, record_of(kind))


def content_of(kind: Descriptor, packed: NDArray[np.uint8], azimuth_deg: ArrayLike) -> bytes:
    """Return the content of a row of descriptors: their packed levels, uint8 (n, size), with the azimuths (n,)."""
    records = np.empty(len(packed), record_of(kind))
    records["packed"], records["azimuth_deg"] = packed, azimuth_deg
    return records.tobytes()


def row_of(seal: str, what: str, content: bytes) -> dict[str, Any]:
    """Return the columns of a row of `Derived` by this program."""
    made_by = made_by_of(what)
    sha256 = digest_of(seal, what, made_by, content)
    return {"seal": seal, "what": what, "made_by": made_by, "content": content, "sha256": sha256}


def digest_of(seal: str, what: str, made_by: str, content: bytes) -> str:
    """Return the digest of a row of `Derived`; a content in the place of another one has another digest."""
    digest = hashlib.sha256(ascii((seal, what, made_by)).encode())
    digest.update(content)
    return digest.hexdigest()


def contents_of(task: Task, found: Described) -> dict[str, bytes]:
    """Return the contents of a description by their kind."""
    contents = {}
    for name, levels in found.levels.items():
        kind = descriptor(name)
        packed = np.frombuffer(b"".join(map(kind.pack, levels)), np.uint8).reshape(len(levels), -1)
        contents[name] = content_of(kind, packed, [view.azimuth_deg for view in task.views])
    if any(found.segmentation):
        contents[SEGMENTATION] = json.dumps(found.segmentation).encode()
    return contents


def store(database: Database, done: Sequence[tuple[Task, Described]]) -> None:
    """Store descriptions; they are computed again if this fails."""
    rows = [
        row_of(task.seal, what, content) for task, found in done for what, content in contents_of(task, found).items()
    ]
    with suppress(RigError):
        if not database.read_only:
            _write(database, rows)
            return
        # What is derived may also be added to a catalog that is open for reading.
        writing = open_database(database.place, create=False, read_only=False, busy_timeout_s=1.0)
        try:
            _write(writing, rows)
        finally:
            writing.close()


def _write(database: Database, rows: Sequence[dict[str, Any]]) -> None:
    with database.write() as transaction:
        add(transaction, rows)


def add(transaction: Transaction, rows: Sequence[dict[str, Any]]) -> None:
    """Add rows of `Derived`, in the place of earlier ones of the same kind."""
    for row in rows:
        transaction.execute(delete(Derived).where(Derived.seal == row["seal"], Derived.what == row["what"]))
    if rows:
        transaction.execute(insert(Derived), rows)


def stored_contents(
    transaction: Transaction, seals: Collection[str], kinds: Iterable[str]
) -> dict[str, dict[str, bytes]]:
    """Return the stored contents of each kind by seal; those that are damaged or old are left out."""
    wanted = set(seals)
    found: dict[str, dict[str, bytes]] = {}
    for what in kinds:
        made_by = made_by_of(what)
        query = select(Derived.seal, Derived.content, Derived.sha256).where(
            Derived.what == what, Derived.made_by == made_by
        )
        if len(wanted) < 100:
            query = query.where(Derived.seal.in_(wanted))
        size = 1 if what == SEGMENTATION else record_of(descriptor(what)).itemsize
        found[what] = {
            seal: content
            for seal, content, sha256 in transaction.execute(query)
            if seal in wanted
            and content
            and digest_of(seal, what, made_by, content) == sha256
            and not len(content) % size
        }
    return found


def evidence_of(content: bytes, views: int) -> tuple[dict[str, Any], ...]:
    """Return the evidence of each view; an error if there is none that this program would have stored."""
    found = tuple(json_values(content))
    if len(found) != views:
        raise ValueError("the evidence of other views")
    for one in found:
        check_evidence(one)
    return found


def contents(pixels: _Pixels, task: Task) -> dict[str, bytes]:
    """Compute what a task would store, by kind; errors as `described`."""
    return contents_of(task, describe(pixels, task))
