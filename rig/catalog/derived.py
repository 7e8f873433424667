"""What is computed from the facts: the silhouettes and descriptors of the enrolled views.

The views of an enrollment are segmented and described together, once, when it ends, as a search segments its views. The
result is kept in the catalog's table ``derived``. It names the enrollment by its seal, and the versions that made it. A
missing, old or damaged result is computed again, so the table can be emptied at any time.

Decisions: docs/decisions/0042, docs/decisions/0053.
"""

import hashlib
import json
import re
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sqlalchemy import delete, func, insert, select
from sqlalchemy.orm import Session as Transaction

import hbr
from hbr.core.cores import THREADS
from hbr.dense.last_steps import near
from hbr.dense.local_difference import LocalView
from hbr.descriptors import Descriptor, descriptor, names
from rig.calibrations.store import CALIBRATIONS
from rig.catalog import log, state
from rig.catalog.catalog import Catalog
from rig.catalog.columns import damaged
from rig.catalog.database import Database
from rig.catalog.facts import Action, Derived, Enrollment, Entry, Session, View, seal_of
from rig.catalog.images import Images
from rig.catalog.jobs import JobProgress, finished, processes
from rig.catalog.opening import open_database
from rig.catalog.records import EnrollmentStatus, JsonObject, Region
from rig.config import ViewConfig
from rig.core.errors import CatalogDamaged, CatalogError, RigError, UsageError
from rig.core.files import json_values
from rig.core.next_steps import Do
from rig.core.processes import Jobs, map_in_processes
from rig.views.description import (
    BENCH_DESCRIPTOR,
    DESCRIPTORS,
    PAPER_DESCRIPTOR,
    EnrollmentDescriber,
    ViewDescriber,
    within,
)
from rig.views.segmentation_evidence import check_evidence

SEGMENTATION: Final = "segmentation"
"""The kind of the stored silhouettes: a list of the evidence of each view (`hbr.segmentation.stored`)."""
SEGMENTATION_VERSION: Final = 1
"""Increases when the same images give other silhouettes."""
FEWEST_VIEWS: Final = 4
"""A session with fewer views, after an interruption, learns its background from all views of the enrollment."""
ROUNDED: Final = 0.02
"""Largest share of a view's levels that another computer may have rounded to the neighbouring level."""

Levels = NDArray[np.uint8]


class _Image(NamedTuple):
    """The image of a view, its session, and the part of it that is described."""

    image: str
    session: int
    region: Region | None
    azimuth_deg: float


