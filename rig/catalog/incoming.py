"""The images of a transfer: each is read, compared with its name, decoded, described and stored, in several processes.

A file that cannot be used is rejected, with the reason.
"""

import zlib
from collections.abc import Callable, Generator, Mapping
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


OTHER_IMAGE: Final = "is not the stored image"
_READ_ERRORS: Final = (
    OSError,
    BadZipFile,
    EOFError,
    NotImplementedError,
    RuntimeError,
    ValueError,
    KeyError,
    zlib.error,
)


@dataclass(frozen=True)
class Reading:
    """How images are read."""

    content: Callable[[str], bytes]
    """Returns the bytes under a name."""
    store: Images | None
    """Gets the images; None stores none."""
    is_named: bool
    """The names are those of a catalog, so the bytes can be compared with them."""
    decodes: bool
    """Each image is also decoded, and the views are described."""
    descriptors: tuple[str, ...] = ()
    """Those that describe them. A view that cannot be described would stop every later search, so it is rejected."""


@dataclass
class ReadImages:
    """What was read: name and size in bytes of each image, or the reason why it cannot be used.

    ``contents`` are the descriptions by the names of the objects (`describing.computed`), of those that were decoded.
    """

    images: dict[str, tuple[str, int]] = field(default_factory=dict)
    rejected: dict[str, RejectedFile] = field(default_factory=dict)
    contents: dict[str, dict[str, bytes]] = field(default_factory=dict)


def read_images(
    reading: Reading, enrollments: Mapping[str, Enrollment], *, strict: bool, jobs: int | None
) -> Generator[JobProgress, None, ReadImages]:
    """Read the images of objects' enrollments; with ``strict`` it ends at the first one with a rejected image."""
    total, done = sum(len(_images(one)) for one in enrollments.values()), 0
    found = ReadImages()
    yield JobProgress(0, total)
    parts = []
    for (name, enrollment), part in map_in_processes(
        partial(_read, reading), enrollments.items(), processes(jobs, total)
    ):
        parts.append((name, part))
        found.images |= part.images
        found.rejected |= part.rejected
        found.contents |= part.contents
        if strict and found.rejected:
            break
        done += len(_images(enrollment))
        yield JobProgress(done, total)
    for name, part in parts:  # an image that one object cannot use is left out of the others, too
        if not found.rejected.keys().isdisjoint(part.images):
            found.contents.pop(name, None)
    for image in found.rejected:
        found.images.pop(image, None)
    return found


def _images(enrollment: Enrollment) -> list[str]:
    tables = [session.empty_table for session in enrollment.sessions if session.empty_table is not None]
    return list(dict.fromkeys([*(view.image for view in enrollment.views), *tables]))


def _read(reading: Reading, one: tuple[str, Enrollment]) -> ReadImages:
    """Read the images of an object's enrollment, and describe its views. Runs in a worker process."""
    name_of_object, enrollment = one
    found = ReadImages()
    held: dict[str, describing.Pixels] = {}
    for image in _images(enrollment):
        code, reason = None, ""
        try:
            content = reading.content(image)
            name = name_of(content)
            if reading.is_named and name != image:
                code, reason = ImportProblem.OTHER_IMAGE, OTHER_IMAGE
            elif reading.decodes:
                describing.hold(held, image, decode(content))
        except BadImage as error:
            code, reason = ImportProblem.INVALID_IMAGE, f"cannot be used: {error}"
        except (CatalogDamaged, *_READ_ERRORS) as error:  # a link that leads out of a catalog is damage
            code, reason = ImportProblem.UNREADABLE, f"cannot be read: {error}"
        if code is not None:
            found.rejected[image] = RejectedFile(image, code, reason)
            continue
        if reading.store is not None:
            reading.store.put(content, settled=False)
        found.images[image] = name, len(content)
    if reading.decodes:
        _describe(reading, name_of_object, enrollment, held, found)
    return found


def _describe(
    reading: Reading, name: str, enrollment: Enrollment, held: Mapping[str, describing.Pixels], found: ReadImages
) -> None:
    """Describe the views whose images can be used, and reject those that cannot be described with the others."""
    pixels = describing.reader(lambda image: decode(reading.content(image)), held)
    tables = [session.empty_table for session in enrollment.sessions]
    while found.rejected.keys().isdisjoint(tables):
        good = Enrollment(key=enrollment.key, object_id=0, started_utc=enrollment.started_utc, planned_azimuth_deg=())
        good.sessions = enrollment.sessions
        good.views = [view for view in enrollment.views if view.image not in found.rejected]
        if not good.views:
            return
        try:
            found.contents[name] = describing.computed(pixels, good, name, reading.descriptors)
            return
        except CatalogError as error:
            if "view" not in error.evidence:
                raise  # of the store
            image, reason = good.views[error.evidence["view"]].image, error.evidence["reason"]
            found.rejected[image] = RejectedFile(image, ImportProblem.NOT_DESCRIBED, f"cannot be described: {reason}")
            found.images.pop(image, None)
