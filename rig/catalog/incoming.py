"""The images of a transfer: each is read, compared with its name, stored and described, in several processes.

A file that cannot be used is rejected, with the reason.
"""

import zlib
from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum, unique
from functools import partial
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from rig.catalog import describing
from rig.catalog.images import Images, name_of
from rig.catalog.jobs import JobProgress, processes
from rig.core.errors import CatalogDamaged, CatalogError, UsageError
from rig.core.processes import map_in_processes
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
_NO_PIXELS: Final = np.empty((0, 0, 3), np.uint8)  # for images that are stored without being decoded


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
    """What was read: name and size in bytes of each image, or the reason why it cannot be used.

    ``contents`` are the descriptions of enrollments by their keys (`describing.contents`).
    """

    images: dict[str, tuple[str, int]] = field(default_factory=dict)
    rejected: dict[str, Reason] = field(default_factory=dict)
    contents: dict[str, dict[str, bytes]] = field(default_factory=dict)

    def add(self, other: "ReadImages") -> None:
        self.images |= other.images
        self.rejected |= other.rejected
        self.contents |= other.contents

    @property
    def rejected_files(self) -> tuple[RejectedFile, ...]:
        return tuple(RejectedFile(image, reason) for image, reason in self.rejected.items())


class _Rejected(Exception):
    """An image cannot be used."""


def read_images(
    reading: Reading, tasks: Sequence[describing.Task], *, strict: bool, jobs: int | None
) -> Generator[JobProgress, None, ReadImages]:
    """Read the images of enrollments; with ``strict`` it ends at the first enrollment with a rejected one."""
    total, done = sum(len(_names(task)) for task in tasks), 0
    found = ReadImages()
    yield JobProgress(0, total)
    for task, part in map_in_processes(partial(_read, reading), tasks, processes(jobs, total)):
        found.add(part)
        if strict and found.rejected:
            break
        done += len(_names(task))
        yield JobProgress(done, total)
    return found


def _read(reading: Reading, task: describing.Task) -> ReadImages:
    """Read the images of an enrollment, and describe those that can be used. Runs in a worker process."""
    found = ReadImages()
    last = ""

    def pixels(image: str) -> NDArray[np.uint8]:
        nonlocal last
        last = image
        return _pixels(reading, image, found)

    def read_others() -> None:
        for image in _names(task):
            if image not in found.images and image not in found.rejected:
                with suppress(_Rejected):
                    pixels(image)

    while task.names and task.views:
        try:
            found.contents[task.seal] = describing.contents(pixels, task)
            break
        except _Rejected:
            read_others()
            if not found.rejected.keys().isdisjoint(task.empty_tables):
                break
        except CatalogError as error:
            if not isinstance(error.__cause__, UsageError | ValueError):
                raise  # of the store
            reason = error.__cause__.what.rstrip(".") if isinstance(error.__cause__, UsageError) else error.__cause__
            found.rejected[last] = Reason(ImportProblem.NOT_DESCRIBED, {"error": str(reason)})
        task = task._replace(views=tuple(view for view in task.views if view.image not in found.rejected))
    read_others()
    return found


def _pixels(reading: Reading, image: str, found: ReadImages) -> NDArray[np.uint8]:
    try:
        content = reading.content(image)
        name = name_of(content)
        if reading.is_named and name != image:
            found.rejected[image] = Reason(ImportProblem.OTHER_IMAGE)
            raise _Rejected(image)
        pixels = decode(content) if reading.decodes else _NO_PIXELS
    except BadImage as error:
        found.rejected[image] = Reason(ImportProblem.INVALID_IMAGE, {"error": str(error)})
        raise _Rejected(image) from error
    except (CatalogDamaged, *_READ_ERRORS) as error:  # a link that leads out of a catalog is damage
        found.rejected[image] = Reason(ImportProblem.UNREADABLE, {"error": str(error)})
        raise _Rejected(image) from error
    if reading.store is not None and image not in found.images:
        reading.store.put(content, settled=False)
    found.images[image] = name, len(content)
    return pixels


def _names(task: describing.Task) -> list[str]:
    """Return the images of an enrollment, each once."""
    return list(dict.fromkeys([*(view.image for view in task.views), *filter(None, task.empty_tables)]))
