"""The images of a transfer: each is read, compared with its name, decoded and stored, in several processes.

A file that cannot be used is rejected, with the reason.
"""

import zlib
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from typing import Final
from zipfile import BadZipFile

from rig.catalog.facts import Enrollment
from rig.catalog.images import Images, name_of
from rig.catalog.jobs import JobProgress, processes
from rig.catalog.records import Region
from rig.core.errors import CatalogDamaged, UsageError
from rig.core.processes import map_in_processes
from rig.views.description import within
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

_Wanted = tuple[tuple[str, Region | None], ...]
"""The images of an enrollment, each with the part that is described."""


@dataclass(frozen=True)
class Reading:
    """How images are read.

    Attributes
    ----------
    content
        Returns the bytes under a name.
    store
        Gets the images; None stores none.
    is_named
        The names are those of a catalog, so the bytes can be compared with them.
    decodes
        Each image is also decoded.
    """

    content: Callable[[str], bytes]
    store: Images | None
    is_named: bool
    decodes: bool


@dataclass
class ReadImages:
    """What was read: name and size in bytes of each image, or the reason why it cannot be used."""

    images: dict[str, tuple[str, int]] = field(default_factory=dict)
    rejected: dict[str, RejectedFile] = field(default_factory=dict)


def read_images(
    reading: Reading, enrollments: Iterable[Enrollment], *, strict: bool, jobs: int | None
) -> Generator[JobProgress, None, ReadImages]:
    """Read the images of enrollments; with ``strict`` it ends at the first enrollment with a rejected one."""
    wanted = [_images(one) for one in enrollments]
    total, done = sum(map(len, wanted)), 0
    found = ReadImages()
    yield JobProgress(0, total)
    for of_one, part in map_in_processes(partial(_read, reading), wanted, processes(jobs, total)):
        found.images |= part.images
        found.rejected |= part.rejected
        if strict and found.rejected:
            break
        done += len(of_one)
        yield JobProgress(done, total)
    return found


def _images(enrollment: Enrollment) -> _Wanted:
    tables = ((session.empty_table, None) for session in enrollment.sessions if session.empty_table is not None)
    return tuple(dict.fromkeys((*((view.image, view.region) for view in enrollment.views), *tables)))


def _read(reading: Reading, wanted: _Wanted) -> ReadImages:
    """Read the images of an enrollment. Runs in a worker process."""
    found = ReadImages()
    for image, region in wanted:
        code, reason = None, ""
        try:
            content = reading.content(image)
            name = name_of(content)
            if reading.is_named and name != image:
                code, reason = ImportProblem.OTHER_IMAGE, OTHER_IMAGE
            elif reading.decodes:
                within(decode(content), region)
        except BadImage as error:
            code, reason = ImportProblem.INVALID_IMAGE, f"cannot be used: {error}"
        except UsageError as error:
            code, reason = ImportProblem.NOT_DESCRIBED, f"cannot be described: {error.what.rstrip('.')}"
        except (CatalogDamaged, *_READ_ERRORS) as error:  # a link that leads out of a catalog is damage
            code, reason = ImportProblem.UNREADABLE, f"cannot be read: {error}"
        if code is not None:
            found.rejected[image] = RejectedFile(image, code, reason)
            continue
        if reading.store is not None and image not in found.images:
            reading.store.put(content, settled=False)
        found.images[image] = name, len(content)
    for image in found.rejected:  # another part of it may lie within it
        found.images.pop(image, None)
    return found