class Task(NamedTuple):
    """An enrollment to be described: by these descriptors, with the empty-table image of each session."""

    seal: str
    name: str
    names: tuple[str, ...]
    region: tuple[Region | None] | None
    views: tuple[_Image, ...]
    empty_tables: tuple[str | None, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """The levels of the views of an enrollment by each descriptor, uint8 (n, length), and their segmentation."""

    levels: Mapping[str, Levels]
    segmentation: tuple[dict[str, Any], ...]


class _Pixels(Protocol):
    def __call__(self, image: str, /) -> NDArray[np.uint8]: ...


def known_descriptor(name: str) -> Descriptor:
    """Return the descriptor of this name. A `UsageError` lists the known ones."""
    try:
        return descriptor(name)
    except ValueError as error:
        raise UsageError(
            f"There is no descriptor {name!r}.", next_step=f"Choose one of {', '.join(names())}."
        ) from error


def describe_new(catalog: Catalog, enrollment: Enrollment, held: Mapping[str, NDArray[np.uint8]], name: str) -> str:
    """Describe an enrollment that is about to be complete, store the result, and return its seal.

    ``held`` are pixels of images that need not be read again.

    Raises
    ------
    CatalogError
        An image cannot be read, or a view cannot be segmented.
    """
    store = catalog.database.images
    seal = seal_of(enrollment)
    task = task_of(enrollment, seal, name, DESCRIPTORS, None)

    def pixels(image: str) -> NDArray[np.uint8]:
        return held[image] if image in held else store.pixels(image)

    with catalog.database.catalog_errors():
        found = _describe(pixels, task, threads=THREADS)
    _store(catalog, [(task, found)])
    return seal


def described(catalog: Catalog, enrollment: Enrollment, name: str, *wanted: str) -> Described:
    """Return the stored description of an enrollment, or compute it; by `DESCRIPTORS` or those that are ``wanted``.

    Raises
    ------
    CatalogError
        An image cannot be read, or a view cannot be segmented.
    """
    kinds = wanted or DESCRIPTORS
    seal = seal_of(enrollment)
    with catalog.database.read() as transaction:
        region = _regions(transaction).of(transaction, enrollment.id)
        needed = kinds if all(descriptor(kind).whole_image for kind in kinds) else (SEGMENTATION, *kinds)
        stored = {kind: found.get(seal, b"") for kind, found in _stored(transaction, [seal], needed, region).items()}
    if all(stored.values()):
        packed = {kind: _records(descriptor(kind), stored[kind])["packed"].tobytes() for kind in kinds}
        levels = {kind: descriptor(kind).unpack_rows(content) for kind, content in packed.items()}
        count = len(enrollment.views)
        # What this program has not made is computed again.
        with suppress(ValueError, TypeError, AttributeError, RigError):
            evidence = _evidence(stored[SEGMENTATION], count) if SEGMENTATION in needed else ({},) * count
            return Described(levels, evidence)
    task = task_of(enrollment, seal, name, kinds, region)
    with catalog.database.catalog_errors():
        found = _describe(catalog.database.images.pixels, task, threads=THREADS)
    _store(catalog, [(task, found)])
    return found


def load_views(catalog: Catalog, descriptor: str) -> Generator[JobProgress, None, hbr.Views]:
    """Return the views of every complete enrollment of the objects in use, by object and index.

    It yields its progress in enrollments while it describes those that are not described yet.

    Raises
    ------
    UsageError
        There is no such descriptor.
    CatalogDamaged
        An object or a view is not as it was stored.
    CatalogError
        A view that is not described yet cannot be described.
    """
    kind = known_descriptor(descriptor)
    found: dict[str, bytes] = {}
    wanted, tasks = _missing(catalog, kind.name, found)
    for task, result in (yield from _described_now(catalog, tasks, None)):
        if isinstance(result, str):
            raise CatalogError(f"{task.name!r} cannot be described: {result}.", next_step=Do.VERIFY_CATALOG())
        found[task.seal] = _content(task, result)[kind.name]
    if not wanted:
        return hbr.Views.empty(kind.name)
    contents = [found[one.seal] for one in wanted]
    records = _records(kind, b"".join(contents))
    azimuth_deg = np.ascontiguousarray(records["azimuth_deg"])
    if not ((azimuth_deg >= 0) & (azimuth_deg < 360)).all():
        raise damaged("an azimuth of a stored description", azimuth_deg.min())
    return hbr.PackedViews(
        records["packed"],
        azimuth_deg,
        np.repeat(np.arange(len(wanted)), [len(content) // records.itemsize for content in contents]),
        tuple(one.name for one in wanted),
        kind.name,
    )


def views(
    catalog: Catalog, descriptor: str = PAPER_DESCRIPTOR, progress: Callable[[JobProgress], None] | None = None
) -> hbr.Views:
    """Return the views of `load_views`; ``progress`` is called while it describes some."""

    def show(at: JobProgress) -> None:
        if progress is not None and at.total:
            progress(at)

    return finished(load_views(catalog, descriptor), show)


@dataclass(frozen=True, slots=True)
class Redescribed:
    """Numbers of views that were described now and before, and the objects that failed, with the reasons."""

    descriptor: str
    version: int
    described: int
    unchanged: int
    failed: tuple[tuple[str, str], ...]


def redescribe(
    catalog: Catalog, descriptor: str = PAPER_DESCRIPTOR, *, again: bool = False, jobs: Jobs | None = None
) -> Generator[JobProgress, None, Redescribed]:
    """Describe the objects in use that are not described by the present version of a descriptor, or all ``again``.

    Each result is stored at once: after an interruption the next call continues there.

    Raises
    ------
    UsageError
        There is no such descriptor.
    CatalogError, CatalogBusy
        The catalog cannot be written.
    """
    kind = known_descriptor(descriptor)
    if again:
        with catalog.database.write() as transaction:
            transaction.execute(delete(Derived).where(Derived.what.in_((kind.name, SEGMENTATION))))
    found: dict[str, bytes] = {}
    _, tasks = _missing(catalog, kind.name, found)
    results = yield from _described_now(catalog, tasks, jobs, required=True)
    failed = [(task.name, result) for task, result in results if isinstance(result, str)]
    described = sum(len(task.views) for task, result in results if not isinstance(result, str))
    unchanged = sum(len(_records(kind, content)) for content in found.values())
    return Redescribed(kind.name, kind.version, described, unchanged, tuple(failed))


def choose_region(catalog: Catalog, region: Region | None) -> None:
    """Let the views of benches in use be described within another part of their images; None for the whole image.

    Imported photographs keep theirs.
    """
    with catalog.database.write() as transaction:
        log.append(transaction, catalog.clock, Action.REGION_CHOSEN, details={"region": region})


def local_views(catalog: Catalog, name: str, azimuths_deg: Sequence[float]) -> list[LocalView]:
    """Return the enrolled views of an object that are nearest to each of these azimuths, by azimuth.

    They are cut out as at the enrollment (`hbr.dense.local_difference`). Which these are, `hbr.dense.last_steps.near`
    decides for the bench and for the evaluation.

    Raises
    ------
    ObjectNotFound, CatalogError
        There is no such object, or an image is missing or is not the stored one.
    """
    found = catalog.object(name)
    enrollment = found.complete
    if enrollment is None:
        return []
    evidence = described(catalog, enrollment, name, BENCH_DESCRIPTOR).segmentation
    near_ones = near([view.azimuth_deg for view in enrollment.views], azimuths_deg)
    return [
        LocalView(cut.crop, cut.mask, view.azimuth_deg) for view, cut in _cut(catalog, enrollment, evidence, near_ones)
    ]


def regions_of(catalog: Catalog, enrollment: Enrollment) -> tuple[Region | None, ...]:
    """Return the part of the image of each view that is described; None for the whole image."""
    with catalog.database.read() as transaction:
        chosen = _regions(transaction).of(transaction, enrollment.id)
    return tuple(view.region if chosen is None else chosen[0] for view in enrollment.views)


def _cut(
    catalog: Catalog, enrollment: Enrollment, evidence: Sequence[Mapping[str, Any]], places: Iterable[int]
) -> list[tuple[View, hbr.Segmentation]]:
    """Return views of an enrollment with their stored segmentation."""
    regions = regions_of(catalog, enrollment)
    found = []
    for place in places:
        view = enrollment.views[place]
        table = enrollment.sessions[view.session].empty_table
        empty = None if table is None else catalog.read_image(table)
        describer = ViewDescriber(ViewConfig(roi=regions[place]), (BENCH_DESCRIPTOR,), empty)
        try:
            found.append((view, describer.segment(catalog.read_image(view.image), evidence[place])))
        except ValueError as error:
            raise CatalogDamaged(
                f"The view {view.id} cannot be segmented: {error}.", next_step=Do.VERIFY_CATALOG()
            ) from error
    return found


# What the enrolled views have in common


class EmptyTables(NamedTuple):
    """Names of the objects that were enrolled with an empty-table image and without, and the newest of these images."""

    with_image: tuple[str, ...]
    without_image: tuple[str, ...]
    newest: str | None


def empty_tables(catalog: Catalog) -> EmptyTables:
    """Return which of the objects in use were enrolled with an empty-table image."""
    newest: tuple[int, int] | None = None
    with_image: dict[str, bool] = {}
    with catalog.database.read() as transaction:
        owner = {one.enrollment_id: one.name for one in state.used(transaction)}
        rows = transaction.execute(
            select(Session.enrollment_id, Session.number, Session.empty_table).order_by(Session.started_utc)
        )
        for enrollment_id, number, image in rows:
            if (name := owner.get(enrollment_id)) is not None:
                with_image[name] = with_image.get(name, False) or image is not None
                newest = newest if image is None else (enrollment_id, number)
        image = None if newest is None else state.session(transaction, *newest).empty_table
    with_one = tuple(name for name in owner.values() if with_image.get(name))
    return EmptyTables(with_one, tuple(name for name in owner.values() if not with_image.get(name)), image)


def camera_settings(catalog: Catalog) -> list[dict[str, Any]]:
    """Return the camera's settings (`rig.devices.camera.CameraLocks`) of the objects in use, each combination once."""
    with catalog.database.read() as transaction:
        shown = _settings((view.id, view.evidence) for view in state.first_views(transaction, View.id, View.evidence))
        for view_id, _ in shown:
            state.view(transaction, view_id)  # of an edited one nothing is used
    return [settings for _, settings in shown]


def unfinished_camera_settings(catalog: Catalog, name: str) -> list[dict[str, Any]]:
    """Return the camera's settings of the views of an unfinished enrollment, each combination once."""
    begun = catalog.resumable(name)
    shown = () if begun is None else _settings((view.id, view.evidence) for view in begun.enrollment.views)
    return [settings for _, settings in shown]


def _settings(evidence: Iterable[tuple[int, JsonObject | None]]) -> list[tuple[int, dict[str, Any]]]:
    """Return each combination of the camera's settings once, with the first view that has it."""
    found: list[tuple[int, dict[str, Any]]] = []
    for view_id, one in evidence:
        if one is None:
            raise damaged("the evidence of a view", None)
        locks = one.get("locks")
        if isinstance(locks, dict) and all(locks != known for _, known in found):
            found.append((view_id, locks))
    return found


def newest_view(catalog: Catalog) -> str | None:
    """Return the image of the first view of the newest enrollment in use; None if there is none."""
    with catalog.database.read() as transaction:
        newest = max((one.enrollment_id for one in state.used(transaction)), default=0)
        view_id = transaction.scalar(select(View.id).where(View.index == 0, View.enrollment_id == newest))
        if view_id is None and newest:
            raise state.changed(["the first view of the newest enrollment"])
        return None if view_id is None else state.view(transaction, view_id).image


def described_regions(catalog: Catalog, bench: str) -> set[tuple[Region | None, tuple[str, ...]]]:
    """Return the regions that the views of a bench are described within; None is the whole image.

    Each region comes with the ids of the calibration results in force when its views were taken.
    """
    sessions, found = Session.__table__.c, set()
    with catalog.database.read() as transaction:
        regions = _regions(transaction)
        ids = {one.enrollment_id for one in state.used(transaction)}
        rows = transaction.execute(
            select(sessions.enrollment_id, sessions.conditions, View.region)
            .join(View, (View.enrollment_id == sessions.enrollment_id) & (View.session == sessions.number))
            .where(sessions.bench == bench, View.index == 0)
        ).all()
        for enrollment_id, conditions, region in rows:
            if enrollment_id in ids:
                chosen = regions.of(transaction, enrollment_id)
                calibrations = tuple(map(str, conditions.get(CALIBRATIONS) or ()))
                found.add((region if chosen is None else chosen[0], calibrations))
    return found


@dataclass(frozen=True, slots=True)
class _Regions:
    """The lines of the log that choose a region for what was enrolled before them, the last one first."""

    lines: tuple[tuple[int, Region | None], ...]

    def of(self, transaction: Transaction, enrollment_id: int) -> tuple[Region | None] | None:
        """Return the chosen region of an enrollment; None if its views keep their own."""
        if not self.lines:
            return None
        line = transaction.scalar(
            select(Entry.id).where(Entry.enrollment_id == enrollment_id, Entry.status == EnrollmentStatus.COMPLETE)
        )
        bench = transaction.scalar(select(Session.__table__.c.bench).where(Session.enrollment_id == enrollment_id))
        if line is None or not bench:
            return None
        return next(((region,) for number, region in self.lines if number > line), None)


def _regions(transaction: Transaction) -> _Regions:
    rows = transaction.execute(
        select(Entry.id, Entry.details).where(Entry.action == Action.REGION_CHOSEN).order_by(Entry.id.desc())
    )
    return _Regions(tuple((line, tuple(d["region"]) if d.get("region") else None) for line, d in rows))


# Describe


def _missing(catalog: Catalog, name: str, found: dict[str, bytes]) -> tuple[list[state.Used], list[Task]]:
    """Return the enrollments in use, and those to be described; put the stored levels of the others into ``found``."""
    kinds = (name,) if descriptor(name).whole_image else (name, SEGMENTATION)
    with catalog.database.read() as transaction:
        wanted = state.used(transaction, checked=True)
        regions = _regions(transaction)
        chosen = {one.seal: regions.of(transaction, one.enrollment_id) for one in wanted}
        for region in set(chosen.values()):
            seals = [seal for seal, one in chosen.items() if one == region]
            stored = _stored(transaction, seals, (name,), region)
            found.update(stored[name])
        missing = [one for one in wanted if one.seal not in found]
        tasks = []
        for one in missing:
            (known,) = state.enrollments(transaction, Enrollment.id == one.enrollment_id)
            compute = DESCRIPTORS if name in DESCRIPTORS and SEGMENTATION in kinds else (name,)
            tasks.append(task_of(known.enrollment, one.seal, one.name, compute, chosen[one.seal]))
    return wanted, tasks


def task_of(
    enrollment: Enrollment, seal: str, name: str, names: tuple[str, ...], region: tuple[Region | None] | None
) -> Task:
    """Return the task to describe an enrollment; ``region`` is the one that was chosen later."""
    views = tuple(
        _Image(view.image, view.session, view.region if region is None else region[0], view.azimuth_deg)
        for view in enrollment.views
    )
    return Task(seal, name, names, region, views, tuple(session.empty_table for session in enrollment.sessions))


def _described_now(
    catalog: Catalog, tasks: Sequence[Task], jobs: Jobs | None, *, required: bool = False
) -> Generator[JobProgress, None, list[tuple[Task, Described | str]]]:
    """Describe enrollments in processes and store the results; a text is the reason why one cannot be described."""
    done: list[tuple[Task, Described | str]] = []
    if tasks:
        yield JobProgress(0, len(tasks))
    work = partial(_describe_task, catalog.database.images)
    count = sum(len(task.views) for task in tasks)
    for task, result in map_in_processes(work, tasks, processes(jobs, count)):
        if not isinstance(result, str):
            _store(catalog, [(task, result)], required=required)
        done.append((task, result))
        yield JobProgress(len(done), len(tasks))
    return done


def _describe_task(images: Images, task: Task) -> Described | str:
    """Describe an enrollment in a worker process; a text says why it cannot be described."""
    try:
        return _describe(images.pixels, task)
    except (CatalogError, UsageError) as error:
        return error.what.rstrip(".")


def _describe(pixels: _Pixels, task: Task, *, threads: int = 1) -> Described:
    """Segment the views of an enrollment together and describe them.

    Raises
    ------
    CatalogError
        An image cannot be read, or a view cannot be segmented.
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
        found = describer.describe(number, pixels(view.image))
        for name in alone:
            levels[name][place] = found.levels[name]
        evidence[place] = found.segmentation or {}

    steps: list[tuple[int, Callable[[], None]]] = []
    if len(alone) < len(task.names):
        steps += [(place, partial(whole, place)) for place in range(count)]
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


def _made_by(what: str, region: tuple[Region | None] | None) -> str:
    version = SEGMENTATION_VERSION if what == SEGMENTATION else descriptor(what).version
    segmentation = (
        "" if what != SEGMENTATION and descriptor(what).whole_image else f", segmentation {SEGMENTATION_VERSION}"
    )
    return f"{what} {version}{segmentation}{'' if region is None else f', region {region[0]}'}"


def _record(kind: Descriptor) -> np.dtype[np.void]:
    return np.dtype([("packed", "u1", (kind.size_bytes,)), ("azimuth_deg", "<f8")])


def _records(kind: Descriptor, content: bytes) -> NDArray[np.void]:
    return np.frombuffer(content, _record(kind))


def content_of(kind: Descriptor, packed: NDArray[np.uint8], azimuth_deg: ArrayLike) -> bytes:
    """Return the content of a row of descriptors: their packed levels, uint8 (n, size), with the azimuths (n,)."""
    records = np.empty(len(packed), _record(kind))
    records["packed"], records["azimuth_deg"] = packed, azimuth_deg
    return records.tobytes()


def row_of(seal: str, what: str, region: tuple[Region | None] | None, content: bytes) -> dict[str, Any]:
    """Return the columns of a row of `Derived` by this program; ``region`` is the one that was chosen later."""
    made_by = _made_by(what, region)
    sha256 = digest_of(seal, what, made_by, content)
    return {"seal": seal, "what": what, "made_by": made_by, "content": content, "sha256": sha256}


def digest_of(seal: str, what: str, made_by: str, content: bytes) -> str:
    """Return the digest of a row of `Derived`; a content in the place of another one has another digest."""
    digest = hashlib.sha256(ascii((seal, what, made_by)).encode())
    digest.update(content)
    return digest.hexdigest()


def _content(task: Task, found: Described) -> dict[str, bytes]:
    """Return the contents of a description by their kind."""
    contents = {}
    for name, levels in found.levels.items():
        kind = descriptor(name)
        packed = np.frombuffer(b"".join(map(kind.pack, levels)), np.uint8).reshape(len(levels), -1)
        contents[name] = content_of(kind, packed, [view.azimuth_deg for view in task.views])
    if any(found.segmentation):
        contents[SEGMENTATION] = json.dumps(found.segmentation).encode()
    return contents


def _store(catalog: Catalog, done: Sequence[tuple[Task, Described]], *, required: bool = False) -> None:
    """Store descriptions. Unless it is ``required``, they are only computed again if this fails."""
    rows = [
        row_of(task.seal, what, task.region, content)
        for task, found in done
        for what, content in _content(task, found).items()
    ]
    with nullcontext() if required else suppress(RigError):
        if not catalog.database.read_only:
            _write(catalog.database, rows)
            return
        # Derived data may also be added to a catalog that is open for reading.
        database = open_database(catalog.place, create=False, read_only=False, busy_timeout_s=1.0)
        try:
            _write(database, rows)
        finally:
            database.close()


def _write(database: Database, rows: Sequence[dict[str, Any]]) -> None:
    with database.write() as transaction:
        add(transaction, rows)


def add(transaction: Transaction, rows: Sequence[dict[str, Any]]) -> None:
    """Add rows of `Derived`, in the place of earlier ones of the same kind."""
    for row in rows:
        transaction.execute(delete(Derived).where(Derived.seal == row["seal"], Derived.what == row["what"]))
    if rows:
        transaction.execute(insert(Derived), rows)


def _stored(
    transaction: Transaction, seals: Collection[str], kinds: Iterable[str], region: tuple[Region | None] | None
) -> dict[str, dict[str, bytes]]:
    """Return the stored contents of each kind by seal; those that are damaged or old are left out."""
    wanted = set(seals)
    found: dict[str, dict[str, bytes]] = {}
    for what in kinds:
        made_by = _made_by(what, region)
        query = select(Derived.seal, Derived.content, Derived.sha256).where(
            Derived.what == what, Derived.made_by == made_by
        )
        if len(wanted) < 100:
            query = query.where(Derived.seal.in_(wanted))
        size = 1 if what == SEGMENTATION else _record(descriptor(what)).itemsize
        found[what] = {
            seal: content
            for seal, content, sha256 in transaction.execute(query)
            if seal in wanted
            and content
            and digest_of(seal, what, made_by, content) == sha256
            and not len(content) % size
        }
    return found


def _evidence(content: bytes, views: int) -> tuple[dict[str, Any], ...]:
    """Return the evidence of each view; an error if there is none that this program would have stored."""
    found = tuple(json_values(content))
    if len(found) != views:
        raise ValueError("the evidence of other views")
    for one in found:
        check_evidence(one)
    return found


def counts(transaction: Transaction) -> list[tuple[str, int, int, bool]]:
    """Return name, version and number of views of each stored descriptor, and whether this program uses the version."""
    rows = transaction.execute(
        select(Derived.what, Derived.made_by, func.sum(func.length(Derived.content)))
        .where(Derived.what.in_(names()))
        .group_by(Derived.what, Derived.made_by)
    )
    found: Counter[tuple[str, int]] = Counter()
    for what, made_by, size in rows:
        if version := re.match(r"\S+ ([0-9]{1,9})\b", made_by or ""):
            found[what, int(version[1])] += (size or 0) // _record(descriptor(what)).itemsize
    return [
        (name, version, views, version == descriptor(name).version) for (name, version), views in sorted(found.items())
    ]


# Compare what is stored with the images


def to_compare(
    transaction: Transaction, enrollment: Enrollment, name: str
) -> tuple[tuple[str, ...], tuple[str, ...], Task | None]:
    """Return the digests of what is stored for an enrollment, the damaged kinds, and the task that computes the others.

    The task is None if this program would use nothing of it.
    """
    seal = seal_of(enrollment)
    region = _regions(transaction).of(transaction, enrollment.id)
    stored, damaged, used = [], [], []
    rows = select(Derived.what, Derived.made_by, Derived.content, Derived.sha256).where(Derived.seal == seal)
    for what, made_by, content, sha256 in transaction.execute(rows.order_by(Derived.what)):
        stored.append(f"{what} {made_by} {sha256}")
        if None in (made_by, content, sha256) or digest_of(seal, what, made_by, content) != sha256:
            damaged.append(what)
        elif what in (SEGMENTATION, *names()) and made_by == _made_by(what, region):
            used.append(what)
    kinds = tuple(what for what in used if what != SEGMENTATION)
    if SEGMENTATION in used and all(descriptor(what).whole_image for what in kinds):
        kinds = (*kinds, BENCH_DESCRIPTOR)
    return tuple(stored), tuple(damaged), task_of(enrollment, seal, name, kinds, region) if used else None


def contents(pixels: _Pixels, task: Task) -> dict[str, bytes]:
    """Compute what a task would store, by kind; errors as `described`."""
    return _content(task, _describe(pixels, task))


def differing(transaction: Transaction, task: Task, found: Mapping[str, bytes]) -> list[str]:
    """Return the kinds of stored contents that are not those that were ``found`` for the same task."""
    stored = _stored(transaction, [task.seal], found, task.region)
    return [
        what for what in found if task.seal in stored[what] and not _near(what, stored[what][task.seal], found[what])
    ]


def _near(what: str, stored: bytes, found: bytes) -> bool:
    """Return whether two contents are equal, or differ as if another computer had rounded the other way."""
    if stored == found:
        return True
    if what == SEGMENTATION:
        try:
            ours, theirs = ([(one.get("method"), one.get("box_px")) for one in json.loads(t)] for t in (found, stored))
        except (ValueError, TypeError, AttributeError):  # this program has not written it
            return False
        return ours == theirs
    kind = descriptor(what)
    if kind.whole_image or len(stored) != len(found):
        return False
    one, other = (_records(kind, content) for content in (found, stored))
    levels = [kind.unpack_rows(records["packed"].tobytes()).astype(np.int16) for records in (one, other)]
    off = np.abs(levels[0] - levels[1])
    same_places = bool((one["azimuth_deg"] == other["azimuth_deg"]).all())
    return same_places and int(off.max()) <= 1 and float((off > 0).mean(axis=1).max()) <= ROUNDED
