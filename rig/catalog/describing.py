"""Segmentation and description of the views of an enrollment, together, and how the result is stored.

Decision: docs/decisions/0010.
"""

import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sqlalchemy import delete, insert, select
from sqlalchemy.orm import Session as Transaction

import hbr
from hbr.descriptors import Descriptor, descriptor, names
from hbr.descriptors.network import PACKAGE
from hbr.kernels.library import THREADS
from rig.catalog.database import Database
from rig.catalog.facts import Derived, Enrollment, Session, View, seal_of
from rig.catalog.images import Images
from rig.catalog.records import JsonObject, Region
from rig.config import ViewConfig
from rig.core.errors import CatalogDamaged, CatalogError, ExtraMissing, RigError, UsageError
from rig.core.files import json_values
from rig.core.next_steps import Do
from rig.views.description import DESCRIPTORS, EnrollmentDescriber, ViewSegmenter, check_evidence, within

SEGMENTATION: Final = "segmentation"
"""The kind of the stored silhouettes: a list of the evidence of each view (`hbr.segmentation.segment`)."""
SEGMENTATION_VERSION: Final = 2
"""Increases when the same images give other silhouettes."""
FEWEST_VIEWS: Final = 4
"""A session with fewer views, after an interruption, learns its background from all views of the enrollment."""
MOST_HELD_BYTES: Final = 256_000_000
"""Pixels of one enrollment that are held in memory until it is described: 277 views of 640x480."""

Pixels = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """The levels of the views of an enrollment by each descriptor, uint8 (n, length), and their segmentation."""

    levels: Mapping[str, NDArray[np.uint8]]
    segmentation: tuple[dict[str, Any], ...]


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


def described(
    database: Database,
    enrollment: Enrollment,
    name: str,
    *wanted: str,
    held: Mapping[str, Pixels] | None = None,
) -> Described:
    """Return the stored description of an enrollment of the object ``name``, or compute and store it.

    It is by `DESCRIPTORS`, or by those that are ``wanted``. ``held`` are pixels of images that need not be read again.

    Raises `CatalogError`: an image cannot be read, or a view cannot be segmented.
    """
    kinds = wanted or DESCRIPTORS
    seal, count = seal_of(enrollment), len(enrollment.views)
    needed = kinds if all(descriptor(kind).whole_image for kind in kinds) else (SEGMENTATION, *kinds)
    with database.read() as transaction:
        stored = {kind: found.get(seal, b"") for kind, found in stored_contents(transaction, [seal], needed).items()}
    if all(stored.values()):
        # What this program has not made is computed again.
        with suppress(ValueError, TypeError, AttributeError, RigError):
            return _parsed(stored, kinds, count)
    with database.catalog_errors():
        contents = computed(reader(database.images.pixels, held), enrollment, name, kinds, threads=THREADS)
    store(database, seal, contents)
    return _parsed(contents, kinds, count)


def _parsed(contents: Mapping[str, bytes], kinds: Sequence[str], views: int) -> Described:
    """Return a description from its contents by kind; an error if this program would not have stored them."""
    packed = {kind: records_of(descriptor(kind), contents[kind])["packed"].tobytes() for kind in kinds}
    levels = {kind: descriptor(kind).unpack_rows(rows) for kind, rows in packed.items()}
    if SEGMENTATION not in contents:
        return Described(levels, ({},) * views)
    evidence = tuple(json_values(contents[SEGMENTATION]))
    if len(evidence) != views:
        raise ValueError("the evidence of other views")
    for one in evidence:
        check_evidence(one)
    return Described(levels, evidence)


# Segment again


def segmented_again(
    images: Images, view: View, session: Session, segmentation: JsonObject
) -> tuple[Pixels, hbr.Segmentation]:
    """Return the image of a stored view, and its object as the description cut it out.

    Raises `CatalogDamaged`: the view cannot be segmented.
    """
    image = images.pixels(view.image)
    try:
        segmenter = _segmenter(images, view.region, session.empty_table)
        return image, segmenter.segment(image, view.azimuth_deg, segmentation)
    except ValueError as error:
        raise CatalogDamaged(
            f"The view {view.id} cannot be segmented: {error}.", next_step=Do.VERIFY_CATALOG()
        ) from error


