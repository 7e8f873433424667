"""The images of a transfer: each is read, compared with its name, decoded and stored, in several processes.

A file that cannot be used is rejected, with the reason.
"""

import zlib
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass, field
from enum import Enum, unique
from functools import partial
from typing import Any, Final
from zipfile import BadZipFile

from rig.catalog.facts import Enrollment
from rig.catalog.images import Images, name_of
from rig.catalog.jobs import JobProgress, processes
from rig.catalog.records import Region
from rig.core.errors import CatalogDamaged, UsageError
from rig.core.processes import map_in_processes
from rig.views.description import within
from rig.views.image_files import BadImage, decode


@unique
class ImportProblem(Enum):
    """A reason why a file is not imported: the name is its code, the value the template of its text."""

    NOT_A_FILE = "is not a file"
    LINK_OUTSIDE = "is a link to a file outside the folder"
    NAME_PATTERN = "does not match the pattern {pattern}"
    SAME_AZIMUTH = "shows {name!r} from the same azimuth as {other}"
    INVALID_VALUE = "{error}"
    UNREADABLE = "cannot be read: {error}"
    INVALID_IMAGE = "cannot be used: {error}"
    OTHER_IMAGE = "is not the stored image"
    NOT_DESCRIBED = "cannot be described: {error}"


@dataclass(frozen=True, slots=True)
class Reason:
    """An `ImportProblem` with the values of its text."""

    code: ImportProblem
    values: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return self.code.value.format_map(self.values)


@dataclass(frozen=True, slots=True)
class RejectedFile:
    """A file that is not imported, and why."""

    path: str
    reason: Reason

    def as_json(self) -> dict[str, Any]:
        """Return the file with the code and the text of the reason."""
        code = self.reason.code.name.lower()
        return {"path": self.path, "code": code, "values": self.reason.values, "reason": str(self.reason)}


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
    rejected: dict[str, Reason] = field(default_factory=dict)

    @property
    def rejected_files(self) -> tuple[RejectedFile, ...]:
        return tuple(RejectedFile(image, reason) for image, reason in self.rejected.items())


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
        reason = None
        try:
            content = reading.content(image)
            name = name_of(content)
            if reading.is_named and name != image:
                reason = Reason(ImportProblem.OTHER_IMAGE)
            elif reading.decodes:
                within(decode(content), region)
        except BadImage as error:
            reason = Reason(ImportProblem.INVALID_IMAGE, {"error": str(error)})
        except UsageError as error:
            reason = Reason(ImportProblem.NOT_DESCRIBED, {"error": error.what.rstrip(".")})
        except (CatalogDamaged, *_READ_ERRORS) as error:  # a link that leads out of a catalog is damage
            reason = Reason(ImportProblem.UNREADABLE, {"error": str(error)})
        if reason is not None:
            found.rejected[image] = reason
            continue
        if reading.store is not None and image not in found.images:
            reading.store.put(content, settled=False)
        found.images[image] = name, len(content)
    for image in found.rejected:  # another part of it may lie within it
        found.images.pop(image, None)
    return found
