"""The images of a transfer: each is read, compared with its name, decoded, described, and later stored.

A file that cannot be used is rejected, with the reason.
"""

import zlib
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import Final
from zipfile import BadZipFile

from rig.catalog import describing
from rig.catalog.facts import Enrollment
from rig.catalog.images import Images, name_of
from rig.catalog.jobs import JobProgress, processes
from rig.core.errors import CatalogDamaged, CatalogError
from rig.core.processes import map_in_processes
from rig.views.image_files import BadImage, decode

Read = Callable[[str], bytes]
"""Returns the bytes under the name of an image, unchecked. It can be sent to other processes."""


class ImportProblem(StrEnum):
    """The kinds of reasons why a file is not imported."""

    NOT_A_FILE = "not_a_file"
    LINK_OUTSIDE = "link_outside"
    NAME_PATTERN = "name_pattern"
    SAME_AZIMUTH = "same_azimuth"
    INVALID_VALUE = "invalid_value"
    UNREADABLE = "unreadable"
    INVALID_IMAGE = "invalid_image"
    OTHER_IMAGE = "other_image"
    NOT_DESCRIBED = "not_described"


@dataclass(frozen=True, slots=True)
class RejectedFile:
    """A file that is not imported, and the reason, which follows the path in a sentence."""

    path: str
    code: ImportProblem
    reason: str

    def __str__(self) -> str:
        return f"{self.path} {self.reason}"


_READ_ERRORS: Final = (
    OSError,
    BadZipFile,
    EOFError,
    NotImplementedError,
    RuntimeError,
    ValueError,
    KeyError,
    zlib.error,
    CatalogDamaged,  # a link that leads out of a catalog
)


@dataclass
class ReadImages:
    """What was read for an object: name and size in bytes of each image, or the reason why it cannot be used.

    ``contents`` are its description (`describing.computed`), if there is one.
    """

    images: dict[str, tuple[str, int]] = field(default_factory=dict)
    rejected: dict[str, RejectedFile] = field(default_factory=dict)
    contents: dict[str, bytes] = field(default_factory=dict)


def images_of(enrollment: Enrollment) -> Iterator[tuple[str, int]]:
    """Yield the images of an enrollment and their sizes: of its views, and of the empty table."""
    yield from ((view.image, view.image_bytes) for view in enrollment.views)
    for session in enrollment.sessions:
        if session.empty_table is not None:
            yield session.empty_table, session.empty_table_bytes or 0


def read_images(
    read: Read,
    enrollments: Mapping[str, Enrollment],
    descriptors: tuple[str, ...],
    *,
    are_named: bool,
    strict: bool,
    jobs: int | None,
) -> Generator[JobProgress, None, dict[str, ReadImages]]:
    """Read, decode and describe the images of objects' enrollments, in several processes; return them by object.

    If they ``are_named`` as in a catalog, they are compared with their names. With ``strict`` it ends at the first
    object with a rejected image. A view that the ``descriptors`` cannot describe would stop every later search, so it
    is rejected, too.
    """
    total, done = sum(len(dict(images_of(one))) for one in enrollments.values()), 0
    found: dict[str, ReadImages] = {}
    yield JobProgress(0, total)
    work = partial(_read, read, are_named, descriptors)
    for (name, enrollment), own in map_in_processes(work, enrollments.items(), processes(jobs, total)):
        found[name] = own
        if strict and own.rejected:
            break
        done += len(dict(images_of(enrollment)))
        yield JobProgress(done, total)
    return found


def store_images(
    read: Read, store: Images, images: Mapping[str, tuple[str, int]]
) -> Generator[JobProgress, None, list[RejectedFile]]:
    """Store images that were read before, durably; it ends at the first one that is no longer the same."""
    for done, (image, (name, _)) in enumerate(images.items() if store.are_kept else (), 1):
        content = checked(read, image, name)
        if isinstance(content, RejectedFile):
            return [content]
        store.put(content, settled=False)
        yield JobProgress(done, len(images))
    if store.are_kept:
        store.settle({name for name, _ in images.values()})
    return []


def checked(read: Read, image: str, name: str | None) -> bytes | RejectedFile:
    """Return the bytes of an image, or why it cannot be used. ``name`` is what they are called in a catalog."""
    try:
        content = read(image)
    except _READ_ERRORS as error:
        return RejectedFile(image, ImportProblem.UNREADABLE, f"cannot be read: {error}")
    if name is not None and name_of(content) != name:
        return RejectedFile(image, ImportProblem.OTHER_IMAGE, "is not the stored image")
    return content


def _read(read: Read, are_named: bool, descriptors: tuple[str, ...], one: tuple[str, Enrollment]) -> ReadImages:
    """Read the images of an object's enrollment, and describe its views. Runs in a worker process."""
    name, enrollment = one
    found = ReadImages()
    held: dict[str, describing.Pixels] = {}
    for image in dict(images_of(enrollment)):
        content = checked(read, image, image if are_named else None)
        if not isinstance(content, RejectedFile):
            try:
                describing.hold(held, image, decode(content))
                found.images[image] = name_of(content), len(content)
                continue
            except BadImage as error:
                content = RejectedFile(image, ImportProblem.INVALID_IMAGE, f"cannot be used: {error}")
        found.rejected[image] = content
    # Describe the views whose images can be used, and reject those that cannot be described with the others.
    pixels = describing.reader(lambda image: decode(read(image)), held)
    tables = [session.empty_table for session in enrollment.sessions]
    while found.rejected.keys().isdisjoint(tables):
        good = Enrollment(key=enrollment.key, object_id=0, started_utc=enrollment.started_utc, planned_azimuth_deg=())
        good.sessions = enrollment.sessions
        good.views = [view for view in enrollment.views if view.image not in found.rejected]
        try:
            found.contents = describing.computed(pixels, good, name, descriptors) if good.views else {}
            break
        except CatalogError as error:
            if "view" not in error.evidence:
                raise  # of the store
            image, reason = good.views[error.evidence["view"]].image, error.evidence["reason"]
            found.rejected[image] = RejectedFile(image, ImportProblem.NOT_DESCRIBED, f"cannot be described: {reason}")
            found.images.pop(image, None)
    return found