def silhouette(
    images: Images, view: View, session: Session, segmentation: JsonObject
) -> tuple[NDArray[np.bool_], hbr.Segmentation]:
    """Return the object's pixels in the image of a view, and where it was found; none if it was not."""
    image, found = segmented_again(images, view, session, segmentation)
    whole = np.zeros(image.shape[:2], np.bool_)
    part = within(whole, view.region)
    part[:] = found.frame_mask(*part.shape[::-1])
    return whole, found


@lru_cache(maxsize=4)
def _segmenter(images: Images, region: Region | None, empty_table: str | None) -> ViewSegmenter:
    """Return what segments the views of a session; to prepare its empty-table image takes long."""
    table = None if empty_table is None else images.pixels(empty_table)
    return ViewSegmenter(ViewConfig(roi=region), table)


# Compute


def hold(held: dict[str, Pixels], image: str, pixels: Pixels) -> None:
    """Keep the pixels of an image, unless all images would have more than `MOST_HELD_BYTES`."""
    if sum(one.nbytes for one in held.values()) + pixels.nbytes <= MOST_HELD_BYTES:
        held[image] = pixels


def reader(read: Callable[[str], Pixels], held: Mapping[str, Pixels] | None = None) -> Callable[[str], Pixels]:
    """Return a function that reads each image once: it holds pixels, ``held`` ones first, up to `MOST_HELD_BYTES`.

    Decoding takes longer than describing, and a view is used several times.
    """
    known = dict(held or {})

    def pixels(image: str) -> Pixels:
        if image in known:
            return known[image]
        found = read(image)
        hold(known, image, found)
        return found

    return pixels


def computed(
    pixels: Callable[[str], Pixels], enrollment: Enrollment, name: str, kinds: Sequence[str], *, threads: int = 1
) -> dict[str, bytes]:
    """Return the contents of the description of an object's enrollment, by kind; ``pixels`` reads an image.

    Raises `CatalogError`: a view cannot be described. Its evidence has the view's place and the reason.
    """
    views = enrollment.views
    packed: dict[str, list[bytes]] = {kind: [b""] * len(views) for kind in kinds}
    evidence: list[dict[str, Any]] = [{}] * len(views)
    # Descriptors of the whole image need no other view. The others describe what the segmentation cuts out.
    whole = [kind for kind in kinds if descriptor(kind).whole_image]
    cut_out = tuple(sorted(set(kinds).difference(whole)))
    learned = _learned(pixels, enrollment, name, cut_out) if cut_out else {}

    def describe_view(place: int) -> None:
        view = views[place]
        with _reasons(name, place):
            image = pixels(view.image)
            part = within(image, view.region)
            levels = {kind: descriptor(kind).describe(part) for kind in whole}
            if cut_out:
                describer, number = learned[place]
                found = describer.describe(number, image, view.azimuth_deg)
                levels |= {kind: found.levels[kind] for kind in cut_out}
                evidence[place] = found.segmentation or {}
            for kind, row in levels.items():
                packed[kind][place] = descriptor(kind).pack(row)

    # The views are independent now, so their order and the number of threads do not change the result.
    with ThreadPoolExecutor(threads, "describer") as pool:
        list((pool.map if threads > 1 else map)(describe_view, range(len(views))))
    azimuths_deg = [view.azimuth_deg for view in views]
    contents = {}
    for kind, rows in packed.items():
        levels_of = np.frombuffer(b"".join(rows), np.uint8).reshape(len(rows), -1)
        contents[kind] = content_of(descriptor(kind), levels_of, azimuths_deg)
    if any(evidence):
        contents[SEGMENTATION] = json.dumps(evidence).encode()
    return contents


def describe_one(images: Images, kinds: tuple[str, ...], one: tuple[str, Enrollment]) -> dict[str, bytes] | str:
    """Return the contents of the description of an object's enrollment, by kind, or why it cannot be described.

    Runs in a worker process.
    """
    name, enrollment = one
    try:
        return computed(reader(images.pixels), enrollment, name, kinds)
    except (CatalogError, UsageError) as error:
        return error.what.rstrip(".")


def _learned(
    pixels: Callable[[str], Pixels], enrollment: Enrollment, name: str, kinds: tuple[str, ...]
) -> dict[int, tuple[EnrollmentDescriber, int]]:
    """Return the describer that has learned the background of each view, and the number of the view there.

    The background is learned from the views of one session; from all of the region if it has too few.
    """
    views = enrollment.views
    found: dict[int, tuple[EnrollmentDescriber, int]] = {}
    for number, region in dict.fromkeys((view.session, view.region) for view in views):
        same_region = [place for place, view in enumerate(views) if view.region == region]
        own = [place for place in same_region if views[place].session == number]
        table = enrollment.sessions[number].empty_table
        describer = EnrollmentDescriber(ViewConfig(roi=region), kinds, None if table is None else pixels(table))
        numbers = {}
        for place in own if len(own) >= FEWEST_VIEWS else same_region:
            with _reasons(name, place):
                numbers[place] = describer.learn(pixels(views[place].image))
        found |= {place: (describer, numbers[place]) for place in own}
    return found


@contextmanager
def _reasons(name: str, place: int) -> Iterator[None]:
    """Raise errors about a view as a `CatalogError` that names it."""
    try:
        yield
    except (UsageError, ValueError) as error:
        reason = error.what.rstrip(".") if isinstance(error, UsageError) else str(error)
        raise CatalogError(
            f"View {place} of {name!r} cannot be described: {reason}.",
            next_step=("Check the disk.", Do.VERIFY_CATALOG()),
            evidence={"view": place, "reason": reason},
        ) from error


# Store


def _made_by(what: str) -> str:
    version = SEGMENTATION_VERSION if what == SEGMENTATION else descriptor(what).version
    is_cut_out = what != SEGMENTATION and not descriptor(what).whole_image
    return f"{what} {version}" + (f", segmentation {SEGMENTATION_VERSION}" if is_cut_out else "")


def _record(kind: Descriptor) -> np.dtype[np.void]:
    return np.dtype([("packed", "u1", (kind.size_bytes,)), ("azimuth_deg", "<f8")])


def records_of(kind: Descriptor, content: bytes) -> NDArray[np.void]:
    """Return the stored records of a descriptor: ``packed`` levels and ``azimuth_deg``."""
    return np.frombuffer(content, _record(kind))


def content_of(kind: Descriptor, packed: NDArray[np.uint8], azimuth_deg: ArrayLike) -> bytes:
    """Return the content of a row of descriptors: their packed levels, uint8 (n, size), with the azimuths (n,)."""
    records = np.empty(len(packed), _record(kind))
    records["packed"], records["azimuth_deg"] = packed, azimuth_deg
    return records.tobytes()


def row_of(seal: str, what: str, content: bytes) -> dict[str, Any]:
    """Return the columns of a row of `Derived` by this program."""
    made_by = _made_by(what)
    sha256 = digest_of(seal, what, made_by, content)
    return {"seal": seal, "what": what, "made_by": made_by, "content": content, "sha256": sha256}


def digest_of(seal: str, what: str, made_by: str, content: bytes) -> str:
    """Return the digest of a row of `Derived`; a content in the place of another one has another digest."""
    digest = hashlib.sha256(ascii((seal, what, made_by)).encode())
    digest.update(content)
    return digest.hexdigest()


def store(database: Database, seal: str, contents: Mapping[str, bytes]) -> None:
    """Store a description by kind; it is computed again if this fails."""
    rows = [row_of(seal, what, content) for what, content in contents.items()]
    with suppress(RigError):
        if not database.read_only:
            _write(database, rows)
            return
        # What is derived may also be added to a catalog that is open for reading.
        writing = type(database)(database.place, create=False, read_only=False, busy_timeout_s=1.0)
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
        made_by = _made_by(what)
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
